"""Reader of glTF and GLB: the triangles of every node of the scene, in the scene's frame; each primitive is a part.

The names of a part are that of its primitive (its mesh's, numbered from the second on: `chair`, `chair_1`), that of its
node if the mesh has no other primitive, and that of its material. Sizes in the header are checked before any buffer is
opened. trimesh decodes the buffers; it is imported on first use, which takes a third of a second. It would skip fans
and take sparse accessors for zeros, so both are refused here.
"""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.dataset.gltf_header import CURE, GltfHeader, Primitive, buffer_path, read_header
from factorlib.errors import InputError
from factorlib.meshes.triangle_soup import Limits, TriangleSoup, floats, no_normals, normals_at_corners
from factorlib.reading import read_bytes

POINTS = 0  # modes of primitives
LINES = 1
TRIANGLES = 4
STRIP = 5
FAN = 6
DECODED = (POINTS, LINES, TRIANGLES, STRIP)  # modes to which trimesh gives a name and an array of vertices
UNNAMED = "GLTF"


Part = tuple[Primitive, tuple[str, ...], Float[np.ndarray, "4 4"]]  # primitive, its names, world_from_node


def read_gltf(path: Path, limits: Limits) -> TriangleSoup:
    """Read a glTF or GLB file: check the sizes in its header, then decode the primitives and join them.

    Raises:
        InputError: If the file is malformed or too large.
        ValueError: If its nodes do not form a tree; other exceptions of trimesh are possible too.
    """
    from trimesh.exchange.gltf import load_glb, load_gltf

    header = read_header(path, most_bytes=limits.bytes)
    load = load_glb if path.suffix.lower() == ".glb" else load_gltf
    try:
        instances = [node.mesh for node in header.nodes if node.mesh is not None]
        limits.check_parts(sum(len(header.meshes[mesh].primitives) for mesh in instances), path)
        parts = _parts(header)
        sizes = np.array([_size(primitive, header, path) for primitive, _, _ in parts], object).reshape(-1, 2)
        vertices, triangles = sizes.sum(axis=0).tolist()
        limits.check(vertices, triangles, path)
        content = io.BytesIO(read_bytes(path, "glTF", most_bytes=limits.bytes))
        with np.errstate(all="ignore"):  # values that are not finite are refused later
            decoded = load(content, resolver=_BufferFiles(header, path, limits), skip_materials=True)["geometry"]
            primitives = [each for mesh in header.meshes for each in mesh.primitives if each.mode in DECODED]
            arrays = {id(each): array for each, array in zip(primitives, decoded.values(), strict=True)}
            return _join_primitives([part for part, size in zip(parts, sizes) if size[1]], arrays, header)
    except (LookupError, AssertionError) as error:
        fault = f"its header names a node, an array or a part of a buffer that the file does not have ({error!r})"
        raise InputError(fault, file=path, cure=CURE) from error


class _BufferFiles(dict[str, bytes]):
    """Files of a glTF's buffers as trimesh asks for them, all together within the limits."""

    def __init__(self, header: GltfHeader, path: Path, limits: Limits):
        super().__init__()
        self.buffers = header.buffers
        self.path = path
        self.bytes_left = limits.bytes

    def __missing__(self, uri: str) -> bytes:
        """Return the content of the file at `uri`; InputError if it is shorter than the header states, or too large."""
        name = buffer_path(uri)
        if name is None:
            raise ValueError("a buffer's data: URI is not base64")
        content = read_bytes(self.path.parent / name, "a glTF buffer", most_bytes=max(self.bytes_left, 0))
        self.bytes_left -= len(content)
        index, length = max(((k, b.byteLength) for k, b in enumerate(self.buffers) if b.uri == uri), key=lambda k: k[1])
        if len(content) < length:
            raise InputError(
                f"buffer {index} has {len(content)} bytes, but the header states {length}", file=self.path, cure=CURE
            )
        return content


def _parts(header: GltfHeader) -> list[Part]:
    """Return the primitives of the scene's nodes, in the order of the nodes; ValueError if they do not form a tree."""
    from trimesh.util import unique_name

    used: dict[str, None] = {}
    counts: dict[str | None, int] = {}
    names: list[list[str]] = []
    for mesh in header.meshes:
        names.append([])
        for _ in mesh.primitives:
            names[-1].append(unique_name(mesh.name or UNNAMED, used, counts))
            used[names[-1][-1]] = None
    parts = []
    for index, world_from_node in sorted(_world_from_nodes(header).items()):
        node = header.nodes[index]
        if node.mesh is None:
            continue
        primitives = header.meshes[node.mesh].primitives
        node_name = (node.name or str(index)) if len(primitives) == 1 else None
        for name, primitive in zip(names[node.mesh], primitives):
            material = header.materials[primitive.material].name if primitive.material is not None else None
            known = dict.fromkeys(filter(None, (name, node_name, material)))
            parts.append((primitive, tuple(known), world_from_node))
    return parts


