"""PLY files: binary little-endian, the same mesh is the same bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorlib.meshes.mesh import Mesh
from factorlib.wholefile import write_bytes


def write_ply(path: str | Path, mesh: Mesh) -> None:
    """Write vertices (float64 as float32), normals and faces, with `label` per face: what Mitsuba and trimesh read."""
    header = "\n".join(
        ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
        + [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
        + [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "property int label", "end_header", ""]
    )
    vertices = np.concatenate([mesh.vertices, mesh.normals], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3), ("label", "<i4")])
    faces["count"], faces["index"], faces["label"] = 3, mesh.faces, mesh.face_label
    write_bytes(path, header.encode("ascii") + vertices.tobytes() + faces.tobytes())


def submesh(mesh: Mesh, label: int) -> Mesh:
    """The faces of one material, with only the vertices they use."""
    keep = mesh.face_label == label
    used, index = np.unique(mesh.faces[keep], return_inverse=True)
    faces = index.reshape(-1, 3).astype(np.int32)
    return Mesh(mesh.vertices[used], faces, mesh.normals[used], mesh.face_label[keep], mesh.open)
