"""Levenberg–Marquardt on the materials' marginal likelihood (`factorlib.solve.marginal`) and a prior on materials.

Most materials are dielectrics.  Of a ray along the normal they reflect ((n − 1)/(n + 1))², which is .02 to .08 for refractive indices n of
1.33 to 1.8, in all colours alike (the neutral interface of H.-C. Lee, E. Breneman and C. Schulte 1990, "Modeling light reflection for
computer color vision").  The prior on k_s says so, with l = log k_s of a material's three channels and l̄ their mean:

    minus twice its log density = (l̄ − log SPECULAR)²/LEVEL² + Σ_c (l_c − l̄)²/TINT²                                 (1)

For a metal, such as gold with k_s = (1, .8, .3), (1) is some 50, which a few hundred observations outweigh.  Where observations say little
of k_s, as those of a bright and nearly Lambertian surface do, (1) decides.

The factor per channel that is free between materials and lights is fixed by the sum of the materials' reflectances, which stays as it was
at the start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import block_diag, cho_factor, cho_solve

from factorlib.model.blocks import Block
from factorlib.model.bounds import LEAST_REFLECTANCE, ROUGHNESS
from factorlib.model.components import connected_components
from factorlib.model.materials import Materials
from factorlib.model.problem import JointProblem
from factorlib.solve.arrow import damped, masked
from factorlib.solve.marginal import Field, Marginal, marginal

DIFFUSE, ROUGH = 3.0, 1.0  # standard deviations of log k_d and of roughness about the start
SPECULAR, LEVEL, TINT = 0.05, 0.7, 0.15  # of (1); e^LEVEL: a factor of 2; e^TINT: 16 %, for the white balance of photos is not known better
GAUGE = 0.01  # standard deviation of a channel's summed reflectance about that of the start
MOST_CHANGE = np.array([0.5] * 6 + [0.06])  # of a material's unknowns in one step
MOST_LOG_RADIANCE = 1.5  # change of a cell's log radiance in one step
DAMPING, LOWER, HIGHER, MOST_DAMPING = 1e-3, 0.25, 8.0, 1e3
TOLERANCE = 2e-4  # a descent ends with a step that lowers the value by less than this share of it


class State(NamedTuple):
    """Unknowns, and the systems there; theta: log k_d, log k_s, roughness."""

    theta: Float[np.ndarray, "m 7"]
    log_radiance: list[Float[np.ndarray, "3 p"]]
    value: float
    parts: list[Marginal]
    prior: Gaussian


class Gaussian(NamedTuple):
    """Minus twice a log density, half its gradient and half its Gauss–Newton Hessian by the materials' unknowns."""

    value: float
    gradient: Float[np.ndarray, " 7m"]
    hessian: Float[np.ndarray, "7m 7m"]


class MaterialPrior:
    """A Gaussian of each material's unknowns, and the gauge: the sum of reflectances of each component and channel.

    k_d and roughness: a wide one about the start;  k_s: equation (1), except of materials without specular part
    """

    def __init__(self, start: Materials, blocks: Sequence[Block]):
        self.mean, self.precision = unknowns_of(start), np.tile(np.diag([DIFFUSE**-2.0] * 3 + [0.0] * 3 + [ROUGH**-2.0]), (len(start), 1, 1))
        with_specular = (start.specular > LEAST_REFLECTANCE).any(1)
        self.mean[with_specular, 3:6] = np.log(SPECULAR)
        self.precision[with_specular, 3:6, 3:6] = np.full((3, 3), 1 / 9) / LEVEL**2 + (np.eye(3) - 1 / 3) / TINT**2
        self.members = [list(members) for members, _ in connected_components(blocks, len(start))]
        self.whole = [_sums(start, members) for members in self.members]

    def at(self, theta: Float[np.ndarray, "m 7"]) -> Gaussian:
        """At the materials' unknowns."""
        off = theta - self.mean
        slope = np.einsum("mij,mj->mi", self.precision, off)
        value, gradient, hessian = float((off * slope).sum()), slope.reshape(-1), block_diag(*self.precision)
        materials = materials_of(theta)
        for members, whole in zip(self.members, self.whole, strict=True):
            for c in range(3):
                slope = np.zeros_like(theta)
                slope[members, c], slope[members, 3 + c] = materials.diffuse[members, c], materials.specular[members, c]
                slope = slope.reshape(-1) / (GAUGE * whole[c])
                residual = (_sums(materials, members)[c] / whole[c] - 1) / GAUGE
                value, gradient, hessian = value + residual**2, gradient + residual * slope, hessian + np.outer(slope, slope)
        return Gaussian(float(value), gradient, hessian)


