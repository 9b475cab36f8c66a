"""Triangle mesh that the pipeline can use: finite, without degenerate faces, with normals and material labels.

Smooth vertex normals of rough meshes: First, faces are flipped to agree with their neighbours, so that a few reversed
faces do not cancel the normals around them. The two orientations of every face are the nodes of a graph, whose
connected components are the consistent orientations. Second, the normal of a corner is the angle-weighted mean (Thürmer
and Wüthrich 1998) of the faces about its vertex. Third, only faces within the crease angle of the corner's own face
count: an edge stays sharp, a curve stays smooth. Duplicate vertices are one vertex here, by position.
"""

from collections.abc import Iterable, Iterator, Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int

PAIRS_AT_ONCE = 2_000_000  # number of pairs of corners in memory at once


class Mesh(msgspec.Struct, frozen=True):
    """Triangles in the object's own frame and units.

    vertices    [V, 3] float64; a vertex on a crease occurs once for each smooth side of it
    faces       [F, 3] int32, counter-clockwise from outside where the file is so
    normals     [V, 3] float64, unit, smooth
    face_label  [F] int16, material label k = position in the dataset's `materials`, from 1
    open        True if the surface has a border, so that its inside can be visible
    detail      [V, 3] factor on the diffuse reflectance of the material; None: 1
    uv          [V, 2] texture coordinates in the unit square, v upward; None: it has no texture
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    face_label: Int[np.ndarray, " f"]
    open: bool = False
    detail: Float[np.ndarray, "v 3"] | None = None
    uv: Float[np.ndarray, "v 2"] | None = None

    @property
    def labels(self) -> tuple[int, ...]:
        """Labels that occur, ascending."""
        return tuple(int(label) for label in np.unique(self.face_label))

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Centre of the bounding box of the vertices that faces use."""
        used = self.vertices[np.unique(self.faces)]
        return (used.min(axis=0) + used.max(axis=0)) / 2

    @property
    def radius(self) -> float:
        """Largest distance of a used vertex from `centre`."""
        return float(np.linalg.norm(self.vertices[np.unique(self.faces)] - self.centre, axis=1).max())


def without_paint(mesh: Mesh, labels: Iterable[int]) -> Mesh:
    """Return the mesh without detail on the faces of some labels, which get another material."""
    if mesh.detail is None:
        return mesh
    detail = mesh.detail.copy()
    detail[np.unique(mesh.faces[np.isin(mesh.face_label, list(labels))])] = 1.0
    return msgspec.structs.replace(mesh, detail=detail)


def scale_mesh(mesh: Mesh, factors: Sequence[float]) -> Mesh:
    """Scale the mesh's axes by `factors` > 0, about its origin; normals stay perpendicular to the surface.

    >>> tilted = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.ones((3, 3)) / 3**0.5, np.array([1]))
    >>> (scale_mesh(tilted, (1, 1, 0.5)).normals[0] * 6**0.5).round(9).tolist()
    [1.0, 1.0, 2.0]
    """
    along_axes = np.asarray(factors, dtype=float)
    normals = mesh.normals / along_axes
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return msgspec.structs.replace(mesh, vertices=mesh.vertices * along_axes, normals=normals)


def area_vectors(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Return face normals times face areas.

    >>> area_vectors(np.eye(3)[[0, 1, 2]] * 2, np.array([[0, 1, 2]])).tolist()
    [[2.0, 2.0, 2.0]]
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def closed_grid(points: Float[np.ndarray, "r c 3"], top: np.ndarray, bottom: np.ndarray) -> Mesh:
    """Triangulate rows of points that run about y from +z toward +x, and close them by two poles.

    Args:
        points: Points by row and column; the first row is at the top.
        top: Upper pole.
        bottom: Lower pole.

    Returns:
        A mesh with smooth normals.
    """
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(index, -1, axis=1)
    last = rows * columns
    cap = np.stack([right[0], np.full(columns, last), index[0]], axis=-1)
    base = np.stack([index[-1], np.full(columns, last + 1), right[-1]], axis=-1)
    lower = np.stack([index[:-1], index[1:], right[1:]], axis=-1).reshape(-1, 3)
    upper = np.stack([index[:-1], right[1:], right[:-1]], axis=-1).reshape(-1, 3)
    return smooth(np.concatenate([points.reshape(-1, 3), [top, bottom]]), np.concatenate([lower, upper, cap, base]))


def smooth(vertices: Float[np.ndarray, "v 3"], faces: np.ndarray, label: np.ndarray | int = 1) -> Mesh:
    """Build a mesh with normals averaged over the faces about each vertex, weighted by area.

    Args:
        vertices: Vertices.
        faces: Triangles.
        label: Label of all faces, or of each face.

    Returns:
        The mesh.
    """
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], area_vectors(vertices, faces))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(vertices, faces.astype(np.int32), normals, np.broadcast_to(label, len(faces)).astype(np.int16))


