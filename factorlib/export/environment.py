"""The map that Mitsuba is handed.

Its `envmap` interpolates bilinearly between nodes at row i/(H−1), column (j+½)/W, so the exported map, a table of
area means, would sit up to half a texel off.  Instead the lobes are evaluated at Mitsuba's nodes.  Interpolation widens a
lobe by a triangle of the node spacing h, of variance h²/6 along each axis; a lobe of sharpness λ has variance 1/λ.  So
the lobes are first sharpened by as much, at the same energy: what Mitsuba interpolates has their energy and width.
"""

import numpy as np
from jaxtyping import Float

from factorlib.light.latlong import lattice_of_lobes
from factorlib.light.lobes import Lobes, lobe_integral

NARROWEST = 0.5  # least variance, in h², of a lobe at the nodes: narrower ones would fall between them


def sharpened(lobes: Lobes, spacing: float) -> Lobes:
    """Lobes that, interpolated linearly between nodes `spacing` radians apart, are as wide as `lobes`; energy kept."""
    variance = np.maximum(1 / lobes.sharpness - spacing**2 / 6, NARROWEST * spacing**2)
    kept = np.asarray(lobe_integral(lobes.sharpness) / lobe_integral(1 / variance))
    return Lobes(lobes.axis, 1 / variance, lobes.weight * kept[:, None])


def mitsuba_map(lobes: Lobes, height: int, width: int) -> Float[np.ndarray, "h w 3"]:
    """Node values for Mitsuba of a light given in the lobes' own frame; the map is in its y-up turn."""
    at_nodes = sharpened(lobes, np.pi / (height - 1))
    theta = np.arange(height)[:, None] / (height - 1) * np.pi
    phi = (np.arange(width)[:, None] + 0.5) / width * 2 * np.pi
    return lattice_of_lobes(at_nodes, height, width, lambda _: (theta, phi, np.ones(1)))
