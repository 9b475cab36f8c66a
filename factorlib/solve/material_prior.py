"""What is expected of materials before any photo is seen.

Most materials are dielectrics.  Of a ray along the normal they reflect ((n − 1)/(n + 1))², which is .02 to .08 for refractive indices n of
1.33 to 1.8, in all colours alike (the neutral interface of H.-C. Lee, E. Breneman and C. Schulte 1990, "Modeling light reflection for
computer color vision").  With l = log k_s of a material's three channels and l̄ their mean,

    minus twice its log density = (l̄ − log SPECULAR)²/LEVEL² + Σ_c (l_c − l̄)²/TINT²                                 (1)

For a metal, such as gold with k_s = (1, .8, .3), (1) is some 50, which a few hundred observations outweigh.  Where observations say little
of k_s, as those of a bright and nearly Lambertian surface do, (1) decides.

A factor per channel is free between the materials and the lights of a connected component, unless surfaces light each other, and then it is
known to no more than the model of interreflection is right.  So the brightest material of a component, b the mean over channels of its
k_d + k_s, is expected to be of ordinary brightness:

    (log b − log BRIGHTEST)²/BRIGHTNESS²                                                                             (2)

which is .5 to .95 within two standard deviations.  The tint is settled by the prior on lights, whose mean is grey.  A very wide Gaussian about
the start keeps log k_d and roughness finite where observations say nothing.  Where no bounces fix the scale, the answer is brought to the gauge
of `factorlib.model.gauge` afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from factorlib.model.blocks import Block
from factorlib.model.gauge import connected_components
from factorlib.model.materials import LEAST_REFLECTANCE, ROUGHNESS, Materials

DIFFUSE, ROUGH = 3.0, 1.0  # standard deviations of log k_d and of roughness about the start
SPECULAR, LEVEL, TINT = (
    0.05,
    0.7,
    0.15,
)  # of (1); e^LEVEL: a factor of 2; e^TINT: 16 %, for the white balance of photos is not known better
BRIGHTEST, BRIGHTNESS = 0.69, 0.16  # of (2)


class Gaussian(NamedTuple):
    """Minus twice a log density, half its gradient and half its Gauss–Newton Hessian by the materials' unknowns."""

    value: float
    gradient: Float[np.ndarray, " 7m"]
    hessian: Float[np.ndarray, "7m 7m"]


class MaterialPrior:
    """The prior on m materials that are linked by some blocks; those without specular part at the start have no prior on it."""

    def __init__(self, start: Materials, blocks: Sequence[Block]):
        wide = np.diag([DIFFUSE**-2.0] * 3 + [0.0] * 3 + [ROUGH**-2.0])
        self.mean, self.precision = unknowns_of(start), np.tile(wide, (len(start), 1, 1))
        specular = (start.specular > LEAST_REFLECTANCE).any(1)
        self.mean[specular, 3:6] = np.log(SPECULAR)
        self.precision[specular, 3:6, 3:6] = np.full((3, 3), 1 / 9) / LEVEL**2 + (np.eye(3) - 1 / 3) / TINT**2
        self.members = [
            list(members) for members, lights in connected_components(blocks, len(start)) if members and lights
        ]

    def at(self, theta: Float[np.ndarray, "m 7"]) -> Gaussian:
        """At the materials' unknowns."""
        off = theta - self.mean
        slope = np.einsum("mij,mj->mi", self.precision, off)
        value, gradient, hessian = float((off * slope).sum()), slope.reshape(-1), block_diag(*self.precision)
        reflectance = np.exp(theta[:, :6])
        for members in self.members:
            brightest = members[int(reflectance[members].sum(1).argmax())]
            total = reflectance[brightest].sum()
            slope = np.zeros_like(theta)
            slope[brightest, :6] = reflectance[brightest] / (total * BRIGHTNESS)
            residual = (np.log(total / 3) - np.log(BRIGHTEST)) / BRIGHTNESS
            value, gradient = value + residual**2, gradient + residual * slope.reshape(-1)
            hessian += np.outer(slope, slope)
        return Gaussian(float(value), gradient, hessian)


def unknowns_of(materials: Materials) -> Float[np.ndarray, "m 7"]:
    """log k_d, log k_s and roughness."""
    reflectance = np.maximum(np.column_stack([materials.diffuse, materials.specular]), LEAST_REFLECTANCE)
    return np.column_stack([np.log(reflectance), np.clip(materials.roughness, *ROUGHNESS)])


def materials_of(theta: Float[np.ndarray, "m 7"]) -> Materials:
    """The inverse of `unknowns_of`."""
    return Materials(np.exp(theta[:, :3]), np.exp(theta[:, 3:6]), theta[:, 6])
