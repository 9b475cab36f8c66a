"""Reader of glTF and GLB: the triangles of every node of the scene, in the scene's frame; each primitive is a part.

The names of a part are that of its primitive (its mesh's, numbered from the second on: `chair`, `chair_1`), that of its
node if the mesh has no other primitive, and that of its material. Sizes in the header are checked before any buffer is
opened.
"""

import base64
from pathlib import Path
from urllib.parse import unquote_to_bytes

import numpy as np
from jaxtyping import Float, Int

from factorlib.dataset.gltf import BEFORE_JSON, CURE, Header, Node, Primitive, buffer_path, read_header
from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.soup import Soup, at_corners, floats, no_normals
from factorlib.reading import read_bytes

COMPONENTS: dict[int | None, str] = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TRIANGLES, STRIP, FAN = 4, 5, 6
UNNAMED = "GLTF"
MOST_PARTS = 100_000  # greatest number of parts of one file


Placed = tuple[Primitive, tuple[str, ...], Float[np.ndarray, "4 4"]]  # primitive, its names, world_from_node


def check_count(parts: int, file: str | Path) -> None:
    """Raise InputError for more than MOST_PARTS parts in one file."""
    if parts > MOST_PARTS:
        cure = f"join parts of one material: at most {MOST_PARTS:,} are read"
        raise InputError(f"has {parts:,} parts", file=file, cure=cure)


def read_gltf(path: Path, limits: Limits) -> Soup:
    """Read a glTF or GLB file.

    Raises:
        InputError: If the file is malformed or too large.
        ValueError: If an index of its header is out of range; other exceptions are possible too.
    """
    header = read_header(path, most_bytes=limits.bytes)
    check_count(sum(len(header.meshes[node.mesh].primitives) for node in header.nodes if node.mesh is not None), path)
    places = _placed(header)
    sizes = np.array([_size(primitive, header, path) for primitive, _, _ in places], object).reshape(-1, 2)
    vertices, triangles = sizes.sum(axis=0).tolist()
    limits.check(vertices, triangles, path)
    return _joined([place for place, size in zip(places, sizes) if size[1]], _Buffers(header, path, limits))


# ── scene graph ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _placed(header: Header) -> list[Placed]:
    """Return the primitives of the scene's nodes, in the order of the nodes; ValueError if the nodes are no tree."""
    used: dict[str, int] = {}  # number of requests for each name
    names = [[_unused(mesh.name or UNNAMED, used) for _ in mesh.primitives] for mesh in header.meshes]
    places = []
    for index, world_from_node in sorted(_world_from_nodes(header).items()):
        node = header.nodes[index]
        if node.mesh is None:
            continue
        primitives = header.meshes[node.mesh].primitives
        for k, primitive in enumerate(primitives):
            own = (node.name or str(index),) if len(primitives) == 1 else ()
            material = header.materials[primitive.material].name if primitive.material is not None else None
            known = dict.fromkeys(name for name in (names[node.mesh][k], *own, material) if name)
            places.append((primitive, tuple(known), world_from_node))
    return places


def _unused(name: str, used: dict[str, int]) -> str:
    """Return `name`, with a number if it is taken, and record it in `used`."""
    number = used.get(name, 0)
    free = f"{name}_{number}" if number else name
    while number and free in used:
        number += 1
        free = f"{name}_{number}"
    used[name] = number + 1
    used.setdefault(free, 1)
    return free


