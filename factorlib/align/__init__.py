"""Alignment: estimation of object poses in a photo, and of their reliability.

`photo_alignment` handles all objects of a photo, `search` a single one. The search starts from guesses (`coarse`) and
refines them on contours (`refine`) against the masks (`silhouette`). `input_checks` checks poses and cameras that the
user gives. `reliability` names the poses that are doubtful, and tells how sure each pixel's normal is.
"""
