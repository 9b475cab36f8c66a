"""Alignment: estimation of object poses in a photo, and of their reliability.

`place` handles all objects of a photo, `search` a single one. The search starts from guesses (`coarse`) and refines
them on contours (`refine`) against the masks (`silhouette`, `target`). `given` checks poses and cameras that the user
gives. `trust` names the poses that are doubtful.
"""
