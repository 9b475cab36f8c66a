"""Noise model of the radiance, and robust loss of its residuals."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float


class Noise(msgspec.Struct, frozen=True):
    """Noise model σ² = absolute² + (relative · radiance)², in units of a block's mean radiance.

    The relative part covers errors that grow with brightness: of a photo's tone curve, of normals, and of too coarse
    cells.

    Attributes:
        absolute: σ in the dark.
        relative: Part of σ that is proportional to radiance, per radiance.
        most_weight: Limit of the number of independent observations that a merged one counts for.
    """

    absolute: float = 0.05
    relative: float = 0.05
    most_weight: float = 8.0

    def sigma(self, radiance: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return σ of one pixel."""
        return np.sqrt(self.absolute**2 + (self.relative * radiance) ** 2)

    def precision(
        self, radiance: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return √weight/σ of observations, with their weights limited."""
        # smooth limit of the weight
        limited = weight / (1 + weight / self.most_weight)
        return np.sqrt(limited)[:, None] / self.sigma(radiance)


class RobustLoss(msgspec.Struct, frozen=True):
    """Pseudo-Huber loss, Σ 2k² (√(1 + r²/k²) − 1) of whitened residuals r.

    It bounds the influence of wrong normals and mask borders.

    Attributes:
        robust_scale: k, in σ.
    """

    robust_scale: float = 10.0

    def evaluate(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the loss of each whitened residual."""
        return 2 * self.robust_scale**2 * (np.sqrt(1 + (residual / self.robust_scale) ** 2) - 1)

    def weights(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return weights in ]0, 1] of the squared residuals, for least-squares steps of this loss."""
        return 1 / np.sqrt(1 + (residual / self.robust_scale) ** 2)
