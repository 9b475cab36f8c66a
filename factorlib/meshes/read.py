"""Mesh files: OBJ, glTF/GLB, PLY, STL, OFF; their parts become material labels.

A part goes by any name the file gives it (OBJ: usemtl, group, object; glTF: primitive, node, material; the others have
one part, named as the file).  Faces that cannot be used are dropped and counted in the log; what would make a wrong
result in silence is refused.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh

from factorlib.errors import InputError, did_you_mean
from factorlib.meshes.mesh import Mesh, area_vectors
from factorlib.meshes.normals import consistently_wound, corner_normals, welded
from factorlib.meshes.obj import read_obj
from factorlib.meshes.soup import Soup, check, no_normals

FORMATS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
CREASE_DEG = 60.0
log = logging.getLogger("factorlib.meshes")


def read_mesh(
    path: str | Path,
    materials: Sequence[str],
    parts: Mapping[str, str] | None = None,
    material: str | None = None,
    overrides: Mapping[str, str] | None = None,
    crease_deg: float = CREASE_DEG,
) -> Mesh:
    """The mesh of one object, labelled by material.

    materials   the dataset's, in order: label k is the k-th, from 1
    parts       part -> material; or `material` for the whole mesh; `overrides` (part -> material) go before both
    crease_deg  edges sharper than this stay sharp in the normals

    Raises InputError for a file that cannot be read or has no usable faces, a vertex that is not finite, a part of the
    mesh that has no material, a named part that the mesh lacks, and a material that the dataset lacks.
    """
    soup = read_soup(path)
    label = part_labels(soup.parts, materials, parts, material, overrides or {}, path)
    return usable(soup, label[soup.part], crease_deg, path)


def read_soup(path: str | Path) -> Soup:
    """What the file says; InputError where it says nothing usable."""
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"unknown mesh format {path.suffix!r}", file=path, cure="use one of " + ", ".join(FORMATS))
    if not path.is_file():
        raise InputError("mesh not found", file=path, cure="is the path right, relative to dataset.yaml?")
    return read_obj(path) if path.suffix.lower() == ".obj" else read_with_trimesh(path)


def read_with_trimesh(path: Path) -> Soup:
    """Every geometry at its place in the scene; a part is named by its node, its geometry and its material."""
    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh raises whatever its parsers do
        raise InputError(f"not readable as a mesh ({error})", file=path, cure="is it whole? try to open and export it again") from error
    pieces = []
    for node in sorted(scene.graph.nodes_geometry):
        world_from_node, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            names = (name, node, getattr(getattr(geometry.visual, "material", None), "name", None))
            pieces.append((geometry, world_from_node, names))
    single = len(pieces) == 1 and path.suffix.lower() not in (".glb", ".gltf")
    return check(_joined([(g, t, (path.stem,) if single else names) for g, t, names in pieces]), path)


def _joined(pieces: list) -> Soup:
    vertices, faces, normals, parts, offset = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], [no_normals(0)], [], 0
    for geometry, transform, names in pieces:
        vertices.append(np.asarray(geometry.vertices, float) @ transform[:3, :3].T + transform[:3, 3])
        faces.append(np.asarray(geometry.faces, np.int64) + offset)
        normals.append(_supplied_normals(geometry, transform[:3, :3]))
        parts.append(tuple(dict.fromkeys(str(n) for n in names if n)))
        offset += len(geometry.vertices)
    part = np.repeat(np.arange(len(parts)), [len(f) for f in faces[1:]])
    return Soup(np.concatenate(vertices), np.concatenate(faces), part, parts, np.concatenate(normals))


def _supplied_normals(geometry: trimesh.Trimesh, linear: np.ndarray) -> np.ndarray:
    """Per corner, from the file's vertex normals; NaN where it has none."""
    if "vertex_normals" not in geometry._cache.cache:  # trimesh would otherwise compute its own
        return no_normals(len(geometry.faces))
    cofactor = np.cross(np.roll(linear, -1, axis=0), np.roll(linear, -2, axis=0))  # normals transform by it
    normals = np.asarray(geometry.vertex_normals, float) @ cofactor.T
    return normals[np.asarray(geometry.faces)]