def unknowns_of(materials: Materials) -> Float[np.ndarray, "m 7"]:
    """log k_d, log k_s and roughness."""
    reflectance = np.maximum(np.column_stack([materials.diffuse, materials.specular]), LEAST_REFLECTANCE)
    return np.column_stack([np.log(reflectance), np.clip(materials.roughness, *ROUGHNESS)])


def materials_of(theta: Float[np.ndarray, "m 7"]) -> Materials:
    """The inverse of `unknowns_of`."""
    return Materials(np.exp(theta[:, :3]), np.exp(theta[:, 3:6]), theta[:, 6])


class MarginalDescent:
    """Levenberg–Marquardt on materials and lights."""

    def __init__(self, problem: JointProblem, material_prior: MaterialPrior, report: Callable[[int, float], None]):
        self.spread, self.material_prior, self.report = problem.spread, material_prior, report
        self.values, self.iteration = max(problem.fitted_values, 1), 0

    def run(
        self,
        fields: Sequence[Field],
        theta: Float[np.ndarray, "m 7"],
        lights: list[Float[np.ndarray, "3 p"]],
        free: Bool[np.ndarray, "m 7"],
        iterations: int,
    ) -> State:
        """The state after at most so many steps; only the materials' unknowns that are `free` change."""
        materials_given, damping = not free.any(), DAMPING
        state = self._at(fields, theta, lights, materials_given)
        for _ in range(iterations):
            trial = self._at(fields, *_step(state, free, damping), materials_given)
            if trial.value < state.value:
                small = state.value - trial.value < TOLERANCE * abs(state.value)
                state, damping = trial, damping * LOWER
                if small:
                    break
            elif damping > MOST_DAMPING:
                break
            else:
                damping = max(damping * HIGHER, DAMPING)
        return state

    def _at(
        self, fields: Sequence[Field], theta: Float[np.ndarray, "m 7"], lights: list[Float[np.ndarray, "3 p"]], materials_given: bool
    ) -> State:
        materials = materials_of(theta)
        parts = list(self.spread(lambda one: marginal(*one, materials, materials_given=materials_given), list(zip(fields, lights, strict=True))))
        prior = self.material_prior.at(theta)
        self.report(self.iteration, sum(part.loss for part in parts) / self.values)
        self.iteration += 1
        return State(theta, lights, sum(part.value for part in parts) + prior.value, parts, prior)


def _step(state: State, free: Bool[np.ndarray, "m 7"], damping: float) -> tuple[Float[np.ndarray, "m 7"], list[Float[np.ndarray, "3 p"]]]:
    """The unknowns after a damped step: lights eliminated, materials within bounds, lights given the materials' step."""
    hessian = state.prior.hessian + np.sum([part.material_hessian for part in state.parts], axis=0)
    gradient = state.prior.gradient + np.sum([part.material_gradient for part in state.parts], axis=0)
    reduced, solutions = damped(hessian, damping), []
    for part in state.parts:
        factor = cho_factor(damped(part.light_hessian, damping), check_finite=False)
        solution = cho_solve(factor, np.column_stack([part.cross_hessian.T, part.light_gradient]), check_finite=False)
        reduced -= part.cross_hessian @ solution[:, :-1]
        gradient = gradient - part.cross_hessian @ solution[:, -1]
        solutions.append(solution)
    change = np.linalg.solve(masked(reduced, free.reshape(-1)), np.where(free.reshape(-1), -gradient, 0.0)).reshape(-1, 7)
    theta = state.theta + change.clip(-MOST_CHANGE, MOST_CHANGE)
    theta[:, 6] = theta[:, 6].clip(*ROUGHNESS)
    theta[:, :6] = np.maximum(theta[:, :6], np.log(LEAST_REFLECTANCE))
    moved = (theta - state.theta).reshape(-1)
    steps = [-(solution[:, -1] + solution[:, :-1] @ moved) for solution in solutions]
    return theta, [
        u + step.clip(-MOST_LOG_RADIANCE, MOST_LOG_RADIANCE).reshape(u.shape) for u, step in zip(state.log_radiance, steps, strict=True)
    ]


def _sums(materials: Materials, members: Sequence[int]) -> Float[np.ndarray, "3"]:
    return (materials.diffuse + materials.specular)[members].sum(0)
