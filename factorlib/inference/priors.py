"""What is expected of materials before any photo is seen.

A material is dielectric, metal or fabric, by shares π_c.  With l = log k_s of its three channels, l̄ their mean and x = (l̄, roughness),

    p(l, roughness) = Σ_c π_c N(x; μ_c, S_c) Π N(l − l̄; 0, τ_c²)                                                  (1)

the last over the two dimensions of l − l̄.  μ_c, S_c and τ_c are those of measured materials (`studies.measured.material_classes`,
material_classes.json), S_c and τ_c widened by what a solve does not know better: the scale of reflectances and the white balance of photos
(SCALE, ROUGHNESS_SLACK, WHITE).  Dielectrics reflect ((n − 1)/(n + 1))² of a ray along the normal, .02 to .08, in all colours alike; metals
more, with a tint; fabrics scatter within, which GGX shows as a strong and very rough part.  So a smooth surface with k_s = .3 is metal, a
k_s of .2 at roughness 1 fabric, and neither is said of a material without evidence.

With r_c the share of class c in the sum (1), half the gradient of −2 log p is Σ_c r_c P_c (x − μ_c), P_c the class's precision.  Σ_c r_c P_c, the
Hessian of the bound by which expectation maximisation descends, is positive definite and stands for half the Hessian.

A factor per channel is free between the materials and the lights of a connected component, unless surfaces light each other, and then it is
known to no more than the model of interreflection is right.  So the brightest material of a component, b the mean over channels of its
k_d + k_s, is expected to be of ordinary brightness:

    (log b − log BRIGHTEST)²/BRIGHTNESS²                                                                             (2)

which is .5 to .95 within two standard deviations; not so where a material or a light of the component is known.  The tint is settled by the prior on lights, whose mean is grey.  A very wide Gaussian about
the start keeps log k_d and roughness finite where observations say nothing.  Where no bounces fix the scale, the answer is brought to the gauge
of `factorlib.inference.gauge` afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from factorlib.inference.blocks import Block
from factorlib.inference.gauge import connected_components
from factorlib.inference.known import Known
from factorlib.inference.materials import LEAST_REFLECTANCE, ROUGHNESS, Materials
from factorlib.jsonfile import read_json
from factorlib.reading import reading

SHIPPED = Path(__file__).with_name("material_classes.json")
# standard deviations of log k_d and of roughness about the start
DIFFUSE = 3.0
ROUGH = 1.0
# standard deviations added in squares to those of l̄, roughness, l − l̄
SCALE = 0.5
ROUGHNESS_SLACK = 0.2
WHITE = 0.1
# of (2)
BRIGHTEST = 0.69
BRIGHTNESS = 0.16
# projections of l on its mean and on what differs from it
MEAN = np.full((3, 3), 1 / 3)
TINTS = np.eye(3) - 1 / 3


class MaterialClass(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """π, μ, S and τ of (1), as measured.  mean, covariance: of the mean log k_s and of roughness."""

    name: str
    share: float
    mean: tuple[float, float]
    covariance: tuple[tuple[float, float], tuple[float, float]]
    tint: float


class Classes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The classes, and the table that they were fitted to: its file's name and the SHA-256 of its bytes."""

    classes: tuple[MaterialClass, ...]
    made_from: str
    sha256: str


@cache
def shipped_classes() -> Classes:
    """The classes of material_classes.json; raises InputError where the file is damaged."""
    with reading("the classes of materials", SHIPPED):
        return msgspec.convert(read_json(SHIPPED), Classes)


