"""One damped Gauss–Newton step of the arrow-shaped system, with bounds.

With H = [[M, C_1 … C_k], [C_iᵀ, L_i]] (materials M, one block L_i per illumination), eliminating every light leaves

    (M − Σ C_i L_i⁻¹ C_iᵀ) dm = −(g_m − Σ C_i L_i⁻¹ g_i),      dl_i = −L_i⁻¹ (g_i + C_iᵀ dm)

with 7 unknowns a material.  Levenberg–Marquardt damping multiplies the diagonal, so that the step does not depend on
the units of an unknown.  An unknown at a bound that the gradient pushes outward is held (its row becomes identity);
the others are clipped after the step, but for the weights, which are fitted anew where it leads (descent).
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from factorlib.solve.normal_equations import System
from factorlib.solve.unknowns import LEAST_REFLECTANCE, ROUGHNESS, SHARPNESS, Light, Materials

ROUNDS = 12
MOST_WIDTHS, MOST_TURN, MOST_S = 0.4, 0.3, 0.25  # of a lobe in one step: its own widths, radians
FLOOR = 1e-9  # damping never sees a smaller diagonal entry than this share of the largest


class Step(msgspec.Struct, frozen=True):
    """A step of all unknowns, and by how much the quadratic model falls with it."""

    materials: Float[np.ndarray, "7m"]
    lights: list[Float[np.ndarray, "l"]]
    promised: float


def damped_step(
    systems: Sequence[System],
    materials: Materials,
    lights: Sequence[Light],
    damping: float,
    held: Bool[np.ndarray, "7m"] | None = None,
) -> Step:
    """The step of all unknowns at the given Levenberg–Marquardt `damping`; order of `systems` is order of summation.

    held: unknowns of the materials that stay as they are
    Solved again, at most `ROUNDS` times, while it takes a sharpness out of bounds (which is then held there) or a lobe
    farther than the quadratic model is good for (which is then damped more, that lobe alone).
    """
    gradient = np.sum([s.material_gradient for s in systems], axis=0)
    hessian = np.sum([s.material_hessian for s in systems], axis=0)
    free = ~held_materials(materials, gradient) & (True if held is None else ~held)
    bounds = [Bounds(s, light, materials) for s, light in zip(systems, lights, strict=True)]
    for _ in range(ROUNDS):
        by_material, by_light = _solved(systems, gradient, hessian, free, bounds, damping)
        changed = [bound.tighten(step) for bound, step in zip(bounds, by_light, strict=True)]
        if not any(changed):
            break
    promised = -by_material @ (2 * gradient + hessian @ by_material)
    for s, step in zip(systems, by_light, strict=True):
        promised -= step @ (2 * s.light_gradient + s.light_hessian @ step + 2 * s.cross_hessian.T @ by_material)
    return Step(by_material, by_light, float(promised))


class Bounds:
    """What a light's step must keep to: unknowns that are not free take `fixed`; `extra` is their own damping."""

    def __init__(self, s: System, light: Light, materials: Materials):
        self.light, self.diagonal = light, np.diag(s.light_hessian)
        self.free = ~held_unknowns(light, materials, s.light_gradient)
        self.fixed, self.extra = np.zeros(len(self.free)), np.zeros(len(self.free))
        p = len(light)
        self.low, self.high = np.full(len(self.free), -np.inf), np.full(len(self.free), np.inf)
        s_now, s_low, s_high = (-np.log(1 / x + materials.blur) for x in (light.sharpness, SHARPNESS[0], materials.sharpest))
        self.low[2 * p : 3 * p], self.high[2 * p : 3 * p] = s_low - s_now, s_high - s_now

    def tighten(self, step: Float[np.ndarray, "l"]) -> bool:
        """Whether the step went too far and bounds were changed."""
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


