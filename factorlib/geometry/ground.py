"""Ground plane on which an object rests.

A rigid object comes to rest on a facet of its convex hull above which its centre of mass lies, here that of the hull.
The chance of a facet after a random drop is about its solid angle, seen from that centre (Goldberg et al., "Part pose
statistics", 1999, who add the chances of unstable facets that topple onto it).  The ground is the likeliest of the
facets that look down, on the mean over all photos of the object.  People photograph things upright, a tall one from
below and a low one from above.
"""

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from factorlib.geometry.sphere import fibonacci_sphere

# Largest mean angle between the object's upright axis and the cameras': photos look down, and are held askew.
MOST_TILT_DEG = 50.0
FOOTING = 1e-9  # largest height of the foot above the hull, in longest sides
COPLANAR = 1e-9  # largest 1 − cosine between normals of one facet
EXTREMES = 400  # number of directions whose farthest vertices make the hull, so that it has few facets


class Plane(msgspec.Struct, frozen=True):
    """Plane, by a point on it and its unit normal toward the objects, in one frame."""

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
    most_tilt_deg: float = MOST_TILT_DEG,
) -> Plane | None:
    """Return the plane on which an object rests; None if it is flat, or no stable pose is upright in its photos.

    Args:
        vertices: Vertices in the object's frame.
        placed: The same vertices in the frame of the result.
        rotation: Rotation from the object's frame to that of the result.
        uprights: Unit up vectors of the cameras that see the object, or of its world, in its frame.
        most_tilt_deg: Largest mean angle between the plane's normal and these, degrees.
    """
    try:
        ups, chances = stable_poses(vertices)
    except QhullError:  # a flat object has no hull
        return None
    upright = (ups @ uprights.T).mean(axis=1) > np.cos(np.radians(most_tilt_deg))
    if not upright.any():
        return None
    # the likeliest pose among the upright ones; the plane touches the lowest vertex
    normal = rotation @ ups[np.argmax(np.where(upright, chances, -1))]
    lowest = placed[np.argmin(placed @ normal)]
    return Plane(normal / np.linalg.norm(normal), lowest)


def stable_poses(vertices: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, " s"]]:
    """Return the upward directions of the poses in which an object rests, in its frame, and their chances.

    Raises:
        QhullError: The object is flat.
    """
    extreme = np.unique([np.argmax(vertices @ direction) for direction in fibonacci_sphere(EXTREMES)])
    points = vertices[extreme] - vertices.mean(axis=0)
    hull = ConvexHull(points)
    outward, offset = hull.equations[:, :3], hull.equations[:, 3]
    # centre of mass, from tetrahedra between the facets and a point inside
    corners = points[hull.simplices] - points.mean(axis=0)
    volume = np.abs(np.linalg.det(corners))
    centre = points.mean(axis=0) + volume @ corners.mean(axis=1) * 0.75 / volume.sum()
    # a facet is stable if the foot of the centre lies on the hull
    foot = centre - (outward @ centre + offset)[:, None] * outward
    stable = (foot @ outward.T + offset < FOOTING * np.ptp(points, axis=0).max()).all(axis=1)
    # solid angle of each triangle (Van Oosterom and Strackee 1983), summed over those of one plane
    corners = points[hull.simplices] - centre
    corners /= np.linalg.norm(corners, axis=2, keepdims=True)
    cosines = sum(np.sum(corners[:, i] * corners[:, i - 1], axis=1) for i in range(3))
    solid_angle = 2 * np.arctan2(np.abs(np.linalg.det(corners)), 1 + cosines)
    chances = (outward @ outward.T > 1 - COPLANAR) @ solid_angle / (4 * np.pi)
    return -outward[stable], chances[stable]
