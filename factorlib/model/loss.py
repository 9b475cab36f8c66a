"""The loss that a point is judged by: pseudo-Huber of the whitened residuals, so that wrong normals and mask borders pull with bounded force."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float


class Loss(msgspec.Struct, frozen=True):
    """Σ 2k² (√(1 + r²/k²) − 1) of whitened residuals r.

    robust_scale  k, in σ
    prior         weight of the paper's tint prior, where lights are few lobes (`factorlib.solve.few_lobes.equations`)
    """

    robust_scale: float = 10.0
    prior: float = 1e-4

    def of_residuals(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The loss of each whitened residual."""
        return 2 * self.robust_scale**2 * (np.sqrt(1 + (residual / self.robust_scale) ** 2) - 1)

    def trust(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Weights in ]0, 1] of the squared residuals, with which a least-squares step is a step of this loss."""
        return 1 / np.sqrt(1 + (residual / self.robust_scale) ** 2)
