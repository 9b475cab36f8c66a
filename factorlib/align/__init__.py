"""Alignment: where the meshes of a photo are, and how sure that is.

    place      all objects of a photo: given poses, searched ones, one focal length
    search     the pose of one object: guesses (coarse), refined on contours (refine), and the runner-up
    silhouette   what masks say about an object;  target: the same at the resolution of the search
    trust      what speaks for and against a pose that was found;  doubts: which of it is too little

>>> from factorlib.align.place import KnownFocal, ObjectToPlace, placed
>>> from factorlib.align.search import Search
>>> Search().views, KnownFocal(812.0, "exif").source
(300, 'exif')
"""
