"""The relit set score: all materials of a set in all its lights, both as recovered, against the true ones in the true lights.

Every pair of a recovered material and a recovered light counts, whether or not a photo shows it, as a ball seen from the front
(`factorlib.evaluate.relighting.Appearances`).

    factor    f_c = exp(median over materials and over k_d, k_s of log(true / recovered)), one for each channel c of the whole set;
              the materials are multiplied and the lights divided by it.  Reflectances of 0, true or recovered, have no logarithm
              and are left out; 1 where none is left.
    shown     s(L) = clip(e L, 0, 1)^(1/2.2), e = .5 / mean of the true ball's radiance over pixels and channels, for both balls
    score     PSNR = −10 log₁₀ mean (s(found) − s(true))², dB over the ball's pixels and channels, at most 120
    null      the same of a flat disc of the true ball's mean radiance, RGB

A pair's radiance is linear in its reflectances and in its light, so the factor cancels in each of them: (f k_d) (E / f) = k_d E.
So balls are made without it, and it is stated for what is compared apart: materials × factor, lights / factor.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from factorlib.evaluate.ball import Light
from factorlib.evaluate.picture import psnr, tone_mapped
from factorlib.evaluate.relighting import Appearances, Samples
from factorlib.results.materials import Reflectance, Vec3
from factorlib.results.metrics import RelitSet

MEAN_SHOWN = 0.5  # of the true ball, linear, before it is clipped


def compare_relit_set(
    estimates: Mapping[str, Reflectance],
    truths: Mapping[str, Reflectance],
    estimated_lights: Mapping[str, Light],
    true_lights: Mapping[str, Light],
) -> RelitSet | None:
    """Of every material and every light that has both a truth and an estimate; None where there is no such pair."""
    names = [m for m in truths if m in estimates]
    scores: dict[tuple[str, str], float] = {}
    nulls: list[float] = []
    for light in [li for li in true_lights if li in estimated_lights]:
        true, found = Appearances(true_lights[light]), Appearances(estimated_lights[light])
        for m in names:
            ball = true.ball(truths[m])
            scores[m, light] = shown_psnr(found.ball(estimates[m]), ball)
            nulls.append(shown_psnr(np.broadcast_to(ball.mean(axis=0), ball.shape), ball))
    if not scores:
        return None
    worst = min(scores, key=scores.__getitem__)
    mean, null = (round(float(np.mean(v)), 6) for v in (list(scores.values()), nulls))
    return RelitSet(
        len(scores), mean, scores[worst], null, *worst, set_factor((estimates[m], truths[m]) for m in names)
    )


def set_factor(pairs: Iterable[tuple[Reflectance, Reflectance]]) -> Vec3:
    """The factor on the recovered reflectances, of (recovered, true) materials.

    >>> true = Reflectance((0.4, 0.4, 0.1), (0.2, 0.1, 0.0), 0.3)
    >>> set_factor([(Reflectance((0.2, 0.4, 0.1), (0.1, 0.1, 0.1), 0.3), true)])
    (2.0, 1.0, 1.0)
    """
    both = np.array(
        [[(m.diffuse, m.specular) for m in pair] for pair in pairs], float
    )  # [m, recovered or true, k_d or k_s, channel]
    found, true = (both[:, k].reshape(-1, 3).T for k in (0, 1))
    logs = [np.log(t[kept]) - np.log(f[kept]) for f, t in zip(found, true) for kept in [(f > 0) & (t > 0)]]
    return tuple(round(float(np.exp(np.median(values))), 9) if values.size else 1.0 for values in logs)


def shown_psnr(found: Samples, true: Samples) -> float:
    """PSNR in dB of two balls at the exposure of the true one, which is 1 where that is black."""
    mean = float(np.mean(true, dtype=float))
    exposure = MEAN_SHOWN / mean if mean > np.finfo(np.float32).tiny else 1.0
    return psnr(tone_mapped(found, exposure), tone_mapped(true, exposure), 1.0)
