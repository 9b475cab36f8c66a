"""The noise model: how far radiance may be from what the model says."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float


class Noise(msgspec.Struct, frozen=True):
    """σ² = absolute² + (relative · radiance)², in units of a block's mean radiance.

    The relative part stands for errors that grow with brightness: of a photo's tone curve, of normals, and of too coarse cells.
    """

    absolute: float = 0.05
    relative: float = 0.05
    most_weight: float = 8.0  # a merged observation counts as this many independent ones at most

    def sigma(self, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """σ of one pixel."""
        return np.sqrt(self.absolute**2 + (self.relative * radiance) ** 2)

    def precision(
        self, radiance: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """√weight/σ of observations, their weights limited."""
        limited = weight / (1 + weight / self.most_weight)
        return np.sqrt(limited)[:, None] / self.sigma(radiance)
