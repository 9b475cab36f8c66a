"""Alignment: where the meshes of a photo are, and how sure that is.

    place      all objects of a photo: given poses, searched ones, one focal length
    search     the pose of one object: guesses (coarse), refined on contours (refine), and the runner-up
    silhouette   what masks say about an object;  target: the same at the resolution of the search
    trust      what speaks for and against a pose, and which of it is too little
    given      checks of poses and cameras that are given;  keypoints: points that the user named
    proportions   factors of a mesh's axes, from all photos that show it
    confidence    how far to believe the normal of each pixel;  overlay: a picture to judge a pose by

>>> from factorlib.align.place import KnownFocal, ObjectToPlace, placed
>>> from factorlib.align.search import Search
>>> Search().views, KnownFocal(812.0, "exif").source
(300, 'exif')
"""
