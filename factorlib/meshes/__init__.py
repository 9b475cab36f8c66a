"""Meshes: readers of files that yield labelled triangles with smooth normals (`read_mesh`), and a writer of PLY (`ply`)."""