def part_labels(
    names: Sequence[tuple[str, ...]],
    materials: Sequence[str],
    parts: Mapping[str, str] | None,
    material: str | None,
    overrides: Mapping[str, str],
    file,
) -> np.ndarray:
    """Material label (int16, from 1) of each part of a file, given the names it goes by.

    >>> part_labels([("shell",), ("legs", "wood")], ["red", "oak"], {"shell": "red", "wood": "oak"}, None, {}, "a.obj").tolist()
    [1, 2]
    """
    there = sorted({name for each in names for name in each})
    for mapping in (parts or {}, overrides):
        for part, chosen in mapping.items():
            if part not in there:
                raise InputError(f"the mesh has no part {part!r}", file=file, key=part, cure=did_you_mean(part, there))
            _check_material(chosen, materials, part, file)
    if material is not None:
        _check_material(material, materials, None, file)
    return np.array([_label(each, materials, parts or {}, material, overrides, file) for each in names], dtype=np.int16)


def _label(names, materials, parts, default, overrides, file) -> int:
    for mapping in (overrides, parts):
        chosen = {mapping[name] for name in names if name in mapping}
        if len(chosen) > 1:
            raise InputError(
                f"part {' / '.join(names)} gets several materials: {', '.join(sorted(chosen))}", file=file, cure="name it once"
            )
        if chosen:
            return list(materials).index(chosen.pop()) + 1
    if default is None:
        part = " / ".join(names) or "(unnamed)"
        raise InputError(
            f"part {part} has no material",
            file=file,
            key=part,
            cure=f"add it to `parts`, e.g. {names[0] if names else 'name'}: {materials[0]}",
        )
    return list(materials).index(default) + 1


def _check_material(name: str, materials: Sequence[str], part: str | None, file) -> None:
    if name not in materials:
        raise InputError(f"unknown material {name!r}", file=file, key=part, cure=did_you_mean(name, materials))


def usable(soup: Soup, face_label: np.ndarray, crease_deg: float, file) -> Mesh:
    """Welded, without zero-area and duplicate faces, consistently wound, with normals; InputError if nothing is left."""
    weld = welded(soup.vertices)
    first = np.unique(weld, return_index=True)[1]
    vertices, faces = soup.vertices[first], weld[soup.faces]
    keep = good_faces(vertices, faces, file)
    if not keep.any():
        raise InputError("every face has zero area", file=file, cure="is the mesh flat to a line, or its scale zero?")
    faces, face_label, supplied = faces[keep], face_label[keep], soup.normals[keep]
    flip, is_open = consistently_wound(vertices, faces)
    faces = np.where(flip[:, None], faces[:, ::-1], faces)
    supplied = np.where(flip[:, None, None], -supplied[:, ::-1], supplied)
    if flip.any():
        log.info("%s: %d faces turned to agree with their neighbours", file, int(flip.sum()))
    normals = merged_normals(corner_normals(vertices, faces, crease_deg), supplied, area_vectors(vertices, faces))
    return split_at_creases(vertices, faces, normals, face_label, is_open)


def good_faces(vertices: np.ndarray, faces: np.ndarray, file) -> np.ndarray:
    """Which faces have an area and are no copy of an earlier one (in either winding); what is dropped is logged."""
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    solid = distinct & (np.linalg.norm(area_vectors(vertices, faces), axis=1) > 1e-14 * extent**2)
    single = np.zeros(len(faces), bool)
    single[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]] = True
    for count, what in ((int((~solid).sum()), "zero-area"), (int((solid & ~single).sum()), "duplicate")):
        if count:
            log.info("%s: %d %s faces dropped", file, count, what)
    return solid & single


def merged_normals(own: np.ndarray, supplied: np.ndarray, area: np.ndarray) -> np.ndarray:
    """[F, 3, 3]: the file's normals where they are sane (unit length, within 75° of the face's), else our own."""
    length = np.linalg.norm(supplied, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = supplied / length
        face = (area / np.linalg.norm(area, axis=1, keepdims=True))[:, None, :]
        sane = np.isfinite(unit).all(axis=-1) & (np.abs(length[..., 0] - 1) < 0.05) & (np.sum(unit * face, axis=-1) > 0.26)
    return np.where(sane[..., None], unit, own)


def split_at_creases(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, face_label: np.ndarray, is_open: bool) -> Mesh:
    """One vertex per position and normal."""
    rounded = np.round(normals.reshape(-1, 3) * 2**20).astype(np.int64)
    key = np.concatenate([faces.reshape(-1, 1), rounded], axis=1)
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return Mesh(
        vertices=np.ascontiguousarray(vertices[faces.reshape(-1)[first]]),
        faces=index.reshape(-1, 3).astype(np.int32),
        normals=np.ascontiguousarray(normals.reshape(-1, 3)[first]),
        face_label=face_label.astype(np.int16),
        open=is_open,
    )
