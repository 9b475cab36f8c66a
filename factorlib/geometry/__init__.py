"""Geometry of objects and cameras, independent of images and of reflectance.

camera      cameras and rigid poses
raster      ray casting and rasterisation of meshes
occlusion   directions in which a surface point is not occluded by the objects of its photo
sphere      even sets of directions, mirror directions, cells of directions, codes of hiding surfaces
"""