class Mixture:
    """Equation (1).  relative, rough: standard deviations that are added to those of l and of roughness."""

    def __init__(self, classes: Sequence[MaterialClass], relative: float = 0.0, rough: float = ROUGHNESS_SLACK):
        self.names = [one.name for one in classes]
        slack = np.diag([SCALE**2 + relative**2, rough**2])
        covariances = [np.array(one.covariance) + slack for one in classes]
        tints = np.array([one.tint**2 + WHITE**2 + relative**2 for one in classes])
        self.mean = np.array([[one.mean[0]] * 3 + [one.mean[1]] for one in classes])
        self.precision = np.zeros((len(classes), 4, 4))
        for P, covariance, variance in zip(self.precision, covariances, tints, strict=True):
            inverse = np.linalg.inv(covariance)
            P[:3, :3] = MEAN * inverse[0, 0] / 3 + TINTS / variance  # l̄ = Σ l/3
            P[:3, 3] = P[3, :3] = inverse[0, 1] / 3
            P[3, 3] = inverse[1, 1]
        determinants = np.array([np.linalg.slogdet(covariance)[1] for covariance in covariances])
        shares = np.array([one.share for one in classes])
        self.constant = determinants + 2 * np.log(tints) - 2 * np.log(shares)

    def at(
        self, x: Float[np.ndarray, "4"]
    ) -> tuple[float, Float[np.ndarray, "4"], Float[np.ndarray, "4 4"], Float[np.ndarray, " c"]]:
        """−2 log p, half its gradient, half its Hessian and the classes' probabilities at x = (log k_s, roughness)."""
        off = x - self.mean
        slope = np.einsum("cij,cj->ci", self.precision, off)
        energy = (off * slope).sum(1) + self.constant
        least = energy.min()
        odds = np.exp(-(energy - least) / 2)
        probability = odds / odds.sum()
        value = float(least - 2 * np.log(odds.sum()))
        return value, probability @ slope, np.einsum("c,cij->ij", probability, self.precision), probability


class Gaussian(NamedTuple):
    """Minus twice a log density, half its gradient and half its Gauss–Newton Hessian by the materials' unknowns."""

    value: float
    gradient: Float[np.ndarray, " 7m"]
    hessian: Float[np.ndarray, "7m 7m"]


class MaterialPrior:
    """The prior on m materials that are linked by some blocks; those without specular part at the start have no prior on it."""

    def __init__(self, start: Materials, blocks: Sequence[Block], known: Known = Known()):
        self.mean = unknowns_of(start)
        self.wide = np.array([DIFFUSE**-2.0] * 3 + [0.0] * 3 + [ROUGH**-2.0])
        self.specular = np.flatnonzero((start.specular > LEAST_REFLECTANCE).any(1)).tolist()
        self.mixture = Mixture(shipped_classes().classes)
        self.members = [
            list(members)
            for members, lights in connected_components(blocks, len(start))
            if members and lights and known.factors(members, lights)
        ]

    def at(self, theta: Float[np.ndarray, "m 7"]) -> Gaussian:
        """Evaluate the prior at the materials' unknowns."""
        off = theta - self.mean
        value = float((off**2 * self.wide).sum())
        gradient = off * self.wide
        hessians = np.tile(np.diag(self.wide), (len(theta), 1, 1))
        for m in self.specular:
            more, slope, curvature, _ = self.mixture.at(theta[m, 3:])
            value = value + more
            gradient[m, 3:] = gradient[m, 3:] + slope
            hessians[m, 3:, 3:] += curvature
        gradient = gradient.reshape(-1)
        hessian = block_diag(*hessians)
        reflectance = np.exp(theta[:, :6])
        for members in self.members:
            brightest = members[int(reflectance[members].sum(1).argmax())]
            total = reflectance[brightest].sum()
            slope = np.zeros_like(theta)
            slope[brightest, :6] = reflectance[brightest] / (total * BRIGHTNESS)
            residual = (np.log(total / 3) - np.log(BRIGHTEST)) / BRIGHTNESS
            value = value + residual**2
            gradient = gradient + residual * slope.reshape(-1)
            hessian += np.outer(slope, slope)
        return Gaussian(float(value), gradient, hessian)


def class_of(specular: Float[np.ndarray, "3"], roughness: float, relative: float, rough: float) -> tuple[str, float]:
    """The likeliest class of a material and its probability.  relative, rough: standard errors of log k_s and of roughness."""
    mixture = Mixture(shipped_classes().classes, relative, rough)
    x = np.append(np.log(np.maximum(specular, LEAST_REFLECTANCE)), roughness)
    probability = mixture.at(x)[3]
    best = int(probability.argmax())
    return mixture.names[best], float(probability[best])


def unknowns_of(materials: Materials) -> Float[np.ndarray, "m 7"]:
    """log k_d, log k_s and roughness."""
    reflectance = np.maximum(np.column_stack([materials.diffuse, materials.specular]), LEAST_REFLECTANCE)
    return np.column_stack([np.log(reflectance), np.clip(materials.roughness, *ROUGHNESS)])


def materials_of(theta: Float[np.ndarray, "m 7"]) -> Materials:
    """The inverse of `unknowns_of`."""
    return Materials(np.exp(theta[:, :3]), np.exp(theta[:, 3:6]), theta[:, 6])
