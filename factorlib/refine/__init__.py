"""Poses by shading: which pose of an object the solved materials explain a photo from.

from factorlib.refine.photo import Scene, refined_photo
"""