def _world_from_nodes(header: GltfHeader) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return world_from_node of every node of the scene; without scenes, of every node."""
    from trimesh.transformations import quaternion_matrix

    if header.scenes:
        roots = header.scenes[header.scene or 0].nodes
    else:
        below = {child for node in header.nodes for child in node.children}
        roots = [index for index in range(len(header.nodes)) if index not in below]
    places: dict[int, np.ndarray] = {}
    waiting = [(index, np.eye(4)) for index in roots]
    while waiting:
        index, world_from_parent = waiting.pop()
        node = header.nodes[index]
        if index in places:
            raise ValueError(f"its node {index} has two parents, or is its own ancestor")
        if not any(node.rotation):
            raise ValueError("the rotation of a node is the quaternion 0 0 0 0")
        with np.errstate(all="ignore"):  # values that are not finite are refused with the vertices
            # parent_from_node: the node's matrix, by columns; or scale, then rotation (x y z w), then translation
            if node.matrix is not None:
                parent_from_node = np.array(node.matrix, float).reshape(4, 4).T
            else:
                parent_from_node = quaternion_matrix(np.roll(node.rotation, 1))
                parent_from_node[:3, :3] *= node.scale
                parent_from_node[:3, 3] = node.translation
            places[index] = world_from_parent @ parent_from_node
        waiting += [(child, places[index]) for child in node.children]
    return places


def _size(primitive: Primitive, header: GltfHeader, path: Path) -> tuple[int, int]:
    """Return the numbers of vertices and triangles by the header; 0 for lines and points."""
    if primitive.mode == FAN:
        raise InputError("has a triangle fan, which is not read", file=path, cure="export it again, as triangles")
    if primitive.mode not in (TRIANGLES, STRIP):
        return 0, 0
    if "POSITION" not in primitive.attributes:
        raise InputError("a primitive has no positions (attribute POSITION)", file=path, cure=CURE)
    used = [
        header.accessors[primitive.attributes[name]] for name in ("POSITION", "NORMAL") if name in primitive.attributes
    ]
    corners = used[0] if primitive.indices is None else header.accessors[primitive.indices]
    if any(accessor.sparse is not None for accessor in (*used, corners)):
        raise InputError(
            "stores its triangles in a sparse accessor, which is not read",
            file=path,
            cure="export it again, without sparse accessors",
        )
    vertices = used[0].count
    if used[-1].count != vertices:
        fault = f"a primitive has {used[-1].count} normals for {vertices} positions; the counts must be equal"
        raise InputError(fault, file=path, cure=CURE)
    return vertices, corners.count // 3 if primitive.mode == TRIANGLES else max(corners.count - 2, 0)


def _join_primitives(parts: list[Part], arrays: dict[int, dict], header: GltfHeader) -> TriangleSoup:
    """Join all primitives in the scene's frame; normals transform by the cofactors of the linear part.

    Args:
        parts: Primitives with triangles.
        arrays: Arrays of a primitive as trimesh decodes them, by its `id`.
        header: Header of the file.
    """
    vertices = [np.empty((0, 3))]
    faces = [np.empty((0, 3), np.int64)]
    normals = [no_normals(0)]
    offset = 0
    for primitive, _, world_from_node in parts:
        array = arrays[id(primitive)]
        points = _vectors(array["vertices"], header.accessors[primitive.attributes["POSITION"]].normalized)
        corners = array["faces"].astype(np.int64)
        linear = world_from_node[:3, :3]
        vertices.append(points @ linear.T + world_from_node[:3, 3])
        cofactor = np.cross(np.roll(linear, -1, axis=0), np.roll(linear, -2, axis=0))
        if "NORMAL" in primitive.attributes:
            normals.append(normals_at_corners(_vectors(array["vertex_normals"], True) @ cofactor.T, corners))
        else:
            normals.append(no_normals(len(corners)))
        faces.append(np.where((corners >= 0) & (corners < len(points)), corners + offset, -1))
        offset += len(points)
    part = np.repeat(np.arange(len(parts)), [len(each) for each in faces[1:]])
    names = [names for _, names, _ in parts]
    return TriangleSoup(np.concatenate(vertices), np.concatenate(faces), part, names, np.concatenate(normals))


def _vectors(values: np.ndarray, normalized: bool) -> Float[np.ndarray, "v 3"]:
    """Convert vectors to floats; normalized integers, which trimesh leaves as they are, to at most 1."""
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"a position or normal has {values.shape[-1]} numbers, not 3")
    return floats(values) / (np.iinfo(values.dtype).max if normalized and values.dtype.kind in "iu" else 1)
