"""The data sets the project carries, made by Mitsuba from shapes, materials and lights of the project's own."""
