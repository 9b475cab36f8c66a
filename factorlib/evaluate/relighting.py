"""Balls of the recovered materials in other light, against balls of the true materials in the true light.

in_true_light       the recovered material in the true light: the error of the material alone
in_estimated_light  the recovered material in the recovered light: the error of both together
null_grey           a grey ball (diffuse 0.5, no specular) in the true light
null_mean_colour    a flat disc of the true ball's mean colour

Balls are seen along the z axis of the light's frame.  For a light fixed to a photo's camera, that is the camera's view.
The gauge `channel_per_photo` treats a ball as a "photo".

The relit set score covers every pair of a recovered material and a recovered light, whether or not a photo shows it.

    factor    f_c = exp(median over materials and over k_d, k_s of log(true / recovered)), one for each channel c of the
              whole set; the materials are multiplied and the lights divided by it.  Reflectances of 0, true or
              recovered, have no logarithm and are left out; 1 if none is left.
    shown     s(L) = clip(e L, 0, 1)^(1/2.2), e = 0.5 / mean of the true ball's radiance over pixels and channels, for
              both balls
    score     PSNR = −10 log₁₀ mean (s(recovered) − s(true))², dB over the ball's pixels and channels, at most 120
    null      the PSNR of a flat disc of the true ball's mean radiance, RGB

A pair's radiance is linear in its reflectances and in its light, so the factor cancels in each pair: (f k_d) (E / f) =
k_d E.  Balls are therefore rendered without it.  The factor is reported for separate comparisons of materials × factor
and of lights / factor.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache, lru_cache

import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import OctahedralLight, Reflected, diffuse_lobe, glossy_lobe
from factorlib.evaluate.comparison_gauge import GAUGES, errors_by_gauge
from factorlib.evaluate.picture_errors import mean_error, picture_error, psnr, tone_mapped, white_of
from factorlib.geometry.sphere import ball_normals
from factorlib.results.materials import Reflectance, Vec3, vec3
from factorlib.results.metrics import Kinds, PictureError, Relighting, RelitBall, RelitSet

BALL_SIZE = 32
NORMALS, INSIDE = ball_normals(BALL_SIZE)
GREY = 0.5
MEAN_SHOWN = 0.5  # mean of the true ball in the relit set score, linear, before clipping

Samples = Float[np.ndarray, "_ 3"]


@lru_cache(maxsize=17)
def lobe_of(roughness: float | None) -> Reflected:
    """Return the glossy lobe of a ball, or the diffuse one for None, cached because materials appear in many lights.

    They take 200 MB at most.
    """
    return diffuse_lobe(NORMALS) if roughness is None else glossy_lobe(NORMALS, roughness)


class Appearances:
    """Balls of many materials in one light, with each part of the reflection rendered once."""

    def __init__(self, light: OctahedralLight):
        self.diffuse = lobe_of(None)(light)
        self.glossy = cache(lambda roughness: lobe_of(roughness)(light))

    def ball(self, material: Reflectance) -> Samples:
        """Return the radiance of a ball of `material`, one row per normal, RGB."""
        value = np.asarray(material.diffuse) * self.diffuse
        if not any(material.specular):
            return value
        return value + np.asarray(material.specular) * self.glossy(material.roughness)


@lru_cache(maxsize=64)
def appearances(light: OctahedralLight) -> Appearances:
    """Return the balls in a light, cached because several scores use them."""
    return Appearances(light)


def compare_relighting(
    estimates: Mapping[str, Reflectance],
    truths: Mapping[str, Reflectance],
    estimated_lights: Mapping[str, OctahedralLight],
    true_lights: Mapping[str, OctahedralLight],
    seen: Mapping[str, Sequence[str]],
) -> Relighting | None:
    """Compare every material with a truth in every light with a truth; None if there is no such pair.

    Args:
        estimates: recovered materials by name
        truths: true materials by name
        estimated_lights: recovered lights by name
        true_lights: true lights by name
        seen: the materials observed in each light
    """
    pairs = [(li, m) for li in true_lights if li in estimated_lights for m in truths if m in estimates]
    if not pairs:
        return None
    lit = {li: (appearances(true_lights[li]), appearances(estimated_lights[li])) for li in {p[0] for p in pairs}}
    true = [lit[li][0].ball(truths[m]) for li, m in pairs]
    kinds = {
        "in_true_light": [lit[li][0].ball(estimates[m]) for li, m in pairs],
        "in_estimated_light": [lit[li][1].ball(estimates[m]) for li, m in pairs],
        "null_grey": [GREY * lit[li][0].diffuse for li, _ in pairs],
        "null_mean_colour": [np.broadcast_to(t.mean(axis=0), t.shape) for t in true],
    }
    whites = [white_of(t[None], np.ones((1, len(t)), bool)) for t in true]

    def error(ball: Samples, i: int) -> PictureError:
        """Return the error of a scaled ball against the true one."""
        return picture_error(disc(ball), disc(true[i]), INSIDE, whites[i])

    balls: dict[str, dict[str, RelitBall]] = {}
    for (li, m), white, errors in zip(pairs, whites, errors_by_gauge(kinds, true, whites, error, below_white=True)):
        balls.setdefault(li, {})[m] = RelitBall(m in seen.get(li, ()), 1 / white, errors)
    every = [b for row in balls.values() for b in row.values()]
    hidden = [b for b in every if not b.observed]
    return Relighting(balls, _mean(every), _mean(hidden) if hidden else None)


def disc(samples: Samples) -> Float[np.ndarray, "h w 3"]:
    """Return the picture of a ball, black around it."""
    picture = np.zeros((*INSIDE.shape, 3))
    picture[INSIDE] = samples
    return picture


def _mean(balls: list[RelitBall]) -> dict[str, Kinds]:
    return {g: {k: mean_error([b.gauges[g][k] for b in balls]) for k in balls[0].gauges[g]} for g in GAUGES}


# ── The relit set score ──────────────────────────────────────────────────────────────────────────────────────────────


def compare_relit_set(
    estimates: Mapping[str, Reflectance],
    truths: Mapping[str, Reflectance],
    estimated_lights: Mapping[str, OctahedralLight],
    true_lights: Mapping[str, OctahedralLight],
) -> RelitSet | None:
    """Return the score over every pair of a material and a light that have a truth and an estimate; None without any.

    Args:
        estimates: recovered materials by name
        truths: true materials by name
        estimated_lights: recovered lights by name
        true_lights: true lights by name
    """
    names = [m for m in truths if m in estimates]
    scores = {}
    nulls = []
    for m, light in ((m, light) for light in true_lights if light in estimated_lights for m in names):
        ball = appearances(true_lights[light]).ball(truths[m])
        scores[m, light] = shown_psnr(appearances(estimated_lights[light]).ball(estimates[m]), ball)
        nulls.append(shown_psnr(np.broadcast_to(ball.mean(axis=0), ball.shape), ball))
    if not scores:
        return None
    worst = min(scores, key=scores.__getitem__)
    mean, null = (round(float(np.mean(v)), 6) for v in (list(scores.values()), nulls))
    factor = set_factor((estimates[m], truths[m]) for m in names)
    return RelitSet(len(scores), mean, scores[worst], null, *worst, factor)


def set_factor(pairs: Iterable[tuple[Reflectance, Reflectance]]) -> Vec3:
    """Return the factor on the recovered reflectances, from pairs of (recovered, true) materials.

    >>> true = Reflectance((0.4, 0.4, 0.1), (0.2, 0.1, 0.0), 0.3)
    >>> set_factor([(Reflectance((0.2, 0.4, 0.1), (0.1, 0.1, 0.1), 0.3), true)])
    (2.0, 1.0, 1.0)
    """
    both = np.array([[(m.diffuse, m.specular) for m in pair] for pair in pairs], float)
    recovered, true = (both[:, k].reshape(-1, 3).T for k in (0, 1))
    logs = [np.log(t[k]) - np.log(r[k]) for r, t in zip(recovered, true) for k in [(r > 0) & (t > 0)]]
    return vec3(round(float(np.exp(np.median(values))), 9) if values.size else 1.0 for values in logs)


def shown_psnr(recovered: Samples, true: Samples) -> float:
    """Return the PSNR in dB of two balls at the exposure of the true one, or at exposure 1 if that is black."""
    mean = float(np.mean(true, dtype=float))
    exposure = MEAN_SHOWN / mean if mean > np.finfo(np.float32).tiny else 1.0
    return psnr(tone_mapped(recovered, exposure), tone_mapped(true, exposure), 1.0)
