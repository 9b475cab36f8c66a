"""The materials of a problem, and their vector of unknowns."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.model.bounds import LEAST_REFLECTANCE, ROUGHNESS, sharpest_resolved


class Materials(msgspec.Struct, frozen=True):
    """m materials; diffuse and specular reflectance per channel, GGX roughness (α = roughness²)."""

    diffuse: Float[np.ndarray, "m 3"]
    specular: Float[np.ndarray, "m 3"]
    roughness: Float[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.roughness)

    def vector(self) -> Float[np.ndarray, " 7m"]:
        """Seven unknowns a material: diffuse RGB, specular RGB, roughness."""
        return np.column_stack([self.diffuse, self.specular, self.roughness]).reshape(-1)

    def rows(self) -> Float[np.ndarray, "m 7"]:
        """The unknowns, one material a row; a copy."""
        return self.vector().reshape(-1, 7)

    @staticmethod
    def of_vector(vector: Float[np.ndarray, " 7m"]) -> Materials:
        """The nearest materials within bounds."""
        rows = vector.reshape(-1, 7)
        reflectance = np.maximum(rows[:, :6], LEAST_REFLECTANCE)
        return Materials(reflectance[:, :3], reflectance[:, 3:], np.clip(rows[:, 6], *ROUGHNESS))

    @property
    def blur(self) -> float:
        """b = 2 min α²: about how much the least rough material widens a lobe's variance 1/λ."""
        return 2 * float(self.roughness.min()) ** 4

    @property
    def sharpest(self) -> float:
        """The largest sharpness that can be resolved: reflections of sharper lobes look the same."""
        return sharpest_resolved(self.blur)

    def lambertian(self, m: int) -> Materials:
        """With material m Lambertian: its specular reflectance is added to its diffuse one."""
        diffuse, specular = self.diffuse.copy(), self.specular.copy()
        diffuse[m] += specular[m]
        specular[m] = LEAST_REFLECTANCE
        return Materials(diffuse, specular, self.roughness)
