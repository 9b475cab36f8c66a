"""Prior on materials: a mixture of dielectrics, metals and fabrics, and ordinary brightness.

A material is dielectric, metal or fabric, with shares π_c.  Let l = log k_s of its three channels, l̄ their mean, x =
(l̄, roughness), and e the tint of k_s less that of k_d + k_s, where the tint of k is log k less its mean:

    p(l, roughness | k_d) ∝ Σ_c π_c N(x; μ_c, S_c) N(l − l̄; 0, τ_c²) exp(−|e|²/2ε_c²).                              (1)

Dielectrics reflect ((n − 1)/(n + 1))² of a ray along the normal, 0.02 to 0.08, equally in all colours.  Metals
reflect more, with a tint.  Fabrics scatter within, and GGX shows this as a strong and very rough part.  Both parts of
metals and fabrics have one tint (ε); without ε, orange wood of a blue specular part would be a fabric.  N(l − l̄) is
over two dimensions.  The factor with ε is not normalised: it is 1 where k_d is 0 and smaller where tints
differ, so that metals and fabrics are then less likely than π.  For example, k_s = 0.3 on a smooth surface indicates a
metal, and k_s = 0.2 at roughness 1 a fabric.  Where the user names a material's class, that one alone has a share.

μ_c, S_c, τ_c and ε_c are those of measured materials (`studies.measured.material_classes`, material_classes.json).
All but ε_c are widened by the unknown scale of reflectances and the unknown white balance of photos
(`SCALE_DEVIATION`, `CLASS_ROUGHNESS_DEVIATION`, `WHITE_DEVIATION`).

Let r_c be the share of class c in the sum (1).  Half the gradient of −2 log p is the mean of the classes' under r_c.
Half the Hessian is approximated by the mean of their precisions, JᵀJ/ε_c² for e, the Hessian of the bound of
expectation maximisation, which is positive definite.

A factor per channel is free between the materials and the lights of a connected component, unless surfaces light each
other.  Then it is known only as well as the model of interreflection holds.  So the brightest material of a component
is expected to be of ordinary brightness.  Let b be the mean over channels of its k_d + k_s:

    (log b − log MEDIAN_BRIGHTNESS)²/BRIGHTNESS_DEVIATION²                                                       (2)

b lies between 0.5 and 0.95 within two standard deviations.  (2) does not apply where a material or a light of the
component is known.  The prior on lights, whose mean is grey, settles the tint.  A very wide Gaussian about the start
keeps log k_d and roughness finite where observations are uninformative.  Where no interreflection fixes the scale, the
answer is later brought to the gauge of `factorlib.inference.model.gauge`.
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

from factorlib.inference.model.blocks import Block
from factorlib.inference.model.gauge import BRIGHTNESS_DEVIATION, MEDIAN_BRIGHTNESS, connected_components
from factorlib.inference.model.known import KnownValues
from factorlib.inference.model.materials import LEAST_REFLECTANCE, REFLECTANCES, ROUGHNESS, UNKNOWNS, Materials
from factorlib.jsonfile import read_json
from factorlib.reading import reading

SHIPPED = Path(__file__).with_name("material_classes.json")
DIFFUSE_DEVIATION = 3.0  # standard deviation of log k_d about the start
ROUGHNESS_DEVIATION = 1.0  # standard deviation of roughness about the start
# Standard deviations that are added in quadrature to those of l̄, roughness and l − l̄.
SCALE_DEVIATION = 0.5
CLASS_ROUGHNESS_DEVIATION = 0.2
WHITE_DEVIATION = 0.1
# Projections of l on its mean and on the difference from it.
MEAN = np.full((3, 3), 1 / 3)
TINTS = np.eye(3) - 1 / 3


class MaterialClass(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Class of measured materials: π, μ, S, τ and ε of (1).

    Attributes:
        name: Name of the class.
        share: π.
        mean: μ of the mean log k_s and of roughness.
        covariance: S of the same.
        tint: τ.
        tint_difference: ε; None if both parts may have any tints.
    """

    name: str
    share: float
    mean: tuple[float, float]
    covariance: tuple[tuple[float, float], tuple[float, float]]
    tint: float
    tint_difference: float | None = None


