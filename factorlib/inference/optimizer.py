"""Levenberg–Marquardt on materials and lights: one step, that of (1) of `factorlib.inference.arrow`, and one loop.

The determinant enters the step of the materials; a light's own step minimises φ.  Unknowns that are known (`factorlib.inference.known`) have no part in a
step.  What is minimised is minus twice the log marginal likelihood (`factorlib.inference.likelihood`) and the prior on materials; where materials are
given, φ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.inference.arrow import System, damped, eliminate, summed
from factorlib.inference.lights import TONE, Light
from factorlib.inference.likelihood import Field, marginal
from factorlib.inference.materials import LEAST_REFLECTANCE, ROUGHNESS
from factorlib.inference.priors import Gaussian, MaterialPrior, materials_of
from factorlib.inference.problem import Spread

MOST_CHANGE = np.array([0.5] * 6 + [0.06])  # of a material's unknowns in one step
MOST_LOG_RADIANCE, MOST_EXPOSURE, MOST_TONE = 1.5, 1.0, 0.2  # change of a light's unknowns in one step
DAMPING, LOWER, HIGHER, MOST_DAMPING = 1e-3, 0.25, 8.0, 1e3
TOLERANCE = 2e-4  # a descent ends with a step that lowers the value by less than this share of it

Report = Callable[[float], None]  # called at every point that is tried, with the mean robust loss there


class State(NamedTuple):
    """Unknowns, and the systems there; theta: log k_d, log k_s, roughness."""

    theta: Float[np.ndarray, "m 7"]
    fields: list[Field]
    value: float
    parts: list[System]
    prior: Gaussian


class Descent(msgspec.Struct, frozen=True):
    """prior: on materials;  spread: a map over lights;  free: unknowns of the materials that are not known."""

    prior: MaterialPrior
    spread: Spread
    report: Report
    free: Bool[np.ndarray, " 7m"]

    def run(
        self, fields: Sequence[Field], theta: Float[np.ndarray, "m 7"], materials_given: bool, iterations: int
    ) -> State:
        """The state after at most so many steps of all lights and, unless they are given, of all materials."""
        state, damping = self.at(fields, theta, materials_given), DAMPING
        for _ in range(iterations):
            trial = self.at(*stepped(state, self.free, materials_given, damping), materials_given)
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

    def at(self, fields: Sequence[Field], theta: Float[np.ndarray, "m 7"], materials_given: bool) -> State:
        """Compute the systems of all lights at some materials; `marginal` says what `materials_given` means."""
        materials, replaced = materials_of(theta), msgspec.structs.replace
        fields = [replaced(f, illumination=replaced(f.illumination, materials=materials)) for f in fields]
        parts = list(self.spread(lambda field: marginal(field, materials_given=materials_given), fields))
        prior, values = self.prior.at(theta), sum(3 * int((~f.illumination.block.held_out).sum()) for f in fields)
        self.report(sum(part.loss for part in parts) / max(values, 1))
        return State(theta, fields, sum(part.value for part in parts) + prior.value, parts, prior)


def stepped(
    state: State, free: Bool[np.ndarray, " 7m"], materials_given: bool, damping: float
) -> tuple[list[Field], Float[np.ndarray, "m 7"]]:
    """Fields and materials after the damped step (1), each unknown within its range and changed by no more than is sound."""
    H, g = summed(state.parts, state.prior.hessian, state.prior.gradient)
    H = damped(H, damping)
    solutions = eliminate([p._replace(light_hessian=damped(p.light_hessian, damping)) for p in state.parts], H, g)
    theta = state.theta
    if not materials_given:
        step = np.zeros(len(g))
        step[free] = np.linalg.solve(H[np.ix_(free, free)], -g[free])
        theta = theta + step.reshape(-1, 7).clip(-MOST_CHANGE, MOST_CHANGE)
        theta[:, 6] = theta[:, 6].clip(*ROUGHNESS)
        theta[:, :6] = np.maximum(theta[:, :6], np.log(LEAST_REFLECTANCE))
    dm, fields = (theta - state.theta).reshape(-1), []
    for field, part, solution in zip(state.fields, state.parts, solutions, strict=True):
        light = moved(field.illumination.light, -(solution[:, -2] + solution[:, :-2] @ dm[part.places]))
        one = msgspec.structs.replace(field.illumination, light=light)
        fields.append(msgspec.structs.replace(field, illumination=one))
    return fields, theta


def moved(light: Light, step: Float[np.ndarray, " l"]) -> Light:
    """The light after a step of its unknowns, each within its range and changed by no more than is sound."""
    counts = 3 * int(light.free.sum()), light.free_exposures, len(light.log_tone)
    cells, exposures, tones, scale = np.split(step, np.cumsum(counts))
    brighter = np.ones((len(light), 3))
    brighter[light.free] = np.exp(cells.reshape(3, -1).clip(-MOST_LOG_RADIANCE, MOST_LOG_RADIANCE).T)
    brighter[~light.free] = np.exp(scale.sum().clip(-MOST_LOG_RADIANCE, MOST_LOG_RADIANCE))
    exposures = np.concatenate(
        [np.zeros(len(light.log_exposure) - len(exposures)), exposures.clip(-MOST_EXPOSURE, MOST_EXPOSURE)]
    )
    tone = np.clip(light.log_tone + tones.clip(-MOST_TONE, MOST_TONE), *np.log(TONE))
    return msgspec.structs.replace(
        light, weight=light.weight * brighter, log_exposure=light.log_exposure + exposures, log_tone=tone
    )
