"""The ground plane of a photo: given in dataset.yaml, or the plane on which an object would rest.

A rigid object comes to rest on a facet of its convex hull (Goldberg et al., "Part pose statistics", 1999). `trimesh`
computes the probability of each facet after a random drop.  The ground is the likeliest of the facets that look down,
on the mean over all photos of the object.  People photograph things upright, a tall one from below and a low one from
above.
"""

import msgspec
import numpy as np
import trimesh
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.render.photo_scene import PlacedMesh

# Largest mean angle between the object's upright axis and the cameras': photos look down, and are held askew.
MOST_TILT_DEG = 50.0


class Plane(msgspec.Struct, frozen=True):
    """A plane in the world: a point on it and its unit normal, toward the objects."""

    normal: Float[np.ndarray, "3"]
    point: Float[np.ndarray, "3"]

    @property
    def below_camera(self) -> bool:
        """True if the camera, at the origin, is on the objects' side of the plane."""
        return float(self.point @ self.normal) < 0

    def onto(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the orthogonal projections of `points` onto the plane."""
        return points - ((points - self.point) @ self.normal)[:, None] * self.normal

    def hit(self, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the intersections of rays from the origin with the plane's upper side; NaN if a ray misses it."""
        down = rays @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.point @ self.normal) / down
        return np.where((distance > 0) & (down < 0), distance, np.nan)[:, None] * rays


def resting_plane(placed: PlacedMesh, uprights: Float[np.ndarray, "k 3"] | None = None) -> Plane:
    """Return the plane, in the world, on which an object rests.

    Args:
        placed: the object
        uprights: unit up vectors of the cameras that see the object, in its own frame; by default that of this photo

    Raises:
        InputError: The object has no stable pose that is upright in its photos.
    """
    # rotation of the similarity, without its scale
    rotation = placed.world_from_object[:3, :3]
    rotation = rotation / np.cbrt(np.linalg.det(rotation))
    uprights = rotation.T[:, 1][None] if uprights is None else uprights
    vertices = placed.mesh.vertices
    # stable poses of the convex hull, and their probabilities
    poses, chances = trimesh.poses.compute_stable_poses(
        trimesh.convex.convex_hull(vertices - vertices.mean(axis=0)), n_samples=1
    )
    normals = poses[:, 2, :3]  # z of the resting pose, in the object's frame
    upright = (normals @ uprights.T).mean(axis=1) > np.cos(np.radians(MOST_TILT_DEG))
    if not upright.any():
        fault = f"no stable pose of the object '{placed.name}' is upright in its photos, so its ground is unknown"
        raise InputError(fault, key="beside", cure="name another object, or give the photo's `ground` in dataset.yaml")
    # the likeliest pose among the upright ones; the plane touches the lowest vertex
    normal = rotation @ normals[np.argmax(np.where(upright, chances, -1))]
    lowest = placed.vertices[np.argmin(placed.vertices @ normal)]
    return Plane(normal / np.linalg.norm(normal), lowest)


def height_over(plane: Plane, placed: PlacedMesh) -> float:
    """Return the height of an object's highest vertex above the plane."""
    return float(((placed.vertices - plane.point) @ plane.normal).max())
