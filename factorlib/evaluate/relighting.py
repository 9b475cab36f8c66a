"""Balls of the recovered materials in other light, against balls of the true materials in the true light.

in_true_light       the recovered material in the true light: what is wrong with the material alone
in_estimated_light  the recovered material in the recovered light: what the two together would show
null_grey           a grey ball (diffuse 0.5, no specular) in the true light
null_mean_colour    a flat disc of the true ball's mean colour

Balls are seen along the light frame's own z axis (for a light fixed to a photo's camera: as that camera sees them).
A ball is a "photo" for the gauge `channel_per_photo`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import Light, NarrowLobe, WideLobe, ball_normals, diffuse_ball, glossy_lobe
from factorlib.evaluate.gauge import GAUGES, gauge_factors
from factorlib.evaluate.picture import mean_error, picture_error, white_of
from factorlib.results.materials import Reflectance
from factorlib.results.metrics import Kinds, Relighting, RelitBall

BALL_SIZE = 32
KINDS = ("in_true_light", "in_estimated_light", "null_grey", "null_mean_colour")
GREY = 0.5

Samples = Float[np.ndarray, "_ 3"]


@lru_cache(maxsize=16)
def lobe_of(roughness: float) -> WideLobe | NarrowLobe:
    """Of a ball; kept, for materials are shown in many lights.  16 take 200 MB at most."""
    return glossy_lobe(ball_normals(BALL_SIZE)[0], roughness)


class Appearances:
    """Balls of many materials in one light: each part of the reflection is rendered once."""

    def __init__(self, light: Light):
        self.light, (self.normals, self.inside) = light, ball_normals(BALL_SIZE)
        self.diffuse = diffuse_ball(light, self.normals)
        self.glossy: dict[float, Samples] = {}

    def ball(self, material: Reflectance) -> Samples:
        """Radiance of a ball of `material`, one row per normal, RGB."""
        value = np.asarray(material.diffuse) * self.diffuse
        if not any(material.specular):
            return value
        if material.roughness not in self.glossy:
            self.glossy[material.roughness] = lobe_of(material.roughness).in_light(self.light)
        return value + np.asarray(material.specular) * self.glossy[material.roughness]


def compare_relighting(
    estimates: Mapping[str, Reflectance],
    truths: Mapping[str, Reflectance],
    estimated_lights: Mapping[str, Light],
    true_lights: Mapping[str, Light],
    seen: Mapping[str, Sequence[str]],
) -> Relighting | None:
    """Every material with a truth in every light with a truth; None where there is no such pair.

    seen: the materials observed in each light.
    """
    pairs = [(li, m) for li in true_lights if li in estimated_lights for m in truths if m in estimates]
    if not pairs:
        return None
    lit = {li: (Appearances(true_lights[li]), Appearances(estimated_lights[li])) for li in {p[0] for p in pairs}}
    true = [lit[li][0].ball(truths[m]) for li, m in pairs]
    kinds = [
        [lit[li][0].ball(estimates[m]) for li, m in pairs],
        [lit[li][1].ball(estimates[m]) for li, m in pairs],
        [GREY * lit[li][0].diffuse for li, _ in pairs],
        [np.broadcast_to(t.mean(axis=0), t.shape) for t in true],
    ]
    balls: dict[str, dict[str, RelitBall]] = {}
    for (li, m), ball in zip(pairs, _relit(true, kinds, [m in seen.get(li, ()) for li, m in pairs])):
        balls.setdefault(li, {})[m] = ball
    every = [b for row in balls.values() for b in row.values()]
    hidden = [b for b in every if not b.observed]
    return Relighting(balls, _mean(every), _mean(hidden) if hidden else None)


def _relit(true: list[Samples], kinds: list[list[Samples]], observed: list[bool]) -> list[RelitBall]:
    _, inside = ball_normals(BALL_SIZE)
    whites = [white_of(t[None], np.ones((1, len(t)), bool)) for t in true]
    factors = [gauge_factors(pictures, true, whites, below_white=True) for pictures in kinds]

    def gauged(i: int, gauge: str) -> Kinds:
        """The errors of ball i in one gauge."""
        shown = zip(KINDS, kinds, factors)
        return {
            k: picture_error(_disc(p[i] * f[gauge][i], inside), _disc(true[i], inside), inside, whites[i])
            for k, p, f in shown
        }

    return [RelitBall(o, 1 / w, {g: gauged(i, g) for g in GAUGES}) for i, (o, w) in enumerate(zip(observed, whites))]


def _disc(samples: Samples, inside: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    picture = np.zeros((*inside.shape, 3))
    picture[inside] = samples
    return picture


def _mean(balls: list[RelitBall]) -> dict[str, Kinds]:
    return {g: {k: mean_error([b.gauges[g][k] for b in balls]) for k in KINDS} for g in GAUGES}
