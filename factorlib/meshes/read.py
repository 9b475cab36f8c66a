"""Mesh files: OBJ, glTF/GLB, PLY, STL, OFF; their parts become material labels.

A part goes by any name the file gives it (OBJ: usemtl, group, object; glTF: primitive, node, material; the others have
one part, named as the file).  Faces that cannot be used are dropped and counted in the log; what would make a wrong
result in silence is refused.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from factorlib.dataset.schema import MeshEntry
from factorlib.errors import InputError, did_you_mean
from factorlib.meshes.fine import fine
from factorlib.meshes.gltf import check_count, read_gltf
from factorlib.meshes.limits import NO_LIMITS, Limits
from factorlib.meshes.mesh import Mesh, area_vectors
from factorlib.meshes.normals import consistently_wound, corner_normals, welded
from factorlib.meshes.obj import read_obj
from factorlib.meshes.ply import read_ply
from factorlib.meshes.soup import Soup, check
from factorlib.meshes.stl import read_off, read_stl
from factorlib.reading import one_line, read_bytes, reading

WITHIN = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".off": read_off}  # all in one file
FORMATS = (*WITHIN, ".glb", ".gltf")
CURE = "is it whole? try to open and export it again"
CREASE_DEG = 60.0
log = logging.getLogger("factorlib.meshes")


def read_mesh(
    path: str | Path,
    materials: Sequence[str],
    made_of: Mapping[str, str] | str | None = None,
    overrides: Mapping[str, str] | None = None,
    crease_deg: float = CREASE_DEG,
    limits: Limits | None = None,
) -> Mesh:
    """The mesh of one object, labelled by material.

    materials   the dataset's, in order: label k is the k-th, from 1
    made_of     part -> material, or the material of the whole mesh; `overrides` (part -> material) go before it
    crease_deg  edges sharper than this stay sharp in the normals
    limits      how large it may be

    Raises InputError, and nothing else, for a file that cannot be read, is larger, or has no usable faces, a vertex that is not
    finite, a part of the mesh that has no material, a named part that the mesh lacks, and a material that the dataset lacks.
    """
    soup = _soup(path, limits)
    label = part_labels(soup.parts, materials, made_of, overrides or {}, path)
    return usable(soup, label[soup.part], crease_deg, path)


def read_parts(path: str | Path, limits: Limits | None = None) -> list[tuple[str, ...]]:
    """The names of each part of a mesh file in which everything but its materials is as `read_mesh` needs it."""
    soup = _soup(path, limits)
    solid(soup, path)
    return soup.parts


class MeshesOnce:
    """Meshes of a data set, each read once for each choice of materials for its parts; sizes were limited by an earlier stage.

    path: of a mesh by its name and, where it has one, its file in dataset.yaml (`Inputs.mesh`);  materials: the data set's;  crease_deg: as of `read_mesh`
    displacements, log_factors: by mesh, those that `surface` found at its nodes: such a mesh is subdivided, moved and given detail
    """

    def __init__(
        self,
        path: Callable[[str, str | None], Path],
        materials: Sequence[str],
        crease_deg: float,
        displacements: Mapping[str, Sequence[float]] = {},
        log_factors: Mapping[str, Sequence[float]] = {},
    ):
        self.path, self.materials, self.crease_deg = path, materials, crease_deg
        self.displacements, self.log_factors = displacements, log_factors
        self._meshes: dict[tuple, Mesh] = {}

    def mesh(self, name: str, entry: MeshEntry, overrides: Mapping[str, str] = {}) -> Mesh:
        """The mesh `name` with `overrides` of its parts' materials, read when first asked for."""
        key = (name, *sorted(overrides.items()))
        if key not in self._meshes:
            file = self.path(name, entry.file)
            mesh = read_mesh(file, self.materials, entry.made_of, overrides, self.crease_deg, NO_LIMITS)
            if name in self.displacements or name in self.log_factors:
                dense = fine(mesh)
                still = np.zeros(dense.nodes)
                moves, factors = (np.array(of.get(name, still)) for of in (self.displacements, self.log_factors))
                if not len(moves) == len(factors) == dense.nodes:
                    found, cure = "it is not the mesh that the stage `surface` moved", "run `surface` again"
                    raise InputError(found, file=file, cure=cure)
                detail = np.exp(factors)[dense.node] if name in self.log_factors else None
                mesh = msgspec.structs.replace(dense.moved(moves), detail=detail)
            self._meshes[key] = mesh
        return self._meshes[key]


def _soup(path: str | Path, limits: Limits | None) -> Soup:
    path, limits = Path(path), limits or Limits()
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"unknown mesh format {path.suffix!r}", file=path, cure="use one of " + ", ".join(FORMATS))
    with reading(f"a mesh ({suffix[1:].upper()})", path, cure=CURE):
        if suffix in WITHIN:
            soup = WITHIN[suffix](path, read_bytes(path, "a mesh", most_bytes=limits.bytes), limits)
        else:
            soup = read_gltf(path, limits)
    check_count(len(soup.parts), path)
    return check(soup, path)


