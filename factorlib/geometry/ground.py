"""Ground plane on which an object rests.

A rigid object comes to rest on a facet of its convex hull (Goldberg et al., "Part pose statistics", 1999).  `trimesh`
computes the probability of each facet after a random drop.  The ground is the likeliest of the facets that look down,
on the mean over all photos of the object.  People photograph things upright, a tall one from below and a low one from
above.
"""

import msgspec
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import QhullError

from factorlib.geometry.sphere import fibonacci_sphere

# Largest mean angle between the object's upright axis and the cameras': photos look down, and are held askew.
MOST_TILT_DEG = 50.0
EXTREMES = 400  # number of directions whose farthest vertices are the hull's: its facets are few


class Plane(msgspec.Struct, frozen=True):
    """Plane: a point on it and its unit normal, toward the objects, in one frame."""

    normal: Float[np.ndarray, "3"]
    point: Float[np.ndarray, "3"]

    def onto(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the orthogonal projections of `points` onto the plane."""
        return points - ((points - self.point) @ self.normal)[:, None] * self.normal

    def hit(self, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the intersections of rays from the origin with the plane's upper side; NaN if a ray misses it."""
        down = rays @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.point @ self.normal) / down
        return np.where((distance > 0) & (down < 0), distance, np.nan)[:, None] * rays


def resting_plane(
    vertices: Float[np.ndarray, "v 3"],
    placed: Float[np.ndarray, "v 3"],
    rotation: Float[np.ndarray, "3 3"],
    uprights: Float[np.ndarray, "k 3"],
) -> Plane | None:
    """Return the plane on which an object rests; None if it is flat, or no stable pose is upright in its photos.

    Args:
        vertices: Vertices in the object's frame.
        placed: The same vertices in the frame of the result.
        rotation: Rotation from the object's frame to that of the result.
        uprights: Unit up vectors of the cameras that see the object, in its frame.
    """
    # stable poses of the convex hull of extreme vertices, and their probabilities
    centred = vertices - vertices.mean(axis=0)
    extreme = np.unique([np.argmax(centred @ direction) for direction in fibonacci_sphere(EXTREMES)])
    try:
        hull = trimesh.convex.convex_hull(centred[extreme])
        with np.errstate(invalid="ignore"):
            poses, chances = trimesh.poses.compute_stable_poses(hull, n_samples=1)
    except (QhullError, ValueError):  # a flat object has no hull
        return None
    normals = poses.reshape(-1, 4, 4)[:, 2, :3]  # z of the resting pose, in the object's frame
    upright = (normals @ uprights.T).mean(axis=1) > np.cos(np.radians(MOST_TILT_DEG))
    if not upright.any():
        return None
    # the likeliest pose among the upright ones; the plane touches the lowest vertex
    normal = rotation @ normals[np.argmax(np.where(upright, chances, -1))]
    lowest = placed[np.argmin(placed @ normal)]
    return Plane(normal / np.linalg.norm(normal), lowest)
