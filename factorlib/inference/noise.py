"""How far radiance may be from what the model says, and what it costs to be farther."""

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


class Loss(msgspec.Struct, frozen=True):
    """Pseudo-Huber, Σ 2k² (√(1 + r²/k²) − 1) of whitened residuals r, so that wrong normals and mask borders pull with bounded force.

    robust_scale  k, in σ
    """

    robust_scale: float = 10.0

    def of_residuals(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The loss of each whitened residual."""
        return 2 * self.robust_scale**2 * (np.sqrt(1 + (residual / self.robust_scale) ** 2) - 1)

    def trust(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Weights in ]0, 1] of the squared residuals, with which a least-squares step is a step of this loss."""
        return 1 / np.sqrt(1 + (residual / self.robust_scale) ** 2)