def part_labels(
    names: Sequence[tuple[str, ...]],
    materials: Sequence[str],
    made_of: Mapping[str, str] | str | None,
    overrides: Mapping[str, str],
    file: str | Path,
) -> np.ndarray:
    """Material label (int16, from 1) of each part of a file, given the names it goes by.

    made_of: part -> material, or the material of all parts;  overrides: part -> material, which go before it

    >>> part_labels([("shell",), ("legs", "wood")], ["red", "oak"], {"shell": "red", "wood": "oak"}, {}, "a.obj").tolist()
    [1, 2]
    """
    known = sorted({name for each in names for name in each})
    parts, default = ({}, made_of) if isinstance(made_of, str) else (made_of or {}, None)
    for part, material in [*parts.items(), *overrides.items(), *([(None, default)] if default is not None else [])]:
        if part is not None and part not in known:
            cure = did_you_mean(part, [one_line(name) for name in known])
            raise InputError(f"the mesh has no part {part!r}", file=file, key=part, cure=cure)
        if material not in materials:
            cure = did_you_mean(material, materials)
            raise InputError(f"unknown material {material!r}", file=file, key=part, cure=cure)
    labels = []
    for goes_by in names:
        chosen = next(filter(None, ({m[n] for n in goes_by if n in m} for m in (overrides, parts))), {default})
        called = one_line(" / ".join(goes_by)) or "(unnamed)"
        if len(chosen) > 1:
            fault = f"part {called} gets several materials: {', '.join(sorted(chosen))}"
            raise InputError(fault, file=file, cure="name it once")
        if None in chosen:
            example = f"add it to `parts`, e.g. {one_line(goes_by[0])}: {materials[0]}" if goes_by else None
            cure = example or "name it in an editor"
            raise InputError(f"part {called} has no material", file=file, key=called, cure=cure)
        labels.append(list(materials).index(*chosen) + 1)
    return np.array(labels, dtype=np.int16)


def usable(soup: Soup, face_label: np.ndarray, crease_deg: float, file: str | Path) -> Mesh:
    """Welded, without zero-area and duplicate faces, consistently wound, with normals; InputError if nothing is left."""
    vertices, faces, keep = solid(soup, file)
    faces, face_label, supplied = faces[keep], face_label[keep], soup.normals[keep]
    flip, is_open = consistently_wound(vertices, faces)
    faces = np.where(flip[:, None], faces[:, ::-1], faces)
    supplied = np.where(flip[:, None, None], -supplied[:, ::-1], supplied)
    if flip.any():
        log.info("%s: %d faces turned to agree with their neighbours", file, int(flip.sum()))
    normals = merged_normals(corner_normals(vertices, faces, crease_deg), supplied, area_vectors(vertices, faces))
    # one vertex per position and normal
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


def solid(soup: Soup, file: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Welded vertices, the faces by these, and which of them have an area and are no copies, which the log counts; InputError if none."""
    used, faces = np.unique(soup.faces, return_inverse=True)  # a stray vertex far away must not set the scale
    weld = welded(soup.vertices[used])
    vertices = soup.vertices[used][np.unique(weld, return_index=True)[1]]
    faces = weld[faces.reshape(-1, 3)]
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    solid = distinct & (np.linalg.norm(area_vectors(vertices, faces), axis=1) > 1e-14 * extent**2)
    single = np.zeros(len(faces), bool)  # no copy of an earlier one, in either winding
    single[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]] = True
    for count, what in ((int((~solid).sum()), "zero-area"), (int((solid & ~single).sum()), "duplicate")):
        if count:
            log.info("%s: %d %s faces dropped", file, count, what)
    if not (solid & single).any():
        raise InputError("every face has zero area", file=file, cure="is the mesh flat to a line, or its scale zero?")
    return vertices, faces, solid & single


def merged_normals(own: np.ndarray, supplied: np.ndarray, area: np.ndarray) -> np.ndarray:
    """[F, 3, 3]: the file's normals where they are sane (unit length, within 75° of the face's), else our own."""
    with np.errstate(all="ignore"):  # a file may hold any number for a normal; what is not sane is not used
        length = np.linalg.norm(supplied, axis=-1, keepdims=True)
        unit = supplied / length
        face = (area / np.linalg.norm(area, axis=1, keepdims=True))[:, None, :]
        right_length = np.isfinite(unit).all(axis=-1) & (np.abs(length[..., 0] - 1) < 0.05)
        sane = right_length & (np.sum(unit * face, axis=-1) > 0.26)
    return np.where(sane[..., None], unit, own)
