"""Light at a finite distance, seen from points beside the centre of a photo's points.

A light of curvature c lies on a sphere of radius 1/c about that centre.  The unit of length is the RMS distance of the
photo's points from the centre.  Let x be a point in these units, X = c x and d = |z − X|.  Light that has direction z
from the centre has direction (z − X)/d from the point.  Its solid angle there is (1 − X·z)/d³ times the one it has from
the centre:

    n·z' = (n·z − n·X)/d,      o·z' = (o·z − o·X)/d,      w' = w (1 − X·z)/d³                                       (1)

A constant light therefore stays constant, and c = 0 is an environment map, infinitely far away.  Lobes keep their
sharpness.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

LONGEST = 0.5  # largest |X|: a point more than halfway to the light is treated as halfway
A = Any  # np.ndarray or torch.Tensor


def finite_distance_cosines(place: A, normal: A, view: A, axis: A, curvature: float) -> tuple[A, A, A]:
    """Return the cosines n·z', o·z' and weights w'/w of lobes at a finite distance, (1), each [n, p].

    All vectors are in one frame; n, o and z are unit.  |X| is limited to `LONGEST`.

    Args:
        place: x, the points [n, 3].
        normal: n, the normals [n, 3].
        view: o, the directions toward the camera [n, 3].
        axis: z, the axes of the lobes [p, 3].
        curvature: c, one over the distance of the light.
    """
    # X = c x, limited to |X| ≤ LONGEST
    X = curvature * place
    X = X / (((X * X).sum(1)[:, None] ** 0.5) / LONGEST).clip(1.0)
    # d = |z − X|, then (1)
    along = X @ axis.T
    d = (1 - 2 * along + (X * X).sum(1)[:, None]) ** 0.5
    nz, oz = ((vectors @ axis.T - (vectors * X).sum(1)[:, None]) / d for vectors in (normal, view))
    return nz.clip(-1.0, 1.0), oz.clip(-1.0, 1.0), (1 - along) / d**3


def back_project(view: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the points of depth z along the viewing rays, camera frame; `view` points toward the camera."""
    return view * (depth / view[:, 2])[:, None]


def relative_positions(
    view: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Return the positions x of a photo's n points relative to their centre, in the camera frame.

    Args:
        view: Unit vectors toward the camera.
        depth: z of the points, in any unit.
        weight: Weight of each point in the centre and in the RMS distance.

    Returns:
        Positions relative to the weighted centre, in units of the weighted RMS distance; zeros if all weights are zero.
    """
    if not weight.sum() > 0:
        return np.zeros((len(depth), 3))
    points = back_project(view, depth)
    centre, size = centre_and_size(points, weight)
    return (points - centre) / size


def centre_and_size(
    points: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the weighted centre of points and their weighted RMS distance from it; the weights have a positive sum."""
    centre = np.average(points, axis=0, weights=weight)
    return centre, max(float(np.sqrt(np.average(((points - centre) ** 2).sum(1), weights=weight))), 1e-300)
