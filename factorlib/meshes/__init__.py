"""Meshes: files to labelled triangles with smooth normals (`read`), and back to PLY (`ply`)."""
