"""Reader of mesh files (OBJ, glTF/GLB, PLY, STL, OFF) that turns their parts into material labels.

A part has every name that the file gives it (OBJ: usemtl, group, object; glTF: primitive, node, material; the other
formats have one part, named as the file). Unusable faces are dropped and counted in the log. Faults that would silently
give a wrong result raise InputError.
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.dataset.schema import MeshEntry
from factorlib.errors import InputError, did_you_mean
from factorlib.meshes.gltf_mesh import read_gltf
from factorlib.meshes.mesh import Mesh, area_vectors, corner_normals, find_flipped_faces, weld_vertices
from factorlib.meshes.obj import read_obj
from factorlib.meshes.ply_stl_off import read_off, read_ply, read_stl
from factorlib.meshes.subdivision import SubdividedMesh, subdivided_mesh
from factorlib.meshes.triangle_soup import (
    NO_LIMITS,
    Limits,
    TriangleSoup,
    check_soup,
)
from factorlib.reading import one_line, read_bytes, reading

WITHIN = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".off": read_off}  # formats of a single file
FORMATS = (*WITHIN, ".glb", ".gltf")
CURE = "the file may be incomplete: open it in a mesh editor and export it again"
CREASE_DEG = 60.0
log = logging.getLogger("factorlib.meshes")


def read_mesh(
    path: str | Path,
    materials: Sequence[str],
    part_materials: Mapping[str, str] | str | None = None,
    overrides: Mapping[str, str] | None = None,
    crease_deg: float = CREASE_DEG,
    limits: Limits | None = None,
) -> Mesh:
    """Read the mesh of one object, labelled by material.

    Args:
        path: File of the mesh.
        materials: Materials of the dataset, in order: label k is the k-th, from 1.
        part_materials: Material of each part, or of the whole mesh.
        overrides: Material of some parts, with precedence over `part_materials`.
        crease_deg: Edges of a greater angle stay sharp in the normals.
        limits: Limits on the size.

    Returns:
        The mesh.

    Raises:
        InputError: If the file cannot be read or is too large; if it has no usable faces, or a vertex that is not
            finite; if a part has no material; if a named part is not in the mesh, or a material not in the dataset.
    """
    soup = _soup(path, limits)
    label = part_labels(soup.parts, materials, part_materials, overrides or {}, path)
    return usable(soup, label[soup.part], crease_deg, path)


def read_parts(path: str | Path, limits: Limits | None = None) -> list[tuple[str, ...]]:
    """Return the names of each part of a mesh file, which must be usable by `read_mesh` but for its materials."""
    soup = _soup(path, limits)
    solid(soup, path)
    return soup.parts


class MeshCache:
    """Cache of a dataset's meshes, each read once for each choice of materials; an earlier stage checked the sizes.

    path            path of a mesh, by its name and, if it has one, its file in dataset.yaml (`Inputs.mesh`)
    materials       materials of the dataset
    crease_deg      crease angle, as in `read_mesh`
    displacements   by mesh, displacements at the nodes that `surface` estimated; the mesh is subdivided and moved
    log_factors     by mesh, logarithms of the detail at the nodes that `surface` estimated
    textures        by mesh, longest edge of the subdivided mesh, and factors at its nodes by material, from `texture`
    """

    def __init__(
        self,
        path: Callable[[str, str | None], Path],
        materials: Sequence[str],
        crease_deg: float,
        displacements: Mapping[str, Sequence[float]] = {},
        log_factors: Mapping[str, Sequence[tuple[float, float, float]]] = {},
        textures: Mapping[str, tuple[float, Mapping[str, Float[np.ndarray, "v 3"]]]] = {},
    ):
        self.path = path
        self.materials = materials
        self.crease_deg = crease_deg
        self.displacements = displacements
        self.log_factors = log_factors
        self.textures = textures
        self._meshes: dict[tuple, Mesh] = {}

    def mesh(self, name: str, entry: MeshEntry, overrides: Mapping[str, str] = {}) -> Mesh:
        """Return the mesh `name` with `overrides` of its parts' materials, read on first use.

        Args:
            name: Name of the mesh.
            entry: Entry of the mesh in dataset.yaml.
            overrides: Material of some parts.

        Returns:
            The mesh.

        Raises:
            InputError: If the mesh cannot be read, or is not the one that `surface` moved.
        """
        key = (name, *sorted(overrides.items()))
        if key not in self._meshes:
            file = self.path(name, entry.file)
            mesh = read_mesh(file, self.materials, entry.part_materials, overrides, self.crease_deg, NO_LIMITS)
            if name in self.displacements or name in self.log_factors:
                dense = subdivided_mesh(mesh)
                still = np.zeros(dense.nodes)
                moves, factors = (np.array(table.get(name, still)) for table in (self.displacements, self.log_factors))
                _check_nodes([moves, factors], dense, file, "surface")
                detail = np.exp(factors)[dense.node] if name in self.log_factors else None
                mesh = msgspec.structs.replace(dense.displace(moves), detail=detail)
            self._meshes[key] = self._textured(mesh, name, file)
        return self._meshes[key]

    def _textured(self, mesh: Mesh, name: str, file: Path) -> Mesh:
        """Return the mesh `name` of a file, subdivided, with its textures as detail; itself if it has none.

        All choices of materials have the same faces, also those without a textured material.
        """
        longest, factors = self.textures.get(name, (0.0, {}))
        if not factors:
            return mesh
        fine = subdivided_mesh(mesh, longest)
        _check_nodes(factors.values(), fine, file, "texture")
        labels = [label for label in mesh.labels if self.materials[label - 1] in factors]
        if not labels:
            return fine.mesh
        detail = np.ones((len(fine.mesh.vertices), 3)) if fine.mesh.detail is None else fine.mesh.detail.copy()
        for label in labels:
            vertices = np.unique(fine.mesh.faces[fine.mesh.face_label == label])
            detail[vertices] = factors[self.materials[label - 1]][fine.node[vertices]]
        return msgspec.structs.replace(fine.mesh, detail=detail)


def _check_nodes(values: Iterable[np.ndarray], mesh: SubdividedMesh, file: Path, stage: str) -> None:
    """Check that there is one value for each node, as a stage estimated them; InputError otherwise."""
    if any(len(one) != mesh.nodes for one in values):
        raise InputError(
            f"this is not the mesh whose surface the stage `{stage}` estimated", file=file, cure=f"run `{stage}` again"
        )


def _soup(path: str | Path, limits: Limits | None) -> TriangleSoup:
    """Read a file by its format and check the result."""
    path = Path(path)
    limits = limits or Limits()
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"unknown mesh format {path.suffix!r}", file=path, cure="use one of " + ", ".join(FORMATS))
    with reading(f"a mesh ({suffix[1:].upper()})", path, cure=CURE):
        if suffix in WITHIN:
            soup = WITHIN[suffix](path, read_bytes(path, "a mesh", most_bytes=limits.bytes), limits)
        else:
            soup = read_gltf(path, limits)
    limits.check_parts(len(soup.parts), path)
    return check_soup(soup, path)


def part_labels(
    names: Sequence[tuple[str, ...]],
    materials: Sequence[str],
    part_materials: Mapping[str, str] | str | None,
    overrides: Mapping[str, str],
    file: str | Path,
) -> np.ndarray:
    """Return the material label (int16, from 1) of each part of a file.

    Args:
        names: Names of each part.
        materials: Materials of the dataset, in order.
        part_materials: Material of each part, or of all parts.
        overrides: Material of some parts, with precedence over `part_materials`.
        file: File to name in errors.

    Raises:
        InputError: If a part is unknown, or has no material or several; if a material is unknown.

    >>> part_materials = {"shell": "red", "wood": "oak"}
    >>> part_labels([("shell",), ("legs", "wood")], ["red", "oak"], part_materials, {}, "a.obj").tolist()
    [1, 2]
    """
    known = sorted({name for each in names for name in each})
    parts, default = ({}, part_materials) if isinstance(part_materials, str) else (part_materials or {}, None)
    for part, material in [*parts.items(), *overrides.items(), *([(None, default)] if default is not None else [])]:
        if part is not None and part not in known:
            cure = did_you_mean(part, [one_line(name) for name in known])
            raise InputError(f"the mesh has no part {part!r}", file=file, key=part, cure=cure)
        if material not in materials:
            raise InputError(
                f"unknown material {material!r}", file=file, key=part, cure=did_you_mean(material, materials)
            )
    labels = []
    for part_names in names:
        candidates = next(filter(None, ({m[n] for n in part_names if n in m} for m in (overrides, parts))), {default})
        title = one_line(" / ".join(part_names)) or "(unnamed)"
        if len(candidates) > 1:
            raise InputError(
                f"part {title} gets several materials: {', '.join(sorted(filter(None, candidates)))}",
                file=file,
                cure="give a material to one of its names only",
            )
        if None in candidates:
            example = f"add it to `parts`, e.g. {one_line(part_names[0])}: {materials[0]}" if part_names else None
            cure = example or "name the part in a mesh editor"
            raise InputError(f"part {title} has no material", file=file, key=title, cure=cure)
        labels.append(list(materials).index(*candidates) + 1)
    return np.array(labels, dtype=np.int16)


def usable(soup: TriangleSoup, face_label: np.ndarray, crease_deg: float, file: str | Path) -> Mesh:
    """Weld vertices, drop zero-area and duplicate faces, orient the faces consistently, and compute normals.

    Args:
        soup: Triangles as read.
        face_label: Label of each face.
        crease_deg: Edges of a greater angle stay sharp in the normals.
        file: File to name in errors.

    Returns:
        The mesh.

    Raises:
        InputError: If no face is left.
    """
    vertices, faces, keep = solid(soup, file)
    faces = faces[keep]
    face_label = face_label[keep]
    supplied = soup.normals[keep]
    flip, is_open = find_flipped_faces(vertices, faces)
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


def solid(soup: TriangleSoup, file: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return welded vertices, the faces on them, and a mask of the faces that have an area and are not duplicates.

    The others are counted in the log.

    Raises:
        InputError: If no face is left.
    """
    used, faces = np.unique(soup.faces, return_inverse=True)  # an unused vertex far away must not set the scale
    weld = weld_vertices(soup.vertices[used])
    vertices = soup.vertices[used][np.unique(weld, return_index=True)[1]]
    faces = weld[faces.reshape(-1, 3)]
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    solid = distinct & (np.linalg.norm(area_vectors(vertices, faces), axis=1) > 1e-14 * extent**2)
    single = np.zeros(len(faces), bool)  # no duplicate of an earlier face, in either winding
    single[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]] = True
    for count, defect in ((int((~solid).sum()), "zero-area"), (int((solid & ~single).sum()), "duplicate")):
        if count:
            log.info("%s: %d %s faces dropped", file, count, defect)
    if not (solid & single).any():
        raise InputError(
            "every face has zero area",
            file=file,
            cure="correct it in a mesh editor: it is flattened to a line or a point, or its scale is zero",
        )
    return vertices, faces, solid & single


def merged_normals(computed: np.ndarray, supplied: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Return the file's corner normals where they are sane, else the computed ones.

    Sane normals have unit length and are within 75° of the face's normal.

    Args:
        computed: Computed normals, [F, 3, 3].
        supplied: Normals of the file, [F, 3, 3], NaN if there are none.
        area: Area vectors of the faces, [F, 3].

    Returns:
        Normals, [F, 3, 3].
    """
    with np.errstate(all="ignore"):  # a file may have any number for a normal
        length = np.linalg.norm(supplied, axis=-1, keepdims=True)
        unit = supplied / length
        face = (area / np.linalg.norm(area, axis=1, keepdims=True))[:, None, :]
        right_length = np.isfinite(unit).all(axis=-1) & (np.abs(length[..., 0] - 1) < 0.05)
        sane = right_length & (np.sum(unit * face, axis=-1) > 0.26)
    return np.where(sane[..., None], unit, computed)