class Classes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Material classes, and the table that they were fitted to.

    Attributes:
        classes: The classes.
        made_from: Name of the table's file.
        sha256: SHA-256 of its bytes.
    """

    classes: tuple[MaterialClass, ...]
    made_from: str
    sha256: str


@cache
def shipped_classes() -> Classes:
    """Read the classes of material_classes.json.

    Raises:
        InputError: If the file is damaged.
    """
    with reading("the classes of materials", SHIPPED):
        return msgspec.convert(read_json(SHIPPED), Classes)


def classes_of(name: str | None) -> tuple[MaterialClass, ...]:
    """Return the classes that a material may have: the named one, or all of them."""
    return tuple(one for one in shipped_classes().classes if name in (None, one.name))


class Mixture:
    """Mixture of material classes, (1).

    Args:
        classes: The classes.
        relative: Standard deviation that is added to those of logarithms, in quadrature.
        rough: Standard deviation that is added to that of roughness, in quadrature.
        one_tint: False to leave out ε.
    """

    def __init__(
        self,
        classes: Sequence[MaterialClass],
        relative: float = 0.0,
        rough: float = CLASS_ROUGHNESS_DEVIATION,
        one_tint: bool = True,
    ):
        self.names = [material_class.name for material_class in classes]
        slack = np.diag([SCALE_DEVIATION**2 + relative**2, rough**2])
        covariances = [np.array(material_class.covariance) + slack for material_class in classes]
        self.mean = np.array([[material_class.mean[0]] * 3 + [material_class.mean[1]] for material_class in classes])
        self.precision = np.zeros((len(classes), 4, 4))
        # τ², and 1/ε² of each class; e, a difference of two tints, does not depend on white balance
        tints = np.array([material_class.tint**2 + WHITE_DEVIATION**2 + relative**2 for material_class in classes])
        differences = [material_class.tint_difference if one_tint else None for material_class in classes]
        self.difference = np.array([0.0 if each is None else 1 / (each**2 + relative**2) for each in differences])
        # precision of (log k_s, roughness), [4, 4] a class, but for e
        for P, covariance, variance in zip(self.precision, covariances, tints, strict=True):
            inverse = np.linalg.inv(covariance)
            P[:3, :3] = MEAN * inverse[0, 0] / 3 + TINTS / variance  # l̄ = Σ l/3
            P[:3, 3] = P[3, :3] = inverse[0, 1] / 3
            P[3, 3] = inverse[1, 1]
        determinants = np.array([np.linalg.slogdet(covariance)[1] for covariance in covariances])
        shares = np.array([material_class.share for material_class in classes])
        self.constant = determinants + 2 * np.log(tints) - 2 * np.log(shares)

    def evaluate(
        self, theta: Float[np.ndarray, "7"]
    ) -> tuple[float, Float[np.ndarray, "7"], Float[np.ndarray, "7 7"], Float[np.ndarray, " c"]]:
        """Return −2 log p, half its gradient, half its Hessian and the class probabilities.

        theta is (log k_d, log k_s, roughness), with logarithms of three channels.
        """
        off = theta[3:] - self.mean
        slope = np.einsum("cij,cj->ci", self.precision, off)
        energy = (off * slope).sum(1) + self.constant
        # e and its Jacobian by log k_d and log k_s
        share = 1 / (1 + np.exp(theta[3:6] - theta[:3]))  # k_d/(k_d + k_s)
        e = -TINTS @ np.logaddexp(0, theta[:3] - theta[3:6])
        J = (TINTS * share) @ np.hstack([-np.eye(3), np.eye(3)])
        energy = energy + self.difference * (e @ e)
        least = energy.min()
        odds = np.exp(-(energy - least) / 2)
        probability = odds / odds.sum()
        value = float(least - 2 * np.log(odds.sum()))
        # means over the classes
        difference = probability @ self.difference
        gradient, hessian = np.zeros(UNKNOWNS), np.zeros((UNKNOWNS, UNKNOWNS))
        gradient[3:] = probability @ slope
        gradient[:REFLECTANCES] += difference * (J.T @ e)
        hessian[3:, 3:] = np.einsum("c,cij->ij", probability, self.precision)
        hessian[:REFLECTANCES, :REFLECTANCES] += difference * (J.T @ J)
        return value, gradient, hessian, probability


class PriorTerms(NamedTuple):
    """Minus twice a log density, half its gradient and half its Gauss–Newton Hessian by the material unknowns."""

    value: float
    gradient: Float[np.ndarray, " 7m"]
    hessian: Float[np.ndarray, "7m 7m"]


class MaterialPrior:
    """Prior on m materials: their classes, (1), and the brightness of linked materials, (2).

    The start is that of the present fit, so the wide Gaussian about it moves from fit to fit.  Materials without a
    specular part at the start have no prior on it.

    Args:
        start: Materials at the start.
        blocks: Observations by illumination.
        known: Known values.
        one_tint: False to leave out ε of (1).
    """

    def __init__(
        self, start: Materials, blocks: Sequence[Block], known: KnownValues = KnownValues(), one_tint: bool = True
    ):
        self.mean = material_unknowns(start)
        self.wide = np.array([DIFFUSE_DEVIATION**-2.0] * 3 + [0.0] * 3 + [ROUGHNESS_DEVIATION**-2.0])
        self.specular = np.flatnonzero((start.specular > LEAST_REFLECTANCE).any(1)).tolist()
        self.mixtures = [Mixture(classes_of(known.classes.get(m)), one_tint=one_tint) for m in range(len(start))]
        self.members = [
            list(members)
            for members, lights in connected_components(blocks, len(start))
            if members and lights and known.free_factors(members, lights)
        ]

    def evaluate(self, theta: Float[np.ndarray, "m 7"]) -> PriorTerms:
        """Evaluate the prior at the materials' unknowns."""
        # wide Gaussian about the start, then (1)
        off = theta - self.mean
        value = float((off**2 * self.wide).sum())
        gradient = off * self.wide
        hessians = np.tile(np.diag(self.wide), (len(theta), 1, 1))
        for m in self.specular:
            energy, slope, curvature, _ = self.mixtures[m].evaluate(theta[m])
            value = value + energy
            gradient[m] = gradient[m] + slope
            hessians[m] += curvature
        gradient = gradient.reshape(-1)
        hessian = block_diag(*hessians)
        # (2) of each component's brightest material
        reflectance = np.exp(theta[:, :REFLECTANCES])
        for members in self.members:
            brightest = members[int(reflectance[members].sum(1).argmax())]
            total = reflectance[brightest].sum()
            slope = np.zeros_like(theta)
            slope[brightest, :6] = reflectance[brightest] / (total * BRIGHTNESS_DEVIATION)
            residual = (np.log(total / 3) - np.log(MEDIAN_BRIGHTNESS)) / BRIGHTNESS_DEVIATION
            value = value + residual**2
            gradient = gradient + residual * slope.reshape(-1)
            hessian += np.outer(slope, slope)
        return PriorTerms(float(value), gradient, hessian)


