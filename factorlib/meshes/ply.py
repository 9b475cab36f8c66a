"""PLY files: read in text and both byte orders, written in binary little-endian, the same mesh as the same bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.ply_header import CURE, read_header
from factorlib.meshes.ply_rows import Column, Columns, columns_of
from factorlib.meshes.soup import Soup, fans, floats, of_one_part
from factorlib.wholefile import write_bytes

CORNERS = ("vertex_indices", "vertex_index")


def read_ply(path: Path, content: bytes, limits: Limits) -> Soup:
    """Vertices, polygons and, where there are all three of nx, ny, nz, normals; textures that it names are left alone."""
    header = read_header(path, content)
    vertex, face = header.element("vertex"), header.element("face")
    limits.check(vertex.count if vertex else 0, face.count if face else 0, path)
    columns = columns_of(header, content)
    polygons = _polygons(columns.get("face", {}), path)
    limits.check(0, int(np.maximum(polygons.counts - 2, 0).sum()), path)
    points = _vectors(columns.get("vertex", {}), "xyz")
    if points is None:
        raise InputError("its vertices have no x, y, z", file=path, cure=CURE)
    normals = _vectors(columns["vertex"], ("nx", "ny", "nz"))
    return of_one_part(points, fans(polygons.counts, polygons.values), path.stem, normals)


def _polygons(face: Columns, path: Path) -> Column:
    """The corners of each face, whole numbers: the list of that name, or the only one."""
    name = next((name for name in CORNERS if name in face), None)
    name = next(iter(face)) if name is None and len(face) == 1 else name
    if name is None:
        return Column(np.empty(0, np.int64), np.zeros(0, np.int64))
    values = face[name].values
    whole = values.astype(np.int64) if values.dtype.kind != "f" or (np.abs(values) < 2**53).all() else None
    if whole is None or (whole != values).any():
        raise InputError("a corner of a face is no whole number", file=path, cure=CURE)
    return Column(whole, face[name].counts)


def _vectors(columns: Columns, names: str | tuple[str, ...]) -> np.ndarray | None:
    """Three properties as vectors; None where one is missing, or a list."""
    if not all(name in columns and (columns[name].counts == 1).all() for name in names):
        return None
    return np.stack([floats(columns[name].values) for name in names], axis=1)


def write_ply(path: str | Path, mesh: Mesh) -> None:
    """Write vertices (float64 as float32), normals and faces, with `label` per face: what Mitsuba and other readers read."""
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
