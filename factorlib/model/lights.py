"""A light: log radiance on cells of the sphere, and the exposures and tone curves of its photos.

A cell is a lobe w·exp(λ(ω·z − 1)), half as wide as its neighbours are apart, so that equal weights make a nearly constant light:

    λ = 1 / (WIDTH · spacing)²,      w = PEAK · exp(u),      PEAK = 1 / (2π WIDTH²)                                  (1)

With n cells on the sphere the spacing is √(4π/n), and n/(2λ) = 2π WIDTH² of them overlap in any direction.  That number does not depend on
n, so u is the log radiance of a cell of any size, and a cell that splits in four (λ four times as large, each four a quarter of a spacing to
either side) keeps the light as it is but for its own blur.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.light.lobes import lobe_integral

WIDTH = 0.5  # of a cell, in spacings: equal weights are a constant light to 2 % (RMS); wider ones blur a sun more than materials do
PEAK = 1 / (2 * np.pi * WIDTH**2)
DARKEST = 1e-12  # weight below which a lobe counts as dark, for its logarithm


class UnitLobes(msgspec.Struct, frozen=True):
    """p lobes exp(λ(ω·z − 1)) of weight one.

    axis: z, unit, in the frame of the illumination;  sharpness: λ > 0
    """

    axis: Float[np.ndarray, "p 3"]
    sharpness: Float[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.sharpness)


def even_cells(count: int) -> UnitLobes:
    """`count` cells of one size, equation (1)."""
    return UnitLobes(fibonacci_sphere(count), np.full(count, count / (4 * np.pi * WIDTH**2)))


class Light(msgspec.Struct, frozen=True):
    """p lobes w·exp(λ(ω·z − 1)) of one illumination and the log exposures of its f photos (the first is 0).

    log_tone: log exponents of the photos' tone curves (`images.tone`); none where the photos are taken to be linear
    """

    axis: Float[np.ndarray, "p 3"]  # unit, in the illumination's frame
    log_sharpness: Float[np.ndarray, " p"]
    weight: Float[np.ndarray, "p 3"]  # in the illumination's own radiance unit
    log_exposure: Float[np.ndarray, " f"]
    log_tone: Float[np.ndarray, " f"] = msgspec.field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.log_sharpness)

    @property
    def sharpness(self) -> Float[np.ndarray, " p"]:
        """λ of each lobe."""
        return np.exp(self.log_sharpness)

    @property
    def unit_lobes(self) -> UnitLobes:
        """The lobes without their weights."""
        return UnitLobes(self.axis, self.sharpness)

    @property
    def log_radiance(self) -> Float[np.ndarray, "3 p"]:
        """u of each cell, channel by channel: equation (1)."""
        return np.log(np.maximum(self.weight.T, DARKEST) / PEAK)

    @property
    def energy(self) -> Float[np.ndarray, "p 3"]:
        """Energy of each lobe over 2π, in the illumination's radiance unit times steradians."""
        return self.weight * (lobe_integral(self.sharpness) / (2 * np.pi))[:, None]

    @property
    def unknowns(self) -> int:
        """The number of unknowns that `moved` takes: log radiances, exposures of all photos but the first, tone exponents."""
        return 3 * len(self) + len(self.log_exposure) - 1 + len(self.log_tone)

    def with_log_radiance(self, u: Float[np.ndarray, "3 p"]) -> Light:
        """The same cells with other radiances."""
        return msgspec.structs.replace(self, weight=PEAK * np.exp(u.T))

    def split(self, which: Bool[np.ndarray, " p"]) -> Light:
        """The light with each cell of `which` replaced by four of its radiance, which follow all others: see the head of the module."""
        axis, sharpness = self.axis[which], self.sharpness[which]
        first, second = tangents(axis)
        aside = (0.25 / (WIDTH * np.sqrt(sharpness)))[:, None]
        corners = [axis + aside * (a * first + b * second) for a in (-1, 1) for b in (-1, 1)]
        corners = np.vstack([corner / np.linalg.norm(corner, axis=1, keepdims=True) for corner in corners])
        return msgspec.structs.replace(
            self,
            axis=np.vstack([self.axis[~which], corners]),
            log_sharpness=np.concatenate([self.log_sharpness[~which], np.tile(self.log_sharpness[which] + np.log(4), 4)]),
            weight=np.vstack([self.weight[~which], np.tile(self.weight[which], (4, 1))]),
        )


def tangents(axis: Float[np.ndarray, "p 3"]) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    """Two unit vectors that span the tangent plane of each unit `axis`."""
    helper = np.where(np.abs(axis[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axis, first)