def likeliest_class(
    theta: Float[np.ndarray, "7"], relative: float, rough: float, name: str | None = None
) -> tuple[str, float]:
    """Return the likeliest class of a material and its probability.

    Classes are widened by the standard errors; in a fit they are widened by `CLASS_ROUGHNESS_DEVIATION`.

    Args:
        theta: Unknowns of the material (`material_unknowns`).
        relative: Standard error of log k_s.
        rough: Standard error of roughness.
        name: Class that the user named.
    """
    mixture = Mixture(classes_of(name), relative, rough)
    probability = mixture.evaluate(theta)[3]
    best = int(probability.argmax())
    return mixture.names[best], float(probability[best])


def material_unknowns(materials: Materials) -> Float[np.ndarray, "m 7"]:
    """Return log k_d, log k_s and roughness."""
    reflectance = np.maximum(np.column_stack([materials.diffuse, materials.specular]), LEAST_REFLECTANCE)
    return np.column_stack([np.log(reflectance), np.clip(materials.roughness, *ROUGHNESS)])


def materials_from_unknowns(theta: Float[np.ndarray, "m 7"]) -> Materials:
    """Return the materials with these unknowns, the inverse of `material_unknowns`."""
    return Materials(np.exp(theta[:, :3]), np.exp(theta[:, 3:6]), theta[:, 6])
