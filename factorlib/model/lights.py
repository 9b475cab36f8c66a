"""A light: its lobes, and the exposures and tone curves of its photos, with their vector of unknowns.

A lobe's unknowns are chosen so that they hardly depend on each other: its energy e = w/λ', with λ' = λ/(1 − e^{−2λ}), instead of
its peak w, and

    s = −log(1/λ + b),      b = 2 min α²

instead of log λ.  A reflection widens a lobe's variance 1/λ by about b, so photographs show the sum 1/λ + b.  A rougher surface under
a sharper lobe looks the same; in s such a change is a straight line, in log λ a curve that only small steps can follow.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.light.lobes import lobe_integral
from factorlib.model.bounds import SHARPNESS, TONE, sharpest_resolved

MOST_TURN, MOST_S, MOST_EXPOSURE, MOST_TONE = 0.3, 1.0, 1.0, 0.2  # largest change of an unknown in one step


class UnitLobes(msgspec.Struct, frozen=True):
    """p lobes exp(λ(ω·z − 1)) of weight one.

    axis: z, unit, in the frame of the illumination;  sharpness: λ > 0
    """

    axis: Float[np.ndarray, "p 3"]
    sharpness: Float[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.sharpness)


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
    def unknowns(self) -> int:
        """How many unknowns the light has: the length of a step."""
        return 6 * len(self) + len(self.log_exposure) - 1 + len(self.log_tone)

    @property
    def unit_energy(self) -> Float[np.ndarray, " p"]:
        """1/λ': energy of a lobe of unit weight over 2π, steradians."""
        return lobe_integral(self.sharpness) / (2 * np.pi)

    @property
    def energy(self) -> Float[np.ndarray, "p 3"]:
        """e: energy of each lobe over 2π, in the illumination's radiance unit times steradians."""
        return self.weight * self.unit_energy[:, None]

    def tangents(self) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
        """Two unit vectors that span each axis' tangent plane."""
        helper = np.where(np.abs(self.axis[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        first = np.cross(self.axis, helper)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return first, np.cross(self.axis, first)

    def sharpness_slopes(self, blur: float) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """∂ log λ/∂s and, at constant energy, ∂ log w/∂s;  blur: b."""
        by_s = 1 + blur * self.sharpness
        doubled = np.maximum(2 * self.sharpness, 1e-9)
        return by_s, by_s * (1 - doubled / np.expm1(np.minimum(doubled, 700.0)))

    def moved(self, step: Float[np.ndarray, " l"], blur: float) -> Light:
        """The light after a step in the unknowns [tangent 1, tangent 2, s, e_R, e_G, e_B] × p, exposures 1…f−1, tones; blur is b."""
        p = len(self)
        by = step[: 6 * p].reshape(6, p)
        first, second = self.tangents()
        turn = np.clip(by[:2], -MOST_TURN, MOST_TURN)
        axis = self.axis + turn[0][:, None] * first + turn[1][:, None] * second
        variance = (1 / self.sharpness + blur) * np.exp(-np.clip(by[2], -MOST_S, MOST_S)) - blur
        log_sharpness = -np.log(np.clip(variance, 1 / sharpest_resolved(blur), 1 / SHARPNESS[0]))
        by_exposure, by_tone = np.split(step[6 * p :], [len(self.log_exposure) - 1])
        return Light(
            axis / np.linalg.norm(axis, axis=1, keepdims=True),
            log_sharpness,
            np.maximum(self.energy + by[3:].T, 0.0) / (lobe_integral(np.exp(log_sharpness))[:, None] / (2 * np.pi)),
            self.log_exposure + np.concatenate([[0.0], np.clip(by_exposure, -MOST_EXPOSURE, MOST_EXPOSURE)]),
            np.clip(self.log_tone + np.clip(by_tone, -MOST_TONE, MOST_TONE), *np.log(TONE)),
        )

    def take(self, rows: np.ndarray | slice) -> Light:
        """The lobes `rows` alone, by numbers or a mask."""
        return msgspec.structs.replace(self, axis=self.axis[rows], log_sharpness=self.log_sharpness[rows], weight=self.weight[rows])

    def joined(self, lobes: UnitLobes, weight: Float[np.ndarray, "q 3"]) -> Light:
        """With q further lobes appended."""
        return msgspec.structs.replace(
            self,
            axis=np.vstack([self.axis, lobes.axis]),
            log_sharpness=np.concatenate([self.log_sharpness, np.log(lobes.sharpness)]),
            weight=np.vstack([self.weight, weight]),
        )
