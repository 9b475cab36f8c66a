"""Balance of exposures against reflectances, where photos of one light show different materials.

Materials that one photo shows are linked: their relative reflectance is observed.  So are those of all photos of a
light whose exposures are known.  Let g number the groups of linked materials.  All reflectances of a group times f_g,
all lights over the f_g of their first photo, and the exposures of their other photos over their own f_g,

    k → f_g k,      w → w/f_g₁,      e → e f_g₁/f_g,                                                                 (1)

predict the same radiance (but for interreflection), so that the priors alone choose f.  A descent of the whole
objective hardly moves along (1), because its tolerance is a share of a value that misfits dominate.  Here the priors of
exposures, lights and materials are minimised over log f.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as components_of_graph

from factorlib.inference.fit.likelihood import EXPOSURE_DEVIATION, LightLikelihood
from factorlib.inference.fit.optimizer import Descent, DescentState
from factorlib.inference.model.blocks import Block
from factorlib.inference.model.gauge import connected_components
from factorlib.inference.model.known import KnownValues
from factorlib.inference.model.materials import REFLECTANCES, UNKNOWNS


def balance_exposures(state: DescentState, descent: Descent, known: KnownValues) -> DescentState:
    """Return the state after the move (1) that the priors favour, if it lowers the objective.

    With interreflection the move changes the predicted radiance, so the whole objective decides.  Components with known
    materials or lights, and those of one group, stay as they are.

    Args:
        state: State with the value of the objective there (`Descent.linearise`).
        descent: Descent of materials and lights.
        known: Known values.
    """
    theta = state.theta
    blocks = [likelihood.illumination.block for likelihood in state.likelihoods]
    group = material_groups(blocks, len(theta), known)
    movable = np.zeros(len(theta), bool)
    for members, lights in connected_components(blocks, len(theta)):
        movable[list(members)] = len(set(group[list(members)])) > 1 and known.free_factors(members, lights) == 3
    moving = np.unique(group[movable])
    if not len(moving):
        return state
    terms = [ExposureTerms(likelihood, group) for likelihood in state.likelihoods]

    def move(logs: Float[np.ndarray, " g"]) -> tuple[Float[np.ndarray, "m 7"], Float[np.ndarray, " m"]]:
        """Return the unknowns after a move, and log f of every group."""
        log_factors = np.zeros(len(theta))
        log_factors[moving] = logs
        moved = theta.copy()
        moved[:, :REFLECTANCES] += log_factors[group][:, None]
        return moved, log_factors

    def energy(logs: Float[np.ndarray, " g"]) -> tuple[float, Float[np.ndarray, " g"]]:
        """Return the sum of the priors after a move, and its gradient."""
        moved, log_factors = move(logs)
        on_materials = descent.prior.evaluate(moved)
        value = on_materials.value
        slope = np.bincount(group, 2 * on_materials.gradient.reshape(-1, UNKNOWNS)[:, :REFLECTANCES].sum(1), len(theta))
        for term in terms:
            of_light, slope_of_light = term.energy(log_factors)
            value = value + of_light
            slope = slope + slope_of_light
        return value, slope[moving]

    moved, log_factors = move(minimize(energy, np.zeros(len(moving)), jac=True).x)
    balanced = descent.linearise([term.moved(log_factors) for term in terms], moved)
    return balanced if balanced.value < state.value else state


class ExposureTerms:
    """Prior of one light and its exposures along (1).

    Args:
        likelihood: Likelihood of the light.
        group: Group of each material.
    """

    def __init__(self, likelihood: LightLikelihood, group: Int[np.ndarray, " m"]):
        self.likelihood = likelihood
        block = likelihood.illumination.block
        self.log_exposure = likelihood.light.log_exposure
        # group of each photo; photos without observations are of the first's
        self.groups = np.full(len(block.photos), group[block.material[0]])
        self.groups[block.photo] = group[block.material]
        # uᵀQu is a parabola in the shift of u
        u = likelihood.log_radiance.reshape(-1) - likelihood.mean
        rows = likelihood.precision.sum(0)
        self.slope = float(rows @ u)
        self.curvature = float(rows.sum())

    def energy(self, log_factors: Float[np.ndarray, " m"]) -> tuple[float, Float[np.ndarray, " m"]]:
        """Return the change of uᵀQu plus the prior of the exposures after a move, and its gradient by log f."""
        shift = -log_factors[self.groups[0]]
        whitened = self._exposures(log_factors) / EXPOSURE_DEVIATION
        value = shift * (2 * self.slope + shift * self.curvature) + float(whitened @ whitened)
        slopes = 2 * whitened / EXPOSURE_DEVIATION  # by each log exposure
        gradient = -np.bincount(self.groups, slopes, len(log_factors))
        gradient[self.groups[0]] += slopes.sum() - 2 * (self.slope + shift * self.curvature)
        return value, gradient

    def moved(self, log_factors: Float[np.ndarray, " m"]) -> LightLikelihood:
        """Return the likelihood after a move, at the materials before it."""
        light = self.likelihood.light
        weight = light.weight / np.exp(log_factors[self.groups[0]])
        light = msgspec.structs.replace(light, weight=weight, log_exposure=self._exposures(log_factors))
        return self.likelihood.with_point(light)

    def _exposures(self, log_factors: Float[np.ndarray, " m"]) -> Float[np.ndarray, " f"]:
        """Return the log exposures after a move."""
        return self.log_exposure + log_factors[self.groups[0]] - log_factors[self.groups]


def material_groups(blocks: Sequence[Block], count: int, known: KnownValues) -> Int[np.ndarray, " m"]:
    """Return the number of the group of each of `count` materials, from 0."""
    pairs = [np.zeros((0, 2), int)]
    photos = 0
    for block in blocks:
        photo = block.photo * (block.name not in known.exposures)
        pairs.append(np.unique(np.column_stack([block.material, count + photos + photo]), axis=0))
        photos += len(block.photos)
    material, node = np.vstack(pairs).T
    size = count + photos
    graph = coo_array((np.ones(len(material)), (material, node)), shape=(size, size))
    return components_of_graph(graph, directed=False)[1][:count]
