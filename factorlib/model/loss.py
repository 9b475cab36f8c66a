"""The loss that a point is judged by.

    Σ 2k² (√(1 + r²/k²) − 1)            pseudo-Huber of the whitened residuals r: wrong normals and mask borders pull with bounded force
    + n π Σ_c (E_c/Ē − 1)² / 3          the paper's prior, on summed energies E: variance over channels

Gradients and Hessians here are half of the true ones, so that those of Σ r² have no factor 2.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.model.blocks import Block
from factorlib.model.lights import Light


class Quadratic(NamedTuple):
    """A value, and half its gradient and half its Gauss–Newton Hessian by the l unknowns of a light (`Light.moved`)."""

    value: float
    gradient: Float[np.ndarray, " l"]
    hessian: Float[np.ndarray, "l l"]


class Loss(msgspec.Struct, frozen=True):
    """What a point is judged by.

    robust_scale  k of the pseudo-Huber loss, in σ
    prior         weight π of the paper's tint prior
    """

    robust_scale: float = 10.0
    prior: float = 1e-4

    def of_residuals(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Pseudo-Huber loss of each whitened residual."""
        return 2 * self.robust_scale**2 * (np.sqrt(1 + (residual / self.robust_scale) ** 2) - 1)

    def trust(self, residual: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Weights in ]0, 1] of the squared residuals, with which a least-squares step is a step of this loss."""
        return 1 / np.sqrt(1 + (residual / self.robust_scale) ** 2)

    def of_light(self, block: Block, light: Light) -> Quadratic:
        """The priors on a light: all of the loss but the residuals."""
        gradient, hessian = np.zeros(light.unknowns), np.zeros((light.unknowns, light.unknowns))
        lobes = slice(2 * len(light), 6 * len(light))
        value, gradient[lobes], hessian[lobes, lobes] = self._tint(block, light)
        return Quadratic(value, gradient, hessian)

    def _tint(self, block: Block, light: Light) -> Quadratic:
        """The tint prior by the unknowns [s, e_R, e_G, e_B] × p, the mean Ē taken to be constant."""
        strength = self.prior * int((~block.held_out).sum()) / 3
        sums = light.energy.sum(0)
        centre = (np.eye(3) - 1 / 3) / max(float(sums.mean()), 1e-30)
        residual = centre @ sums
        by_lobes = np.hstack([np.zeros((3, len(light))), np.kron(np.eye(3), np.ones(len(light)))])  # of the sums
        jacobian = centre @ by_lobes
        return Quadratic(strength * float(residual @ residual), strength * jacobian.T @ residual, strength * jacobian.T @ jacobian)
