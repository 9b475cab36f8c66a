"""Alignment: where the meshes of a photo are, and what every pixel sees of them.

from factorlib.align import Camera, Pose, rasterise
"""
