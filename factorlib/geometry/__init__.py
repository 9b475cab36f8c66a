"""Where objects are and what they see of each other: nothing here knows of pictures' values or of materials' reflectances.

camera      cameras and rigid poses
raster      ray casting and rasterising of meshes
visibility  which directions a surface point sees past the objects of its photo
sphere      even sets of directions, mirror directions, cells of directions
"""
