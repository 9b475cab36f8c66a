"""Meshes: readers of files that yield labelled triangles with smooth normals, and a writer of PLY."""
