"""The light that explains one photo, given materials and normals.  It is found anew for every pose, so that no pose has an advantage.

The light of the solve was fitted to the pose that is to be tested, so it is not used.  Lobes are chosen by matching pursuit from the
dictionary of `factorlib.solve.few_lobes.insertion`, which depends on no pose; their weights are a non-negative least-squares problem.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.noise import Loss
from factorlib.reflection.operator import Operator
from factorlib.results.materials import Solved
from factorlib.robust import robust_deviation
from factorlib.solve.few_lobes.equations import nonnegative_minimum
from factorlib.solve.few_lobes.insertion import candidates, lobes_inserted
from factorlib.solve.few_lobes.unknowns import pruned, starting_light

ROUNDS, INSERTED = 3, 16  # of pursuit, and lobes in each, while a pose moves
SAMPLE = 1400  # observations that vote about lobes, the same in every round
REWEIGHTED = 3  # times, for outliers
RIDGE = 1e-4  # of the squared response of each lobe
UNKNOWN = 0.7  # standard error of a diffuse reflectance, in its range of 1: one that no photo shows has at least this


class Surfaces(msgspec.Struct, frozen=True):
    """How the surfaces of a photo reflect: the solved materials and the reflection operator."""

    materials: Materials
    operator: Operator

    def under(self, light: Light, block: Block) -> Illumination:
        """Observations of these surfaces in a light."""
        return Illumination(block, light, self.materials, self.operator)


def pursued_light(block: Block, surfaces: Surfaces, rounds: int = ROUNDS) -> Light:
    """The light of the observations that are not held out, by `rounds` of matching pursuit."""
    block = block.take(~block.held_out)
    light = starting_light(block, surfaces.materials)
    lobes = candidates(surfaces.under(light, block), 0, SAMPLE)
    for _ in range(rounds):
        light = lobes_inserted(surfaces.under(light, block), INSERTED, lobes)
        light = pruned(with_weights(surfaces.under(light, block)))
    return light


def together(lights: Sequence[Light]) -> Light:
    """One light with the lobes of all, so that candidates can be compared with weights of the same lobes."""
    parts = [np.concatenate([getattr(light, name) for light in lights]) for name in ("axis", "log_sharpness", "weight")]
    return Light(*parts, lights[0].log_exposure)


def with_weights(illumination: Illumination) -> Light:
    """The illumination's light with the weights ≥ 0 that explain the observations not held out best, robustly."""
    block, light = illumination.block, illumination.light
    rows = np.flatnonzero(~block.held_out)
    atoms = illumination.atoms(rows, light.unit_lobes)
    ridge = [RIDGE * np.diag(np.sum(of_channel**2, axis=0)) for of_channel in atoms]  # similar lobes, determined
    target = block.radiance[rows] * block.precision[rows]
    weight = light.weight.copy()
    for _ in range(REWEIGHTED):
        residual = np.einsum("cnp,pc->nc", atoms, weight) - target
        trust = robust_loss(residual).trust(residual)
        for c in range(3):
            weighted = atoms[c] * trust[:, c, None]
            weight[:, c] = nonnegative_minimum(weighted.T @ atoms[c] + ridge[c], weighted.T @ target[:, c])
    return Light(light.axis, light.log_sharpness, weight, light.log_exposure)


def robust_scale(residual: Float[np.ndarray, "n 3"]) -> float:
    """Three robust standard deviations, never below one σ of the noise model; channels that are not compared are exactly 0."""
    compared = residual[residual != 0]
    return max(3 * robust_deviation(compared), 1.0) if len(compared) else 1.0


def robust_loss(residual: Float[np.ndarray, "n 3"]) -> Loss:
    """The loss whose scale is `robust_scale`, without priors."""
    return Loss(robust_scale(residual), prior=0.0)


def known_materials(solved: Sequence[Solved]) -> tuple[Materials, Bool[np.ndarray, " m"]]:
    """The materials that a solve found as arrays, in order, and which of them are known well enough."""
    rows = [[*one.diffuse, *one.specular, one.roughness] for one in solved]
    known = [min(one.stderr.diffuse) < UNKNOWN for one in solved]
    return Materials.of_vector(np.array(rows, dtype=float).reshape(-1)), np.array(known, dtype=bool)
