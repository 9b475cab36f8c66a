"""The light that one photo asks for, given materials and normals: found anew for every pose, so that none is favoured.

The light of the solve was fitted to the pose that is in question.  Here lobes are pursued from nothing over the dictionary of
`factorlib.solve.insertion`, which no pose has had a say in, and their weights are a non-negative least-squares problem.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.reflection.operator import Operator
from factorlib.solve.insertion import candidates, lobes_inserted, pruned
from factorlib.solve.start import starting_light
from factorlib.solve.weights import nonnegative_minimum

ROUNDS, INSERTED = 3, 16  # of pursuit, and lobes in each, while a pose moves
SAMPLE = 1400  # observations that vote about lobes, the same in every round
REWEIGHTED = 3  # times, for outliers
RIDGE = 1e-4  # of the squared response of each lobe


class Surfaces(msgspec.Struct, frozen=True):
    """How all that a photo shows reflects: what is known before any pose is refined."""

    materials: Materials
    operator: Operator

    def under(self, light: Light, block: Block) -> Illumination:
        """Their observations in a light."""
        return Illumination(block, light, self.materials, self.operator)


def pursued_light(block: Block, surfaces: Surfaces, rounds: int = ROUNDS) -> Light:
    """Explains what of the block is not held out."""
    block = block.take(~block.held_out)
    light = starting_light(block, surfaces.materials)
    lobes = candidates(surfaces.under(light, block), 0, SAMPLE)
    for _ in range(rounds):
        light = lobes_inserted(surfaces.under(light, block), INSERTED, lobes)
        light = pruned(with_weights(surfaces.under(light, block)))
    return light


def together(lights: Sequence[Light]) -> Light:
    """All their lobes: candidates that choose weights of the same lobes differ by nothing else."""
    parts = [np.concatenate([getattr(light, name) for light in lights]) for name in ("axis", "log_sharpness", "weight")]
    return Light(*parts, lights[0].log_exposure)


def with_weights(illumination: Illumination) -> Light:
    """Its light with the weights ≥ 0 that explain best, robustly, what is not held out."""
    block, light = illumination.block, illumination.light
    rows = np.flatnonzero(~block.held_out)
    atoms = illumination.atoms(rows, light.unit_lobes)
    target = block.radiance[rows] * block.precision[rows]
    weight = light.weight.copy()
    for _ in range(REWEIGHTED):
        residual = np.einsum("cnp,pc->nc", atoms, weight) - target
        trust = robust_loss(residual).trust(residual)
        for c in range(3):
            weighted = atoms[c] * trust[:, c, None]
            weight[:, c] = nonnegative_minimum(weighted.T @ atoms[c] + _ridge(atoms[c]), weighted.T @ target[:, c])
    return Light(light.axis, light.log_sharpness, weight, light.log_exposure)


def _ridge(atoms: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "p p"]:
    """Keeps lobes that look alike from taking turns."""
    return RIDGE * np.diag(np.sum(atoms**2, axis=0))


def robust_scale(residual: Float[np.ndarray, "n 3"]) -> float:
    """Three robust standard deviations, never below one σ of the noise model; channels that are not compared are exactly 0."""
    compared = np.abs(residual[residual != 0])
    return max(3 * 1.4826 * float(np.median(compared)), 1.0) if len(compared) else 1.0


def robust_loss(residual: Float[np.ndarray, "n 3"]) -> Loss:
    """The loss of that scale, without priors."""
    return Loss(robust_scale(residual), prior=0.0)
