"""Unknowns of the joint problem: materials with their ranges, and points of materials and lights."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.inference.model.lights import Light

ROUGHNESS = (0.1, 1.0)  # range of roughness, the domain of the operators
# Range of λ of the paper's lobes: from nearly constant to 1.3° wide, about a texel of the exported map.
SHARPNESS = (0.1, 2000.0)
LEAST_REFLECTANCE = 1e-5  # keeps a black material inside its bounds
REFLECTANCES = 6  # unknowns that are reflectances: k_d and k_s, RGB each
UNKNOWNS = REFLECTANCES + 1  # of a material: k_d, k_s, roughness


class Materials(msgspec.Struct, frozen=True):
    """Reflectances and roughnesses of m materials.

    Attributes:
        diffuse: k_d per channel.
        specular: k_s per channel.
        roughness: GGX roughness, α = roughness².
    """

    diffuse: Float[np.ndarray, "m 3"]
    specular: Float[np.ndarray, "m 3"]
    roughness: Float[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.roughness)

    def vector(self) -> Float[np.ndarray, " 7m"]:
        """Return seven unknowns a material: diffuse RGB, specular RGB, roughness."""
        return np.column_stack([self.diffuse, self.specular, self.roughness]).reshape(-1)

    def rows(self) -> Float[np.ndarray, "m 7"]:
        """Return a copy of the unknowns, one material a row."""
        return self.vector().reshape(-1, UNKNOWNS)

    @staticmethod
    def from_rows(rows: Float[np.ndarray, "m 7"]) -> Materials:
        """Return the materials with these rows of unknowns."""
        return Materials(rows[:, :3], rows[:, 3:REFLECTANCES], rows[:, REFLECTANCES])

    @staticmethod
    def from_vector(vector: Float[np.ndarray, " 7m"]) -> Materials:
        """Return the nearest materials within bounds."""
        rows = vector.reshape(-1, UNKNOWNS)
        reflectance = np.maximum(rows[:, :REFLECTANCES], LEAST_REFLECTANCE)
        return Materials(reflectance[:, :3], reflectance[:, 3:], np.clip(rows[:, REFLECTANCES], *ROUGHNESS))


class MaterialErrors(msgspec.Struct, frozen=True):
    """Standard errors of the material unknowns.

    Attributes:
        materials: Standard error of every unknown.
        deviation: Standard deviation of the residuals, in σ of the noise model.
        prior_share: Share of every unknown that comes from the prior, 0 to 1.
    """

    materials: Materials = Materials(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    deviation: float = 0.0
    prior_share: Float[np.ndarray, "m 7"] = np.zeros((0, UNKNOWNS))


class Point(msgspec.Struct, frozen=True):
    """Materials of a problem, and one light for each of its blocks, in their order."""

    materials: Materials
    lights: list[Light]
