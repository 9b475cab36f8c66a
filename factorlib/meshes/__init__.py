"""Meshes: `read_mesh` reads labelled triangles with smooth normals, `ply_stl_off` writes PLY."""
