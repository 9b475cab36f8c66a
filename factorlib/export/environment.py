"""The environment map that Mitsuba reads.

Mitsuba's `envmap` interpolates bilinearly between nodes at row i/(H−1), column (j+½)/W.  The exported map, a table of
area means, would be up to half a texel off.  The lobes are therefore evaluated at Mitsuba's nodes.  Interpolation
convolves a lobe with a triangle of the node spacing h, of variance h²/6 along each axis.  A lobe of sharpness λ has
variance 1/λ.  The lobes are first sharpened by that amount at the same energy, so that the interpolated map has their
energy and width.
"""

import numpy as np
from jaxtyping import Float

from factorlib.light.latlong import lattice_of_lobes
from factorlib.light.lobes import Lobes, lobe_integral

NARROWEST = 0.5  # least variance, in h², of a lobe at the nodes: a narrower one would fall between them


def sharpened(lobes: Lobes, spacing: float) -> Lobes:
    """Return narrower lobes that linear interpolation between nodes widens back to `lobes`; energy is kept.

    `spacing` is the distance of the nodes in radians.
    """
    # variance 1/λ − h²/6, at the same energy
    variance = np.maximum(1 / lobes.sharpness - spacing**2 / 6, NARROWEST * spacing**2)
    factor = np.asarray(lobe_integral(lobes.sharpness) / lobe_integral(1 / variance))
    return Lobes(lobes.axis, 1 / variance, lobes.weight * factor[:, None])


def mitsuba_map(lobes: Lobes, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
    """Evaluate a light at the nodes of Mitsuba's `envmap`.

    Args:
        lobes: the light, in its own frame
        height: rows of the map
        width: columns of the map

    Returns:
        Radiance at the nodes, in the lobes' frame turned y-up.
    """
    narrowed = sharpened(lobes, np.pi / (height - 1))
    theta = np.arange(height)[:, None] / (height - 1) * np.pi
    phi = (np.arange(width)[:, None] + 0.5) / width * 2 * np.pi
    return lattice_of_lobes(narrowed, height, width, lambda _: (theta, phi, np.ones(1)))
