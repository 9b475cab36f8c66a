"""Reader of glTF and GLB: the triangles of every node of the scene, in the scene's frame; each primitive is a part.

The names of a part are that of its primitive (its mesh's, numbered from the second on: `chair`, `chair_1`), that of its
node if the mesh has no other primitive, and that of its material. Sizes in the header are checked before arrays are
decoded.
"""

import base64
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from factorlib.dataset.gltf_header import BEFORE_JSON, CURE, GltfHeader, Primitive, buffer_path, read_header, unread
from factorlib.errors import InputError
from factorlib.meshes.triangle_soup import Limits, TriangleSoup, floats, normals_at_corners, strip_triangles
from factorlib.reading import read_bytes

TRIANGLES = 4  # modes of primitives
STRIP = 5
FAN = 6
UNNAMED = "GLTF"
KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}  # NumPy's names
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}  # numbers of an element


# primitive, its names, world_from_node, and the accessors of the node's instances by TRANSLATION, ROTATION and SCALE
Part = tuple[Primitive, tuple[str, ...], Float[np.ndarray, "4 4"], dict[str, int]]


def read_gltf(path: Path, limits: Limits) -> TriangleSoup:
    """Read a glTF or GLB file: check the sizes in its header, then decode the primitives and join them.

    Raises:
        InputError: If the file is too large, or is not read because of what it has.
        ValueError: If it is malformed; LookupError is possible too.
    """
    header = read_header(path, most_bytes=limits.bytes)
    meshes = [header.entry("meshes", node.mesh) for node in header.nodes if node.mesh is not None]
    limits.check_parts(sum(len(mesh.primitives) for mesh in meshes), path)
    with np.errstate(all="ignore"):  # values that are not finite are refused later
        parts = _parts(header, path)
        sizes = [_size(header, primitive, instances) for primitive, _, _, instances in parts]
        limits.check(sum(vertices for vertices, _ in sizes), sum(triangles for _, triangles in sizes), path)
        parts = [part for part, size in zip(parts, sizes) if size[1]]
        decoder = _Decoder(header, path, limits)
        pieces = [_piece(decoder, part) for part in parts] or [(np.empty((0, 3)),) * 3]
    points, normals, faces = zip(*pieces)
    starts = np.cumsum([0, *map(len, points)])
    corners = np.concatenate([each + start for each, start in zip(faces, starts)]).astype(np.int64)
    return TriangleSoup(
        vertices=np.concatenate(points),
        faces=corners,
        part=np.repeat(np.arange(len(faces)), [len(each) for each in faces]),
        parts=[names for _, names, *_ in parts],
        normals=normals_at_corners(np.concatenate(normals), corners),
    )


