"""Light at a finite distance, as a point beside the middle of what a photo shows meets it.

A light of curvature c lies on a sphere of radius 1/c about that middle, in units of the RMS distance of the photo's points from it.  To a point at
x in these units, with X = c x, what lies in direction z from the middle lies along (z − X)/d, d = |z − X|, and is seen as
(1 − X·z)/d³ times the solid angle that it has from the middle:

    n·z' = (n·z − n·X)/d,      o·z' = (o·z − o·X)/d,      w' = w (1 − X·z)/d³                                                            (1)

So a constant light stays constant, and c = 0 is the light of an environment map, infinitely far away.  Lobes keep their sharpness.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

LONGEST = 0.5  # of |X|: a point that lies more than halfway to the light is taken to lie halfway
A = Any  # np.ndarray or torch.Tensor


def met_from(place: A, normal: A, view: A, axis: A, curvature: float) -> tuple[A, A, A]:
    """Return n·z', o·z' and w'/w of (1), each [n, p].

    place: x [n, 3], the points;  normal, view: n and o [n, 3];  axis: z of the lobes [p, 3].  All in one frame; n, o and z are unit.
    """
    X = curvature * place
    X = X / (((X * X).sum(1)[:, None] ** 0.5) / LONGEST).clip(1.0)
    along = X @ axis.T
    d = (1 - 2 * along + (X * X).sum(1)[:, None]) ** 0.5
    nz, oz = ((of @ axis.T - (of * X).sum(1)[:, None]) / d for of in (normal, view))
    return nz.clip(-1.0, 1.0), oz.clip(-1.0, 1.0), (1 - along) / d**3


def places_of(
    view: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Return x of the n points that a photo shows, in the camera frame.

    view: unit, toward the camera;  depth: z of the points, in any unit;  weight: how much each point counts in the middle and in the RMS
    """
    if not weight.sum() > 0:
        return np.zeros((len(depth), 3))
    place = view * (depth / view[:, 2])[:, None]
    place = place - np.average(place, axis=0, weights=weight)
    return place / max(float(np.sqrt(np.average((place**2).sum(1), weights=weight))), 1e-300)
