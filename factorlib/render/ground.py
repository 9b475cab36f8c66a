"""The plane that a photo's objects stand on: given with the photo, or that on which an object would rest.

A rigid object comes to rest on a facet of its convex hull (Goldberg et al., "Part pose statistics", 1999; `trimesh` computes how
likely each is from a random drop).  Of the facets that look down in the photos of the object, taken together, the likeliest is
taken: people photograph things upright, a tall one from below and a low one from above.
"""

import msgspec
import numpy as np
import trimesh
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.render.photo_scene import Placed

MOST_TILT_DEG = 50.0  # of the upright axis against the cameras', on the mean: photos look down, and are held askew


class Plane(msgspec.Struct, frozen=True):
    """A plane in the world: its unit normal, toward the objects, and a point."""

    normal: Float[np.ndarray, "3"]
    point: Float[np.ndarray, "3"]

    @property
    def seen_from_above(self) -> bool:
        """Whether the camera, at the origin, is on the side of the objects."""
        return float(self.point @ self.normal) < 0

    def onto(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The points of the plane nearest to `points`."""
        return points - ((points - self.point) @ self.normal)[:, None] * self.normal

    def hit(self, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return where rays from the origin meet the plane; NaN where they do not."""
        down = rays @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.point @ self.normal) / down
        return np.where((distance > 0) & (down < 0), distance, np.nan)[:, None] * rays


def resting_plane(placed: Placed, uprights: Float[np.ndarray, "k 3"] | None = None) -> Plane:
    """The plane that an object rests on in the world; InputError where it could rest on none that looks upright in the photos.

    uprights: the unit upward axes of the cameras that see the object, in its own frame; by default that of this photo
    """
    rotation = placed.world_from_object[:3, :3]
    rotation = rotation / np.cbrt(np.linalg.det(rotation))
    uprights = rotation.T[:, 1][None] if uprights is None else uprights
    vertices = placed.mesh.vertices
    poses, chances = trimesh.poses.compute_stable_poses(
        trimesh.convex.convex_hull(vertices - vertices.mean(axis=0)), n_samples=1
    )
    normals = poses[:, 2, :3]  # z of the resting pose, in the object's frame
    upright = (normals @ uprights.T).mean(axis=1) > np.cos(np.radians(MOST_TILT_DEG))
    if not upright.any():
        found = f"the object '{placed.name}' rests on no side that looks down in its photos"
        raise InputError(found, key="beside", cure="name another object, or give the photo's `ground` in dataset.yaml")
    normal = rotation @ normals[np.argmax(np.where(upright, chances, -1))]
    lowest = placed.vertices[np.argmin(placed.vertices @ normal)]
    return Plane(normal / np.linalg.norm(normal), lowest)


def height_over(plane: Plane, placed: Placed) -> float:
    """Return how far an object reaches up from the plane."""
    return float(((placed.vertices - plane.point) @ plane.normal).max())
