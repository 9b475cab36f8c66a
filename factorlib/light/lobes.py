"""Light as a sum of spherical Gaussian lobes w · exp(λ(ω·z − 1)).

The exponent is computed as −λ|ω − z|²/2 or from half angles.  The form λ(ω·z − 1) has no digits left at λ = 10⁶ in
single precision.  The integral of a unit lobe is 2π(−expm1(−2λ))/λ, and a series where λ is small.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float

SMALL_SHARPNESS = 1e-3  # λ below which the integral is a series
SUN_DEG = 0.53  # diameter of the sun's disc, degrees
HARD_RADIUS = np.radians(15)  # of the region that holds `HARD_SHARE` of a light with a small bright source
HARD_SHARE = 0.25  # the sun holds a quarter to two thirds of the light where it shines
SUN = 4 / np.radians(SUN_DEG / 2) ** 2  # λ of the lobe whose RMS width is that of the disc


class Lobes(msgspec.Struct, frozen=True):
    """Set of p lobes w · exp(λ(ω·z − 1)), float64.

    Attributes:
        axis: z, unit, in the illumination's frame.
        sharpness: λ ≥ 0.
        weight: w ≥ 0, radiance at the axis per channel, linear Rec. 709.
    """

    axis: Float[np.ndarray, "p 3"]
    sharpness: Float[np.ndarray, " p"]
    weight: Float[np.ndarray, "p 3"]

    def __len__(self) -> int:
        return len(self.sharpness)

    def rotate(self, rotation: Float[np.ndarray, "3 3"]) -> Lobes:
        """Return the same light in another frame, `rotation` = new_from_old."""
        return Lobes(self.axis @ np.asarray(rotation).T, self.sharpness, self.weight)

    def scale(self, factor: float | Float[np.ndarray, "3"]) -> Lobes:
        """Return the light times `factor`, a number or one per channel."""
        return Lobes(self.axis, self.sharpness, self.weight * np.asarray(factor))

    def radiance(self, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the sum of the lobes in unit `directions`."""
        return np.exp(-0.5 * self.sharpness * squared_distances(directions, self.axis)) @ self.weight

    @property
    def suns(self) -> Bool[np.ndarray, " p"]:
        """Mask of the lobes that are as narrow as the sun."""
        return self.sharpness > 0.9 * SUN

    def take(self, selected: Bool[np.ndarray, " p"]) -> Lobes:
        """Return the light of the selected lobes."""
        return Lobes(self.axis[selected], self.sharpness[selected], self.weight[selected])

    @property
    def energy(self) -> Float[np.ndarray, "3"]:
        """Integral of the light over the sphere, radiance × steradian."""
        return lobe_energy(self.sharpness) @ self.weight


def squared_distances(directions: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "n p"]:
    """Return |ω − z|², computed from differences to keep its digits where it is small."""
    return sum((directions[:, None, k] - axes[None, :, k]) ** 2 for k in range(3))


def lobe_energy(sharpness: float | Float[np.ndarray, "*p"]) -> Float[np.ndarray, "*p"]:
    """Return ∫ exp(λ(ω·z − 1)) dω over the sphere, steradian.

    >>> (lobe_energy(np.array([0.0, 1e-12, 1e6])) / np.pi).round(9).tolist()
    [4.0, 4.0, 2e-06]
    """
    sharpness = np.asarray(sharpness, dtype=float)
    small = sharpness < SMALL_SHARPNESS
    safe = np.where(small, 1.0, sharpness)
    series = 2 - 2 * sharpness + 4 / 3 * sharpness**2
    return 2 * np.pi * np.where(small, series, -np.expm1(-2 * safe) / safe)


def is_hard(axis: Float[np.ndarray, "p 3"], energy: Float[np.ndarray, " p"]) -> bool:
    """Return True if a light has a small bright source, which casts hard shadows and shows in highlights.

    Args:
        axis: Directions of its lobes.
        energy: Energy of each lobe.
    """
    near = axis @ axis.T > np.cos(HARD_RADIUS)
    return bool((near @ energy).max(initial=0) > HARD_SHARE * energy.sum())


def no_lobes() -> Lobes:
    """Return a light without lobes, which is dark."""
    return Lobes(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
