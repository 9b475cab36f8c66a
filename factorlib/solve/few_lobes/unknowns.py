"""The vector of unknowns of a light as few lobes, with the exposures and tone curves of its photos.

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
from jaxtyping import Float

from factorlib.light.lobes import lobe_integral
from factorlib.model.bounds import SHARPNESS, TONE, sharpest_resolved
from factorlib.model.lights import Light, UnitLobes, tangents
from factorlib.model.materials import Materials
from factorlib.model.point import Point

MOST_TURN, MOST_S, MOST_EXPOSURE, MOST_TONE = 0.3, 1.0, 1.0, 0.2  # largest change of an unknown in one step


def unknowns(light: Light) -> int:
    """How many unknowns the light has: the length of a step."""
    return 6 * len(light) + len(light.log_exposure) - 1 + len(light.log_tone)


def unit_energy(light: Light) -> Float[np.ndarray, " p"]:
    """1/λ': energy of a lobe of unit weight over 2π, steradians."""
    return lobe_integral(light.sharpness) / (2 * np.pi)


def sharpness_slopes(light: Light, blur: float) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """∂ log λ/∂s and, at constant energy, ∂ log w/∂s;  blur: b."""
    by_s = 1 + blur * light.sharpness
    doubled = np.maximum(2 * light.sharpness, 1e-9)
    return by_s, by_s * (1 - doubled / np.expm1(np.minimum(doubled, 700.0)))


def moved_light(light: Light, step: Float[np.ndarray, " l"], blur: float) -> Light:
    """The light after a step in the unknowns [tangent 1, tangent 2, s, e_R, e_G, e_B] × p, exposures 1…f−1, tones; blur is b."""
    p = len(light)
    by = step[: 6 * p].reshape(6, p)
    first, second = tangents(light.axis)
    turn = np.clip(by[:2], -MOST_TURN, MOST_TURN)
    axis = light.axis + turn[0][:, None] * first + turn[1][:, None] * second
    variance = (1 / light.sharpness + blur) * np.exp(-np.clip(by[2], -MOST_S, MOST_S)) - blur
    log_sharpness = -np.log(np.clip(variance, 1 / sharpest_resolved(blur), 1 / SHARPNESS[0]))
    by_exposure, by_tone = np.split(step[6 * p :], [len(light.log_exposure) - 1])
    return Light(
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        log_sharpness,
        np.maximum(light.energy + by[3:].T, 0.0) / (lobe_integral(np.exp(log_sharpness))[:, None] / (2 * np.pi)),
        light.log_exposure + np.concatenate([[0.0], np.clip(by_exposure, -MOST_EXPOSURE, MOST_EXPOSURE)]),
        np.clip(light.log_tone + np.clip(by_tone, -MOST_TONE, MOST_TONE), *np.log(TONE)),
    )


def moved_point(
    point: Point, by_materials: Float[np.ndarray, " 7m"], by_lights: Sequence[Float[np.ndarray, " l"]]
) -> Point:
    """The nearest point within bounds after a step in all unknowns."""
    blur = point.materials.blur
    lights = [moved_light(light, by, blur) for light, by in zip(point.lights, by_lights, strict=True)]
    return Point(Materials.of_vector(point.materials.vector() + by_materials), lights)


def taken(light: Light, rows: np.ndarray | slice) -> Light:
    """The lobes `rows` alone, by numbers or a mask."""
    return msgspec.structs.replace(
        light, axis=light.axis[rows], log_sharpness=light.log_sharpness[rows], weight=light.weight[rows]
    )


def joined(light: Light, lobes: UnitLobes, weight: Float[np.ndarray, "q 3"]) -> Light:
    """The light with q further lobes appended."""
    return msgspec.structs.replace(
        light,
        axis=np.vstack([light.axis, lobes.axis]),
        log_sharpness=np.concatenate([light.log_sharpness, np.log(lobes.sharpness)]),
        weight=np.vstack([light.weight, weight]),
    )
