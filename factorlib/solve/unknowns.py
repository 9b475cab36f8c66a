"""What is solved for: materials (shared), and lights with their lobes, exposures and tones (one per illumination).

A lobe's unknowns are chosen so that what the data hold fixed stays put while another unknown moves: its energy
e = w/λ' rather than its peak w, λ' = λ/(1 − e^{−2λ}), and

    s = −log(1/λ + b),      b = 2 min α²

rather than log λ.  A reflection widens a lobe's variance 1/λ by about b, so the sum is what is seen: a rougher surface
under a sharper lobe looks the same along a line of s, which steps in log λ would only follow in small ones.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.light.lobes import lobe_integral

ROUGHNESS = (0.1, 1.0)  # the operators' domain
SHARPNESS = (0.1, 2000.0)  # from nearly constant to 1.3° wide, about a texel of the exported map
RESOLVED = 16.0  # a lobe this many times as sharp as the sharpest reflection widens it by 3 %: nothing sharper can be told
TONE = (0.6, 1.7)  # exponents of tone curves: what cameras do
LEAST_REFLECTANCE = 1e-5  # keeps a black material inside its bounds


class Materials(msgspec.Struct, frozen=True):
    """m materials; diffuse and specular reflectance per channel, GGX roughness (α = roughness²)."""

    diffuse: Float[np.ndarray, "m 3"]
    specular: Float[np.ndarray, "m 3"]
    roughness: Float[np.ndarray, "m"]

    def __len__(self) -> int:
        return len(self.roughness)

    def vector(self) -> Float[np.ndarray, "7m"]:
        """Seven unknowns a material: diffuse RGB, specular RGB, roughness."""
        return np.column_stack([self.diffuse, self.specular, self.roughness]).reshape(-1)

    @property
    def blur(self) -> float:
        """b: by how much the least rough material widens a lobe's variance, about."""
        return 2 * float(self.roughness.min()) ** 4

    @property
    def sharpest(self) -> float:
        """The sharpness of lobes beyond which all reflect alike."""
        return sharpest_told(self.blur)

    @staticmethod
    def of_vector(vector: Float[np.ndarray, "7m"]) -> Materials:
        """The nearest materials within bounds."""
        rows = vector.reshape(-1, 7)
        reflectance = np.maximum(rows[:, :6], LEAST_REFLECTANCE)
        return Materials(reflectance[:, :3], reflectance[:, 3:], np.clip(rows[:, 6], *ROUGHNESS))


def sharpest_told(blur: float) -> float:
    """The sharpness of lobes that widen a reflection of variance `blur` just so little that nothing sharper can be told."""
    return min(RESOLVED / blur, SHARPNESS[1])


class Light(msgspec.Struct, frozen=True):
    """p lobes w·exp(λ(ω·z − 1)) of one illumination and the log exposures of its f photos (the first is 0).

    log_tone: log exponents of the photos' tone curves (`images.tone`); none where the photos are taken to be linear
    """

    axis: Float[np.ndarray, "p 3"]  # unit, in the illumination's frame
    log_sharpness: Float[np.ndarray, "p"]
    weight: Float[np.ndarray, "p 3"]  # in the illumination's own radiance unit
    log_exposure: Float[np.ndarray, "f"]
    log_tone: Float[np.ndarray, "f"] = msgspec.field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.log_sharpness)

    @property
    def sharpness(self) -> Float[np.ndarray, "p"]:
        return np.exp(self.log_sharpness)

    def tangents(self) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
        """Two unit vectors that span each axis' tangent plane."""
        helper = np.where(np.abs(self.axis[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        first = np.cross(self.axis, helper)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return first, np.cross(self.axis, first)

    @property
    def spread(self) -> Float[np.ndarray, "p"]:
        """1/λ': energy of a lobe of unit weight over 2π, steradians."""
        return lobe_integral(self.sharpness) / (2 * np.pi)

    @property
    def energy(self) -> Float[np.ndarray, "p 3"]:
        return self.weight * self.spread[:, None]

    def sharpness_slopes(self, blur: float) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
        """∂ log λ/∂s and, the energy held, ∂ log w/∂s."""
        by_s = 1 + blur * self.sharpness
        doubled = np.maximum(2 * self.sharpness, 1e-9)
        return by_s, by_s * (1 - doubled / np.expm1(np.minimum(doubled, 700.0)))

    def moved(self, step: Float[np.ndarray, "l"], blur: float) -> Light:
        """Apply a step in the unknowns [tangent 1, tangent 2, s, e_R, e_G, e_B] × p, exposures 1…f−1, tones; blur is b."""
        p = len(self)
        by = step[: 6 * p].reshape(6, p)
        first, second = self.tangents()
        turn = np.clip(by[:2], -0.3, 0.3)
        axis = self.axis + turn[0][:, None] * first + turn[1][:, None] * second
        variance = (1 / self.sharpness + blur) * np.exp(-np.clip(by[2], -1, 1)) - blur
        log_sharpness = -np.log(np.clip(variance, 1 / sharpest_told(blur), 1 / SHARPNESS[0]))
        by_exposure, by_tone = np.split(step[6 * p :], [len(self.log_exposure) - 1])
        return Light(
            axis / np.linalg.norm(axis, axis=1, keepdims=True),
            log_sharpness,
            np.maximum(self.energy + by[3:].T, 0.0) / (lobe_integral(np.exp(log_sharpness))[:, None] / (2 * np.pi)),
            self.log_exposure + np.concatenate([[0.0], np.clip(by_exposure, -1, 1)]),
            np.clip(self.log_tone + np.clip(by_tone, -0.2, 0.2), *np.log(TONE)),
        )

    def take(self, rows) -> Light:
        return msgspec.structs.replace(self, axis=self.axis[rows], log_sharpness=self.log_sharpness[rows], weight=self.weight[rows])

    def joined(self, axis, log_sharpness, weight) -> Light:
        """With further lobes appended."""
        return msgspec.structs.replace(
            self,
            axis=np.vstack([self.axis, axis]),
            log_sharpness=np.concatenate([self.log_sharpness, log_sharpness]),
            weight=np.vstack([self.weight, weight]),
        )

    @property
    def unknowns(self) -> int:
        """How many: the length of a step."""
        return 6 * len(self) + len(self.log_exposure) - 1 + len(self.log_tone)