def _world_from_nodes(header: Header) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return world_from_node of every node of the scene; without scenes, of every node."""
    if header.scenes:
        roots = header.scenes[header.scene or 0].nodes
    else:
        below = {child for node in header.nodes for child in node.children}
        roots = [index for index in range(len(header.nodes)) if index not in below]
    places: dict[int, np.ndarray] = {}
    waiting = [(index, np.eye(4)) for index in roots]
    while waiting:
        index, world_from_parent = waiting.pop()
        if index in places:
            raise ValueError(f"its node {index} is below two others, or below itself")
        with np.errstate(all="ignore"):  # values that are not finite are refused with the vertices
            places[index] = world_from_parent @ _parent_from_node(header.nodes[index])
        waiting += [(child, places[index]) for child in header.nodes[index].children]
    return places


def _parent_from_node(node: Node) -> Float[np.ndarray, "4 4"]:
    """Return parent_from_node.

    It is the node's matrix (stored by columns), or scale, then rotation (quaternion x y z w), then translation.
    """
    if node.matrix is not None:
        return np.array(node.matrix, float).reshape(4, 4).T
    x, y, z, w = np.array(node.rotation) / np.linalg.norm(node.rotation)
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.array(turn) * node.scale, node.translation
    return matrix


def _size(primitive: Primitive, header: Header, path: Path) -> tuple[int, int]:
    """Return the numbers of vertices and triangles by the header; 0 for lines and points."""
    if primitive.mode not in (TRIANGLES, STRIP, FAN):
        return 0, 0
    if "POSITION" not in primitive.attributes:
        raise InputError("a primitive has no POSITION", file=path, cure=CURE)
    vertices = header.accessors[primitive.attributes["POSITION"]].count
    if "NORMAL" in primitive.attributes and header.accessors[primitive.attributes["NORMAL"]].count != vertices:
        raise InputError("a primitive has another number of NORMAL than of POSITION", file=path, cure=CURE)
    corners = vertices if primitive.indices is None else header.accessors[primitive.indices].count
    return vertices, corners // 3 if primitive.mode == TRIANGLES else max(corners - 2, 0)


# ── buffers and triangles ────────────────────────────────────────────────────────────────────────────────────────────


class _Buffers:
    """Buffers of a glTF, each read on first use, all together within the limits."""

    def __init__(self, header: Header, path: Path, limits: Limits):
        self.header = header
        self.path = path
        self.left = limits.bytes
        self.contents: dict[int, bytes] = {}

    def refused(self, fault: str) -> InputError:
        """Return an InputError for this file."""
        return InputError(fault, file=self.path, cure=CURE)

    def buffer(self, index: int) -> bytes:
        """Return the bytes of buffer `index`.

        Raises:
            InputError: If it is shorter than the header states, or larger than the limits.
        """
        if index not in self.contents:
            entry = self.header.buffers[index]
            content = self._content(entry.uri)
            if len(content) < entry.byteLength:
                raise self.refused(f"buffer {index} has {len(content)} of {entry.byteLength} bytes")
            self.contents[index] = content
            self.left = self.left - len(content)
        return self.contents[index]

    def _content(self, uri: str | None) -> bytes:
        """Read a buffer from a file, a data URI, or, without a URI, the second chunk of the .glb."""
        if uri is not None:
            near = buffer_path(uri)
            if near is not None:
                return read_bytes(self.path.parent / near, "a glTF buffer", most_bytes=max(self.left, 0))
            kind, _, text = uri.partition(",")
            return base64.b64decode(text, validate=True) if kind.endswith(";base64") else unquote_to_bytes(text)
        # second chunk of a .glb
        content = read_bytes(self.path, "glTF", most_bytes=self.left) if self.path.suffix.lower() == ".glb" else b""
        begin = BEFORE_JSON + int.from_bytes(content[12:16], "little")
        length = int.from_bytes(content[begin : begin + 4], "little")
        tag = content[begin + 4 : begin + 8]
        if tag != b"BIN\0" or begin + 8 + length > len(content):
            raise self.refused("its binary chunk is missing or cut short")
        return content[begin + 8 : begin + 8 + length]

    def array(self, index: int) -> np.ndarray:
        """Return the [count, width] array of an accessor, with normalized integers as floats."""
        accessor = self.header.accessors[index]
        width = WIDTHS[accessor.type]
        type_ = accessor.componentType
        sparse = accessor.sparse
        if accessor.bufferView is None:  # zeros, to be filled by `sparse`; the header's counts are within the limits
            values = np.zeros((accessor.count, width), COMPONENTS[type_])
        else:
            values = self._view(accessor.bufferView, accessor.byteOffset, type_, accessor.count, width)
        if sparse is not None and sparse.count:
            at = sparse.indices
            put = sparse.values
            values = values.copy()
            where = self._view(at.bufferView, at.byteOffset, at.componentType, sparse.count, 1)
            values[where[:, 0]] = self._view(put.bufferView, put.byteOffset, type_, sparse.count, width)
        return values / np.iinfo(values.dtype).max if accessor.normalized and values.dtype.kind in "iu" else values

    def _view(self, index: int, offset: int, component: int | None, count: int, width: int) -> np.ndarray:
        """Return a strided array over a buffer view; InputError if it exceeds the view."""
        view = self.header.bufferViews[index]
        kind = np.dtype(COMPONENTS[component])
        stride = view.byteStride or kind.itemsize * width
        last = offset + (count - 1) * stride + kind.itemsize * width
        data = self.buffer(view.buffer)
        if count and (last > view.byteLength or view.byteOffset + last > len(data)):
            raise self.refused(f"an accessor reaches beyond buffer view {index}")
        return np.ndarray((count, width), kind, data, view.byteOffset + offset if count else 0, (stride, kind.itemsize))

    def vectors(self, primitive: Primitive, attribute: str) -> Float[np.ndarray, "v 3"]:
        """Return an attribute of a primitive's vertices.

        Raises:
            InputError: If it has not three components.
        """
        values = self.array(primitive.attributes[attribute])
        if values.shape[1] != 3:
            raise self.refused(f"a {attribute} has {values.shape[1]} numbers, not 3")
        return floats(values)

    def faces(self, primitive: Primitive) -> Int[np.ndarray, "f 3"]:
        """Return the triangles of a list, a strip (every second one reversed) or a fan of corners."""
        if primitive.indices is not None:
            corners = self.array(primitive.indices)[:, 0].astype(np.int64)
        else:
            corners = np.arange(self.header.accessors[primitive.attributes["POSITION"]].count)
        if primitive.mode == TRIANGLES:
            if len(corners) % 3:
                raise self.refused(f"a primitive has {len(corners)} corners, which makes no triangles")
            return corners.reshape(-1, 3)
        first = np.full(max(len(corners) - 2, 0), corners[0]) if primitive.mode == FAN else corners[:-2]
        faces = np.stack([first, corners[1:-1], corners[2:]], axis=1)
        if primitive.mode == STRIP:
            faces[1::2] = faces[1::2, ::-1]
        return faces


def _joined(places: list[Placed], data: _Buffers) -> Soup:
    """Join all primitives in the scene's frame; normals transform by the cofactors of the linear part."""
    vertices = [np.empty((0, 3))]
    faces = [np.empty((0, 3), np.int64)]
    normals = [no_normals(0)]
    offset = 0
    for primitive, _, world_from_node in places:
        points = data.vectors(primitive, "POSITION")
        own = data.faces(primitive)
        linear, shift = world_from_node[:3, :3], world_from_node[:3, 3]
        of_corners = no_normals(len(own))
        with np.errstate(all="ignore"):  # values that are not finite are refused later
            vertices.append(points @ linear.T + shift)
            if "NORMAL" in primitive.attributes:
                cofactor = np.cross(np.roll(linear, -1, axis=0), np.roll(linear, -2, axis=0))
                of_corners = at_corners(data.vectors(primitive, "NORMAL") @ cofactor.T, own)
        normals.append(of_corners)
        faces.append(np.where((own >= 0) & (own < len(points)), own + offset, -1))
        offset += len(points)
    part = np.repeat(np.arange(len(places)), [len(own) for own in faces[1:]])
    names = [names for _, names, _ in places]
    return Soup(np.concatenate(vertices), np.concatenate(faces), part, names, np.concatenate(normals))
