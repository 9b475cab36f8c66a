"""Meshes: readers of files that yield labelled triangles with smooth normals (`read`), and a writer of PLY (`ply`)."""