def weld_vertices(vertices: Float[np.ndarray, "v 3"], tolerance: float = 1e-6) -> Int[np.ndarray, " v"]:
    """Return the number of each vertex's position, equal for vertices closer than about `tolerance` × the extent."""
    low = vertices.min(axis=0)
    extent = float((vertices.max(axis=0) - low).max()) or 1.0
    grid = np.round((vertices - low) / (extent * tolerance)).astype(np.int64)
    return np.unique(grid, axis=0, return_inverse=True)[1].reshape(-1)


def find_flipped_faces(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Bool[np.ndarray, " f"], bool]:
    """Find the faces to flip so that neighbours agree, and whether the surface is open.

    A connected patch has two orientations. An open patch takes the one that flips less area, a closed patch the one
    that encloses positive volume. A patch that cannot be oriented (Möbius) is left unchanged.
    """
    from scipy.sparse import coo_matrix  # imported here, since it takes half a second and `read_parts` does not need it
    from scipy.sparse.csgraph import connected_components

    count = len(faces)
    # pairs of faces a, b across the edges that have exactly two; an edge of one face is a border
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)  # half-edges, three a face
    edges = np.sort(ends, axis=1) @ [len(vertices), 1]  # one number an edge
    _, edge, counts = np.unique(edges, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)[counts == 2] - 1
    first, second = np.argsort(edge, kind="stable")[np.stack([last - 1, last])]
    a = first // 3
    b = second // 3
    has_border = bool((counts == 1).any())
    # graph of orientations: node f is face f unchanged, node f + count is face f flipped
    offset = np.where(ends[first, 0] != ends[second, 0], 0, count)  # they agree if they run in opposite directions
    rows = np.r_[a, a + count]
    columns = np.r_[b + offset, b + count - offset]
    graph = coo_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(2 * count, 2 * count))
    _, part = connected_components(graph, directed=False)
    unflipped = part[:count]
    flipped = part[count:]
    # area, or signed volume, that each component keeps less that which it flips
    area = area_vectors(vertices, faces)
    volume = np.einsum("fd,fd->f", vertices[faces].mean(axis=1) - vertices[faces[:, 0]].mean(axis=0), area)
    gain = np.linalg.norm(area, axis=1) if has_border else volume
    total = np.bincount(unflipped, gain, part.max() + 1) - np.bincount(flipped, gain, part.max() + 1)
    return (total[unflipped] < 0) & (unflipped != flipped), has_border


def corner_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], crease_deg: float
) -> Float[np.ndarray, "f 3 3"]:
    """Return the unit normal at each corner of each face.

    It is angle-weighted over those faces of its vertex whose normals are within `crease_deg` of its own face's.

    Args:
        vertices: Vertices.
        faces: Triangles.
        crease_deg: Greatest angle between faces that are smoothed, degrees.

    Returns:
        Normals.
    """
    area = area_vectors(vertices, faces)
    normal = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-300)
    corner = vertices[faces]
    onward = np.roll(corner, -1, axis=1) - corner
    backward = np.roll(corner, 1, axis=1) - corner
    # angle of each corner, the weight of its face
    angle = np.arctan2(np.linalg.norm(np.cross(onward, backward), axis=-1), np.einsum("fkd,fkd->fk", onward, backward))
    weight = angle.reshape(-1)
    order = np.argsort(faces.reshape(-1), kind="stable")  # corners, grouped by vertex
    vertex = faces.reshape(-1)[order]
    starts = np.flatnonzero(np.r_[True, vertex[1:] != vertex[:-1]])
    counts = np.diff(np.r_[starts, len(vertex)])
    result = np.empty((len(order), 3))
    threshold = np.cos(np.deg2rad(crease_deg))
    # for each corner, the weighted sum over the corners at its vertex within the crease angle
    for group in _chunks(counts.astype(np.int64) ** 2):
        mine, theirs = _pairs(starts[group], counts[group])
        face_normal = normal[order[mine] // 3]
        other_normals = normal[order[theirs] // 3]
        share = weight[order[theirs]] * (np.einsum("pd,pd->p", face_normal, other_normals) >= threshold - 1e-12)
        low = starts[group][0]
        high = starts[group][-1] + counts[group][-1]
        summed = [np.bincount(mine - low, share * other_normals[:, d], high - low) for d in range(3)]
        result[order[low:high]] = np.stack(summed, axis=1)
    length = np.linalg.norm(result, axis=1, keepdims=True)
    face_normal = np.repeat(normal, 3, axis=0)
    return np.where(length > 1e-12, result / np.maximum(length, 1e-300), face_normal).reshape(-1, 3, 3)


def _pairs(starts: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all ordered pairs of positions within each run [start, start + count)."""
    squares = counts**2
    run = np.repeat(np.arange(len(counts)), squares)
    within = np.arange(squares.sum()) - np.repeat(np.cumsum(squares) - squares, squares)
    return starts[run] + within // counts[run], starts[run] + within % counts[run]


def _chunks(sizes: np.ndarray) -> Iterator[slice]:
    """Yield slices of consecutive items whose sizes sum to about PAIRS_AT_ONCE."""
    block = np.cumsum(sizes) // PAIRS_AT_ONCE
    edges = np.flatnonzero(np.r_[True, block[1:] != block[:-1]])
    for low, high in zip(edges, np.r_[edges[1:], len(sizes)]):
        yield slice(int(low), int(high))
