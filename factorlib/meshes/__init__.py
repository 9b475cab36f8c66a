"""Meshes: files to labelled triangles with smooth normals, and back to PLY.

>>> from factorlib.meshes import Mesh, read_mesh, write_ply
"""

from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply import write_ply
from factorlib.meshes.read import read_mesh

__all__ = ["Mesh", "read_mesh", "write_ply"]
