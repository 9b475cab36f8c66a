"""Generator of the data sets in the repository, rendered by Mitsuba from shapes, materials and lights of our own."""