class _Decoder:
    """Decoder of accessors, with the content of all buffers."""

    def __init__(self, header: GltfHeader, path: Path, limits: Limits):
        self.header = header
        self.path = path
        self.buffers: list[bytes] = []
        for index, buffer in enumerate(header.buffers):
            if buffer.uri is None:  # the second chunk of a .glb
                content = b"" if index else read_bytes(path, "glTF", most_bytes=limits.bytes)
                start = BEFORE_JSON + int.from_bytes(content[12:16], "little") + 8
                content = content[start:] if content[start - 4 : start] == b"BIN\0" else b""
            elif (name := buffer_path(buffer.uri)) is None:
                content = base64.b64decode(buffer.uri.partition(";base64,")[2])
            else:
                left = limits.bytes - sum(map(len, self.buffers))
                content = read_bytes(path.parent / name, "a glTF buffer", most_bytes=max(left, 0))
            if len(content) < buffer.byteLength:
                names = unread(header.extensionsUsed)
                raise InputError(
                    f"buffers[{index}] has {len(content)} bytes, but the header states {buffer.byteLength}",
                    file=path,
                    cure=f"export it again without {names}" if names else CURE,
                )
            self.buffers.append(content)

    def array(self, index: int, width: int, count: int | None = None) -> Float[np.ndarray, "n w"]:
        """Return accessor `index` as floats; normalized integers become fractions.

        Args:
            index: Index of the accessor.
            width: Number of numbers of an element.
            count: Number of elements that it must have; None for any.
        """
        accessor = self.header.entry("accessors", index)
        if accessor.bufferView is None or accessor.sparse is not None:
            raise InputError(
                f"accessors[{index}] is sparse, or has no data",
                file=self.path,
                cure=f"export it again without {unread([*self.header.extensionsUsed, 'sparse accessors'])}",
            )
        count = accessor.count if count is None else count
        if WIDTHS.get(accessor.type) != width or accessor.count != count:
            raise ValueError(
                f"accessors[{index}] has {accessor.count} elements of type {accessor.type}, "
                f"where {count} of {width} numbers are needed"
            )
        view = self.header.entry("bufferViews", accessor.bufferView)
        data = memoryview(self.buffers[view.buffer])[view.byteOffset :][: view.byteLength]
        kind = np.dtype(KINDS[accessor.componentType])
        stride = view.byteStride or kind.itemsize * width
        needed = accessor.byteOffset + max(count - 1, 0) * stride + kind.itemsize * width
        if needed > len(data):
            raise ValueError(f"accessors[{index}] needs {needed:,} bytes of a buffer view, which has {len(data):,}")
        values = floats(np.ndarray((count, width), kind, data, accessor.byteOffset, (stride, kind.itemsize)))
        return np.maximum(values / np.iinfo(kind).max, -1) if accessor.normalized and kind.kind in "iu" else values


def _parts(header: GltfHeader, path: Path) -> list[Part]:
    """Return the primitives of the scene's nodes, in the order of the nodes; ValueError if they do not form a tree."""
    from trimesh.util import unique_name

    used: dict[str, None] = {}
    counts: dict[str | None, int] = {}
    for mesh in (each for each in header.meshes for _ in each.primitives):
        used[unique_name(mesh.name or UNNAMED, used, counts)] = None
    unused = iter(used)
    names = [[next(unused) for _ in mesh.primitives] for mesh in header.meshes]
    parts = []
    for index, world_from_node in sorted(_world_from_nodes(header).items()):
        node = header.nodes[index]
        if node.mesh is None:
            continue
        if node.skin is not None or any(node.weights or header.meshes[node.mesh].weights):
            raise InputError(
                f"nodes[{index}] is posed by a skin or by morph targets, which are not read",
                file=path,
                cure="apply the armature and the shape keys in a mesh editor, and export it again without them",
            )
        instances = node.extensions.get("EXT_mesh_gpu_instancing", {}).get("attributes", {})
        primitives = header.meshes[node.mesh].primitives
        node_name = (node.name or str(index)) if len(primitives) == 1 else None
        for name, primitive in zip(names[node.mesh], primitives):
            material = None if primitive.material is None else header.entry("materials", primitive.material).name
            known = dict.fromkeys(filter(None, (name, node_name, material)))
            parts.append((primitive, tuple(known), world_from_node, instances))
    return parts


