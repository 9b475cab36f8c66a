"""The arrow-shaped system of all illuminations, its solution by elimination of every light, and the limits of a light's step.

With H = [[M, C_1 … C_k], [C_iᵀ, L_i]] (materials M, one block L_i per illumination) and gradients g_m, g_i, eliminating every
light leaves

    (M − Σ C_i L_i⁻¹ C_iᵀ) dm = −(g_m − Σ C_i L_i⁻¹ g_i),      dl_i = −L_i⁻¹ (g_i + C_iᵀ dm)                 (1)

with 7 unknowns a material.  The Schur complement on the left is the information that the data hold about the materials when the
lights are unknown too.  A light's C and M have rows for the unknowns of the materials that it shows alone, and so has what its
elimination adds: with many materials, of which a photo shows few, cost and memory grow with those few.  Levenberg–Marquardt damping multiplies
the diagonal, so that the step does not depend on the units of an unknown.  Rows and columns of unknowns that are not free become those of the identity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from factorlib.model.bounds import SHARPNESS
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.solve.descent import damped, masked
from factorlib.solve.few_lobes.normal_equations import NormalEquations
from factorlib.solve.few_lobes.unknowns import light_at_bound

MOST_WIDTHS, MOST_TURN, MOST_S = 0.4, 0.3, 0.25  # of a lobe in one step: its own widths, radians, s
DEFINITE = 1e-9  # damping that makes a light's block definite where the step itself is not damped


class Bounds:
    """The limits of one light's step.

    free    [l] unknowns that the step may choose
    fixed   [l] the step of those that are not free
    extra   [l] damping of an unknown of its own, added to the common damping

    At the start an unknown is not free if it is at a bound and the loss would fall beyond it.  `tighten` adds further limits.
    """

    def __init__(self, equations: NormalEquations, light: Light, materials: Materials):
        self.light, self.diagonal = light, np.diag(equations.light_hessian)
        self.free = ~light_at_bound(light, materials, equations.light_gradient)
        self.fixed, self.extra = np.zeros(len(self.free)), np.zeros(len(self.free))
        p = len(light)
        self.low, self.high = np.full(len(self.free), -np.inf), np.full(len(self.free), np.inf)
        s_now, s_low, s_high = (
            -np.log(1 / x + materials.blur) for x in (light.sharpness, SHARPNESS[0], materials.sharpest)
        )
        self.low[2 * p : 3 * p], self.high[2 * p : 3 * p] = s_low - s_now, s_high - s_now

    def tighten(self, step: Float[np.ndarray, " l"]) -> bool:
        """Tighten the limits where the step violates them; returns whether any was changed.

        A sharpness that would leave its range is fixed at the end of the range.  A lobe that moves too far gets more damping.
        """
        p = len(self.light)
        outside = self.free & ((step < self.low) | (step > self.high))
        self.free &= ~outside
        self.fixed[outside] = np.clip(step, self.low, self.high)[outside]
        turn = np.hypot(step[:p], step[p : 2 * p]) / np.minimum(MOST_WIDTHS / np.sqrt(self.light.sharpness), MOST_TURN)
        far = np.zeros(len(step), bool)
        far[: 2 * p] = np.tile(turn > 1, 2)
        far[2 * p : 3 * p] = np.abs(step[2 * p : 3 * p]) > MOST_S
        far &= self.free
        self.extra[far] = np.maximum(6 * self.extra[far], 1e-3 * self.diagonal[far])
        return bool(outside.any() or far.any())


class Eliminated(NamedTuple):
    """One light eliminated: the Cholesky factor of its block L, and its C, whose columns of unknowns that are not free are 0."""

    factor: tuple[Float[np.ndarray, "l l"], bool]
    cross: Float[np.ndarray, "k l"]


class ArrowSystem(msgspec.Struct, frozen=True):
    """The normal equations of all illuminations.  Sums are taken in their order, so that equal inputs give equal bits.

    unknowns: of the materials, 7 each
    """

    parts: list[NormalEquations]
    unknowns: int

    @property
    def loss(self) -> float:
        """The loss where the system was made."""
        return sum(part.loss for part in self.parts)

    @property
    def material_gradient(self) -> Float[np.ndarray, " 7m"]:
        """g_m"""
        gradient = np.zeros(self.unknowns)
        for part in self.parts:
            gradient[part.places] += part.material_gradient
        return gradient

    @property
    def material_hessian(self) -> Float[np.ndarray, "7m 7m"]:
        """M"""
        hessian = np.zeros((self.unknowns, self.unknowns))
        for part in self.parts:
            hessian[np.ix_(part.places, part.places)] += part.material_hessian
        return hessian

    def solved(
        self, free: Bool[np.ndarray, " 7m"], bounds: Sequence[Bounds], damping: float
    ) -> tuple[Float[np.ndarray, " 7m"], list[Float[np.ndarray, " l"]]]:
        """The damped step (1) of the `free` unknowns of the materials, and of each light within its bounds."""
        reduced, right = damped(self.material_hessian, damping), -self.material_gradient
        solutions = []
        for part, bound in zip(self.parts, bounds, strict=True):
            light = damped(part.light_hessian, damping) + np.diag(bound.extra)
            factor, cross = _eliminated(light, part.cross_hessian, bound.free)
            gradient = (part.light_gradient + part.light_hessian @ bound.fixed) * bound.free
            solution = cho_solve(factor, np.column_stack([cross.T, gradient]), check_finite=False)
            reduced[np.ix_(part.places, part.places)] -= cross @ solution[:, :-1]
            right[part.places] += cross @ solution[:, -1] - part.cross_hessian @ bound.fixed
            solutions.append(solution)
        by_materials = np.linalg.solve(masked(reduced, free), np.where(free, right, 0.0))
        by_lights = [
            bound.fixed - (solution[:, -1] + solution[:, :-1] @ by_materials[part.places]) * bound.free
            for part, bound, solution in zip(self.parts, bounds, solutions, strict=True)
        ]
        return by_materials, by_lights

    def predicted_decrease(
        self, by_materials: Float[np.ndarray, " 7m"], by_lights: Sequence[Float[np.ndarray, " l"]]
    ) -> float:
        """By how much a step lowers the quadratic model of the loss."""
        decrease = -by_materials @ (2 * self.material_gradient + self.material_hessian @ by_materials)
        for part, step in zip(self.parts, by_lights, strict=True):
            decrease -= step @ (
                2 * part.light_gradient
                + part.light_hessian @ step
                + 2 * part.cross_hessian.T @ by_materials[part.places]
            )
        return float(decrease)

    def schur_complement(self, point: Point) -> Float[np.ndarray, "7m 7m"]:
        """The information about the materials when the lights are unknown too: the left side of (1), undamped, at `point`."""
        reduced = self.material_hessian
        for part, light in zip(self.parts, point.lights, strict=True):
            factor, cross = _eliminated(
                damped(part.light_hessian, DEFINITE),
                part.cross_hessian,
                ~light_at_bound(light, point.materials, part.light_gradient),
            )
            reduced[np.ix_(part.places, part.places)] -= cross @ cho_solve(factor, cross.T, check_finite=False)
        return (reduced + reduced.T) / 2

    def reduced_scores(self, point: Point) -> list[Float[np.ndarray, "g 7m"]]:
        """The materials' scores of each illumination's clusters, after elimination of the light."""
        found = [np.zeros((len(part.scores), self.unknowns)) for part in self.parts]
        for scores, part, light in zip(found, self.parts, point.lights, strict=True):
            k, free = len(part.places), ~light_at_bound(light, point.materials, part.light_gradient)
            factor, cross = _eliminated(damped(part.light_hessian, DEFINITE), part.cross_hessian, free)
            scores[:, part.places] = part.scores[:, :k] - (part.scores[:, k:] * free) @ cho_solve(
                factor, cross.T, check_finite=False
            )
        return found


def _eliminated(
    light: Float[np.ndarray, "l l"], cross: Float[np.ndarray, "k l"], free: Bool[np.ndarray, " l"]
) -> Eliminated:
    return Eliminated(cho_factor(masked(light, free), check_finite=False), cross * free)
