"""The object of the comparison: a rounded, convex body, and what of it a camera far away sees.

Body    |x/a|^p + |y/b|^p + |z/c|^p = 1 (superquadric, Barr 1981), turned at random, another way for each seed.  It is convex, so
        that no part shades or hides another one, and a point is seen exactly where its normal is turned toward the camera.
Frames  Points and normals are in the photo's light frame (x right, y up, z toward the viewer).  A camera that went around the
        body is given by `turn`, view_from_photo, a rotation; the body and its light stay where they are.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from factorlib.generate.shapes import star
from factorlib.meshes.mesh import Mesh
from studies.core.world import GRAZING

RADII, POWER = np.array([0.9, 0.66, 0.76]), 2.7
REACH = 1.05  # half the width that a picture shows
HALVINGS = 60  # of an interval in search of a root


class Seen(msgspec.Struct, frozen=True):
    """The points of the body that a camera sees, in rows: those of the picture's pixels `inside`.

    points, normals: photo's light frame;  turn: view_from_photo
    """

    inside: Bool[np.ndarray, "h w"]
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "3 3"]

    @property
    def normals_in_view(self) -> Float[np.ndarray, "n 3"]:
        """Normals in the camera's own light frame."""
        return self.normals @ self.turn.T

    def picture(self, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "h w 3"]:
        """The points' radiance where they are seen, 0 elsewhere."""
        shown = np.zeros((*self.inside.shape, 3))
        shown[self.inside] = radiance
        return shown


def pose(seed: int) -> Float[np.ndarray, "3 3"]:
    """photo_from_body of a world."""
    return Rotation.random(rng=np.random.default_rng([14, seed])).as_matrix()


def turn(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3 3"]:
    """view_from_photo of a camera that went to the right, then up, about the body.

    >>> turn(90, 0).round(6).tolist()[2]
    [1.0, 0.0, 0.0]
    """
    a, e = np.radians([azimuth_deg, elevation_deg])
    toward = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    return np.stack([right, np.cross(toward, right), toward])


def seen(seed: int, size: int, view_from_photo: Float[np.ndarray, "3 3"] = np.eye(3)) -> Seen:
    """What a camera sees in a picture `size` pixels across; pixels that see the surface at a grazing angle are left out."""
    at = ((np.arange(size) + 0.5) / size * 2 - 1) * REACH
    x, y = (v.reshape(-1) for v in np.meshgrid(at, -at))
    body_from_view = (view_from_photo @ pose(seed)).T
    z = _front(np.stack([x, y], axis=-1), body_from_view)
    hit = np.isfinite(z)
    points = np.stack([x, y, z], axis=-1)[hit] @ body_from_view.T
    normals = gradient(points)
    kept = (normals @ body_from_view)[:, 2] > GRAZING
    inside = np.zeros(size * size, bool)
    inside[np.flatnonzero(hit)[kept]] = True
    photo_from_body = pose(seed)
    return Seen(
        inside.reshape(size, size), points[kept] @ photo_from_body.T, normals[kept] @ photo_from_body.T, view_from_photo
    )


def level(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """1 on the surface, less inside; points in the body's frame."""
    return (np.abs(points / RADII) ** POWER).sum(axis=-1)


def gradient(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals, body's frame."""
    normals = np.sign(points) * np.abs(points / RADII) ** (POWER - 1) / RADII
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _front(at: Float[np.ndarray, "n 2"], body_from_view: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " n"]:
    """Largest z, view's frame, at which the lines along z meet the body; NaN where they do not."""

    def along(z: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The level on the lines, convex in z."""
        return level(np.column_stack([at, z]) @ body_from_view.T)

    low, high = np.full(len(at), -2.0), np.full(len(at), 2.0)
    for _ in range(HALVINGS):  # thirds: the lowest level lies between
        a, b = low + (high - low) / 3, high - (high - low) / 3
        left = along(a) < along(b)
        low, high = np.where(left, low, a), np.where(left, b, high)
    deepest = (low + high) / 2
    low, high = deepest, np.full(len(at), 2.0)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        within = along(middle) < 1
        low, high = np.where(within, middle, low), np.where(within, high, middle)
    return np.where(along(deepest) < 1, low, np.nan)


def mesh(seed: int) -> Mesh:
    """The same body as triangles, in the photo's light frame, with its own normals."""
    found, photo_from_body = star(lambda direction: level(direction) ** (-1 / POWER)), pose(seed)
    vertices, normals = (v @ photo_from_body.T for v in (found.vertices, gradient(found.vertices)))
    return Mesh(vertices, found.faces, normals, found.face_label)