def _world_from_nodes(header: GltfHeader) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return world_from_node of every node of the scene; without scenes, of every node."""
    if header.scenes:
        roots = header.entry("scenes", header.scene or 0).nodes
    else:
        below = {child for node in header.nodes for child in node.children}
        roots = [index for index in range(len(header.nodes)) if index not in below]
    places: dict[int, np.ndarray] = {}
    waiting = [(index, np.eye(4)) for index in roots]
    while waiting:
        index, world_from_parent = waiting.pop()
        node = header.entry("nodes", index)
        if index in places:
            raise ValueError(f"its node {index} has two parents, or is its own ancestor")
        # parent_from_node: the node's matrix, by columns; or of translation, rotation and scale
        if node.matrix is not None:
            parent_from_node = np.array(node.matrix, float).reshape(4, 4).T
        else:
            parent_from_node = _transforms(*np.atleast_2d(node.translation, node.rotation, node.scale))[0]
        places[index] = world_from_parent @ parent_from_node
        waiting += [(child, places[index]) for child in node.children]
    return places


def _transforms(
    translation: Float[np.ndarray, "n 3"], rotation: Float[np.ndarray, "n 4"], scale: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 4 4"]:
    """Return the transforms that scale, then rotate (quaternions x y z w), then translate; ValueError for 0 0 0 0."""
    from scipy.spatial.transform import Rotation

    transforms = np.tile(np.eye(4), (len(rotation), 1, 1))
    transforms[:, :3, :3] = Rotation.from_quat(rotation).as_matrix() * scale[:, None]
    transforms[:, :3, 3] = translation
    return transforms


def _instances(decoder: _Decoder, accessors: dict[str, int]) -> Float[np.ndarray, "n 4 4"]:
    """Return node_from_instance of each instance of a node."""
    count = max(decoder.header.entry("accessors", index).count for index in accessors.values())
    values = [
        decoder.array(accessors[name], len(value), count) if name in accessors else np.tile(value, (count, 1))
        for name, value in (("TRANSLATION", (0, 0, 0)), ("ROTATION", (0, 0, 0, 1)), ("SCALE", (1, 1, 1)))
    ]
    return _transforms(*values)


def _size(header: GltfHeader, primitive: Primitive, instances: dict[str, int]) -> tuple[int, int]:
    """Return the numbers of vertices and triangles of all instances by the header; 0 for lines and points."""
    if primitive.mode not in (TRIANGLES, STRIP, FAN):
        return 0, 0
    vertices = header.entry("accessors", primitive.attributes["POSITION"]).count
    corners = vertices if primitive.indices is None else header.entry("accessors", primitive.indices).count
    copies = max((header.entry("accessors", index).count for index in instances.values()), default=1)
    return copies * vertices, copies * (corners // 3 if primitive.mode == TRIANGLES else max(corners - 2, 0))


def _piece(decoder: _Decoder, part: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, their normals and the triangles of all instances of a primitive, in the scene's frame."""
    primitive, _, world_from_node, instances = part
    places = world_from_node @ _instances(decoder, instances) if instances else world_from_node[None]
    points = decoder.array(primitive.attributes["POSITION"], 3)
    count = len(points)
    normal = primitive.attributes.get("NORMAL")
    normals = np.full_like(points, np.nan) if normal is None else decoder.array(normal, 3, count)
    triangles = _triangles(decoder, primitive, count)
    # normals are transformed by the cofactors of the linear part; a mirror image turns normals and triangles
    linear = places[:, :3, :3]
    mirrored = (np.linalg.det(linear) < 0)[:, None, None]
    cofactor = np.cross(np.roll(linear, -1, axis=1), np.roll(linear, -2, axis=1)) * np.where(mirrored, -1, 1)
    points = points @ linear.transpose(0, 2, 1) + places[:, None, :3, 3]
    normals = normals @ cofactor.transpose(0, 2, 1)
    faces = np.where(mirrored, triangles[:, ::-1], triangles) + count * np.arange(len(places))[:, None, None]
    return points.reshape(-1, 3), normals.reshape(-1, 3), faces.reshape(-1, 3)


def _triangles(decoder: _Decoder, primitive: Primitive, count: int) -> Int[np.ndarray, "t 3"]:
    """Return the triangles of a primitive of `count` vertices; ValueError for a vertex that it does not have."""
    values = np.arange(count) if primitive.indices is None else decoder.array(primitive.indices, 1)[:, 0]
    corners = values.astype(np.int64)
    if (primitive.mode == TRIANGLES and len(corners) % 3) or (
        (corners != values) | (corners < 0) | (corners >= count)
    ).any():
        raise ValueError(
            f"the {len(corners)} corners of a primitive are no whole triangles, or not of its {count} vertices"
        )
    if primitive.mode == STRIP:
        return strip_triangles(corners)
    if primitive.mode == FAN:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    return corners.reshape(-1, 3)
