"""Triangle mesh that the pipeline can use: finite, without degenerate faces, with normals and material labels."""

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Int


class Mesh(msgspec.Struct, frozen=True):
    """Triangles in the object's own frame and units.

    vertices    [V, 3] float64; a vertex on a crease occurs once for each smooth side of it
    faces       [F, 3] int32, counter-clockwise from outside where the file is so
    normals     [V, 3] float64, unit, smooth
    face_label  [F] int16, material label k = position in the dataset's `materials`, from 1
    open        True if the surface has a border, so that its inside can be visible
    detail      [V] factor on the diffuse reflectance of the material; None: 1
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    face_label: Int[np.ndarray, " f"]
    open: bool = False
    detail: Float[np.ndarray, " v"] | None = None

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


def scaled(mesh: Mesh, factors: Sequence[float]) -> Mesh:
    """Scale the mesh's axes by `factors` > 0, about its origin; normals stay perpendicular to the surface.

    >>> tilted = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.ones((3, 3)) / 3**0.5, np.array([1]))
    >>> (scaled(tilted, (1, 1, 0.5)).normals[0] * 6**0.5).round(9).tolist()
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
    a = index[:-1]
    b = right[:-1]
    c = index[1:]
    d = right[1:]
    last = rows * columns
    cap = np.stack([right[0], np.full(columns, last), index[0]], axis=-1)
    base = np.stack([index[-1], np.full(columns, last + 1), right[-1]], axis=-1)
    sides = np.concatenate([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)]).reshape(-1, 3)
    return smooth(np.concatenate([points.reshape(-1, 3), [top, bottom]]), np.concatenate([sides, cap, base]))


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
