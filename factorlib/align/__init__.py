"""Alignment: where the meshes of a photo are, and how sure that is.

`place` begins with all objects of a photo, `search` with one: guesses (`coarse`), refined on contours (`refine`) against what the
masks say (`silhouette`, `target`).  `given` checks what was given, and `trust` says which poses are to be doubted.
"""
