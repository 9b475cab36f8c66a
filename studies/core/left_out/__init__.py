"""Cases that are photos of a data set, whose chairs are predicted from everything else that the set shows."""
