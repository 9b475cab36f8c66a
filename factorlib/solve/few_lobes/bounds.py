"""The limits of a step: ranges of the unknowns, and how far a lobe may move before the quadratic model fails."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from factorlib.model.bounds import LEAST_REFLECTANCE, ROUGHNESS, SHARPNESS
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.solve.few_lobes.normal_equations import NormalEquations

MOST_WIDTHS, MOST_TURN, MOST_S = 0.4, 0.3, 0.25  # of a lobe in one step: its own widths, radians, s


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


def materials_at_bound(materials: Materials, gradient: Float[np.ndarray, " 7m"]) -> Bool[np.ndarray, " 7m"]:
    """Unknowns of the materials at a bound beyond which the loss would fall, and those on which the loss does not depend."""
    values = materials.rows()
    low = np.column_stack([values[:, :6] <= LEAST_REFLECTANCE, values[:, 6] <= ROUGHNESS[0]]).reshape(-1)
    high = np.column_stack([np.zeros_like(values[:, :6], bool), values[:, 6] >= ROUGHNESS[1]]).reshape(-1)
    return (low & (gradient > 0)) | (high & (gradient < 0)) | (gradient == 0)


def light_at_bound(light: Light, materials: Materials, gradient: Float[np.ndarray, " l"]) -> Bool[np.ndarray, " l"]:
    """Unknowns of a light at a bound beyond which the loss would fall, and those of lobes without weight."""
    p = len(light)
    at_bound = np.zeros(len(gradient), bool)
    low, high = np.log([SHARPNESS[0], materials.sharpest])
    by_sharpness = gradient[2 * p : 3 * p]
    at_bound[2 * p : 3 * p] = ((light.log_sharpness <= low) & (by_sharpness > 0)) | (
        (light.log_sharpness >= high) & (by_sharpness < 0)
    )
    at_bound[3 * p : 6 * p] = (light.weight.T.reshape(-1) <= 0) & (gradient[3 * p : 6 * p] > 0)
    dark = light.weight.sum(1) <= 0
    at_bound[: 3 * p] |= np.tile(dark, 3)
    return at_bound


def specular_unknowns(which: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " 7m"]:
    """Which unknowns are the specular ones (k_s and roughness) of the materials `which`."""
    return np.outer(which, [False] * 3 + [True] * 4).reshape(-1)
