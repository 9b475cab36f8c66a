"""The paper's prior on the tint of a light, on summed energies E: n π Σ_c (E_c/Ē − 1)² / 3, the variance over channels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from factorlib.model.blocks import Block
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.solve.few_lobes.unknowns import unknowns


class Quadratic(NamedTuple):
    """A value, and half its gradient and half its Gauss–Newton Hessian by the l unknowns of a light (`unknowns.moved_light`)."""

    value: float
    gradient: Float[np.ndarray, " l"]
    hessian: Float[np.ndarray, "l l"]


def tint_prior(loss: Loss, block: Block, light: Light) -> Quadratic:
    """All of the loss but the residuals, for n observations that are not held out; the mean Ē is taken to be constant."""
    count, p = unknowns(light), len(light)
    strength = loss.prior * int((~block.held_out).sum()) / 3
    sums = light.energy.sum(0)
    centre = (np.eye(3) - 1 / 3) / max(float(sums.mean()), 1e-30)
    residual = centre @ sums
    by_lobes = np.hstack([np.zeros((3, p)), np.kron(np.eye(3), np.ones(p))])  # of the sums, by [s, e_R, e_G, e_B] × p
    jacobian = centre @ by_lobes
    gradient, hessian, lobes = np.zeros(count), np.zeros((count, count)), slice(2 * p, 6 * p)
    gradient[lobes], hessian[lobes, lobes] = strength * jacobian.T @ residual, strength * jacobian.T @ jacobian
    return Quadratic(strength * float(residual @ residual), gradient, hessian)