def _solved(systems: Sequence[System], gradient, hessian, free, bounds: Sequence[Bounds], damping: float):
    reduced, right = damped(hessian, damping), -gradient
    eliminated = []
    for s, bound in zip(systems, bounds, strict=True):
        loose = bound.free
        factor = cho_factor(masked(damped(s.light_hessian, damping) + np.diag(bound.extra), loose), check_finite=False)
        cross = s.cross_hessian * loose
        light_gradient = (s.light_gradient + s.light_hessian @ bound.fixed) * loose
        solved = cho_solve(factor, np.column_stack([cross.T, light_gradient]), check_finite=False)
        reduced -= cross @ solved[:, :-1]
        right += cross @ solved[:, -1] - s.cross_hessian @ bound.fixed
        eliminated.append((solved, loose))
    by_material = np.linalg.solve(masked(reduced, free), np.where(free, right, 0.0))
    by_light = [
        bound.fixed - (solved[:, -1] + solved[:, :-1] @ by_material) * loose
        for bound, (solved, loose) in zip(bounds, eliminated, strict=True)
    ]
    return by_material, by_light


def schur_complement(systems: Sequence[System], materials: Materials, lights: Sequence[Light]) -> Float[np.ndarray, "7m 7m"]:
    """The information that the data hold about the materials once every light is solved for."""
    reduced = np.sum([s.material_hessian for s in systems], axis=0)
    for s, light in zip(systems, lights, strict=True):
        loose = ~held_unknowns(light, materials, s.light_gradient)
        factor = cho_factor(masked(damped(s.light_hessian, 1e-9), loose), check_finite=False)
        cross = s.cross_hessian * loose
        reduced = reduced - cross @ cho_solve(factor, cross.T, check_finite=False)
    return (reduced + reduced.T) / 2


def held_materials(materials: Materials, gradient: Float[np.ndarray, "7m"]) -> Bool[np.ndarray, "7m"]:
    """Unknowns of the materials at a bound that the loss pushes beyond, and those that the loss does not depend on."""
    values = materials.vector().reshape(-1, 7)
    low = np.column_stack([values[:, :6] <= LEAST_REFLECTANCE, values[:, 6] <= ROUGHNESS[0]]).reshape(-1)
    high = np.column_stack([np.zeros_like(values[:, :6], bool), values[:, 6] >= ROUGHNESS[1]]).reshape(-1)
    return (low & (gradient > 0)) | (high & (gradient < 0)) | (gradient == 0)


def specular_unknowns(matte: Bool[np.ndarray, "m"]) -> Bool[np.ndarray, "7m"]:
    """Which unknowns are specular ones of the materials that are `matte`."""
    return np.outer(matte, [False] * 3 + [True] * 4).reshape(-1)


def held_unknowns(light: Light, materials: Materials, gradient: Float[np.ndarray, "l"]) -> Bool[np.ndarray, "l"]:
    """Unknowns of a light at a bound that the loss pushes beyond, and those of lobes without weight."""
    p = len(light)
    held = np.zeros(len(gradient), bool)
    low, high = np.log([SHARPNESS[0], materials.sharpest])
    by_sharpness = gradient[2 * p : 3 * p]
    held[2 * p : 3 * p] = ((light.log_sharpness <= low) & (by_sharpness > 0)) | ((light.log_sharpness >= high) & (by_sharpness < 0))
    held[3 * p : 6 * p] = (light.weight.T.reshape(-1) <= 0) & (gradient[3 * p : 6 * p] > 0)
    dark = light.weight.sum(1) <= 0
    held[: 3 * p] |= np.tile(dark, 3)
    return held


def damped(hessian: Float[np.ndarray, "k k"], damping: float) -> Float[np.ndarray, "k k"]:
    diagonal = np.diag(hessian)
    floor = FLOOR * max(float(diagonal.max(initial=0.0)), 1e-30)
    return hessian + np.diag(damping * np.maximum(diagonal, floor) + floor)


def masked(matrix: Float[np.ndarray, "k k"], kept: Bool[np.ndarray, "k"]) -> Float[np.ndarray, "k k"]:
    """Rows and columns that are not kept become those of the identity (scaled as the rest)."""
    scale = max(float(np.abs(np.diag(matrix)).mean()), 1e-30)
    masked = matrix * np.outer(kept, kept)
    masked[~kept, ~kept] = scale
    return masked
