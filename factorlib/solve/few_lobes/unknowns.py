"""The vector of unknowns of a light as few lobes, with the exposures of its photos, and the ranges that they stay in.

A lobe's unknowns are chosen so that they hardly depend on each other: its energy e = w/λ', with λ' = λ/(1 − e^{−2λ}), instead of
its peak w, and

    s = −log(1/λ + b),      b = 2 min α²

instead of log λ.  A reflection widens a lobe's variance 1/λ by about b, so photographs show the sum 1/λ + b.  A rougher surface under
a sharper lobe looks the same; in s such a change is a straight line, in log λ a curve that only small steps can follow.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.light.lobes import lobe_integral
from factorlib.model.blocks import Block
from factorlib.model.lights import Light
from factorlib.model.materials import LEAST_REFLECTANCE, ROUGHNESS, SHARPNESS, Materials, Point

MOST_TURN, MOST_S, MOST_EXPOSURE = 0.3, 1.0, 1.0  # largest change of an unknown in one step
LEAST_SHARE = 1e-5


def starting_light(block: Block, materials: Materials) -> Light:
    """One broad lobe in front that gives the block's mean radiance."""
    reflectance = np.average(materials.diffuse[block.material], axis=0, weights=block.precision.mean(1))
    axis, sharpness = np.array([[0.0, 0.0, -1.0]]), 0.5
    weight = block.radiance.mean(0) / np.maximum(reflectance, 1e-6)
    return Light(axis, np.log([sharpness]), weight[None], np.zeros(len(block.photos)))


def unknowns(light: Light) -> int:
    """How many unknowns the light has: the length of a step."""
    return 6 * len(light) + len(light.log_exposure) - 1


def sharpness_slopes(light: Light, blur: float) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """∂ log λ/∂s and, at constant energy, ∂ log w/∂s;  blur: b."""
    by_s = 1 + blur * light.sharpness
    doubled = np.maximum(2 * light.sharpness, 1e-9)
    return by_s, by_s * (1 - doubled / np.expm1(np.minimum(doubled, 700.0)))


def tangents(axis: Float[np.ndarray, "p 3"]) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    """Two unit vectors that span the tangent plane of each unit `axis`."""
    helper = np.where(np.abs(axis[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axis, first)


def moved_light(light: Light, step: Float[np.ndarray, " l"], materials: Materials) -> Light:
    """The light after a step in the unknowns [tangent 1, tangent 2, s, e_R, e_G, e_B] × p, exposures 1…f−1."""
    p, b = len(light), materials.blur
    by = step[: 6 * p].reshape(6, p)
    first, second = tangents(light.axis)
    turn = np.clip(by[:2], -MOST_TURN, MOST_TURN)
    axis = light.axis + turn[0][:, None] * first + turn[1][:, None] * second
    variance = (1 / light.sharpness + b) * np.exp(-np.clip(by[2], -MOST_S, MOST_S)) - b  # 1/λ
    log_sharpness = -np.log(np.clip(variance, 1 / materials.sharpest, 1 / SHARPNESS[0]))
    return Light(
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        log_sharpness,
        np.maximum(light.energy + by[3:].T, 0.0) / (lobe_integral(np.exp(log_sharpness))[:, None] / (2 * np.pi)),
        light.log_exposure + np.concatenate([[0.0], np.clip(step[6 * p :], -MOST_EXPOSURE, MOST_EXPOSURE)]),
    )


def moved_point(
    point: Point, by_materials: Float[np.ndarray, " 7m"], by_lights: Sequence[Float[np.ndarray, " l"]]
) -> Point:
    """The nearest point within bounds after a step in all unknowns."""
    lights = [moved_light(light, by, point.materials) for light, by in zip(point.lights, by_lights, strict=True)]
    return Point(Materials.of_vector(point.materials.vector() + by_materials), lights)


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
    at_bound[2 * p : 3 * p] = np.where(
        by_sharpness > 0, light.log_sharpness <= low, (light.log_sharpness >= high) & (by_sharpness < 0)
    )
    at_bound[3 * p : 6 * p] = (light.weight.T.reshape(-1) <= 0) & (gradient[3 * p : 6 * p] > 0)
    at_bound[: 3 * p] |= np.tile(light.weight.sum(1) <= 0, 3)
    return at_bound


def specular_unknowns(which: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " 7m"]:
    """Which unknowns are the specular ones (k_s and roughness) of the materials `which`."""
    return np.outer(which, [False] * 3 + [True] * 4).reshape(-1)


def blurred(light: Light, sharpest: float) -> Light:
    """The light with lobes sharper than `sharpest` widened to it; their energy stays the same."""
    log_sharpness = np.minimum(light.log_sharpness, np.log(sharpest))
    kept = lobe_integral(light.sharpness) / lobe_integral(np.exp(log_sharpness))
    return msgspec.structs.replace(light, log_sharpness=log_sharpness, weight=light.weight * kept[:, None])


def pruned(light: Light) -> Light:
    """The light without lobes of less than `LEAST_SHARE` of its energy; at least one lobe stays."""
    energy = light.energy.sum(1)
    kept = energy > LEAST_SHARE * max(float(energy.sum()), 1e-30)
    return light.take(kept if kept.any() else slice(0, 1))
