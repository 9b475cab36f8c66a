"""Poses by shading: the pose in which the solved materials explain a photo best.

    photo      all objects of a photo, one after the other
    choice     which pose is used: the one found, that one moved by shading, or the runner-up
    descent    how shading and contours move a pose
    light      the light that a photo asks for, given materials and normals
    pixels     the pixels that poses are compared on

>>> from factorlib.refine.photo import Scene, refined_photo
>>> from factorlib.refine.choice import Standards
>>> Standards().least_gain
0.03
"""
