"""Balls of the recovered materials in other light, against those of the true ones in the true light; errors of lights.

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

Lights are compared by spheres and by their maps.

Three spheres  A white `mirror`, a `glossy` (GGX, roughness 0.4) and a `lambertian` sphere, rendered in the estimated
               and in the true light, as in LeGendre et al. 2019 ("DeepLight").
Env map        The maps themselves, averaged to texels of equal solid angle about 3° across: over all directions, over
               those that an observed pixel mirrors toward the camera (within about 6°), and over the rest.
Errors         rmse: √mean (e − t)² over √mean t²; black scores 1.  rmse_scale_invariant: rmse after the best
               single factor (Grosse et al. 2009).  rgb_angle_deg: mean angle between the RGB vectors, in degrees.
Null           A constant light of the true map's mean colour: a strong null, because no method knows that colour.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, lru_cache

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_of_direction
from factorlib.evaluate.ball import (
    WIDE_SIDE,
    OctahedralLight,
    Reflected,
    diffuse_lobe,
    glossy_lobe,
    mirror_ball,
    octahedral_directions,
    uniform_light,
)
from factorlib.evaluate.comparison_gauge import GAUGES, Samples, errors_by_gauge
from factorlib.evaluate.picture_errors import (
    mean_error,
    mean_error_with_null,
    picture_error,
    psnr,
    tone_map,
    white_level,
)
from factorlib.evaluate.truth import angles_deg
from factorlib.geometry.sphere import ball_normals, mirror_directions
from factorlib.results.materials import Reflectance, Vec3, vec3
from factorlib.results.metrics import (
    Kinds,
    LightError,
    LightErrors,
    PictureError,
    Relighting,
    RelitBall,
    RelitSet,
    ScoredLight,
)

BALL_SIZE = 32
NORMALS, INSIDE = ball_normals(BALL_SIZE)
GREY = 0.5
MEAN_SHOWN = 0.5  # mean of the true ball in the relit set score, linear, before clipping


@lru_cache(maxsize=17)
def ball_lobe(roughness: float | None) -> Reflected:
    """Return the glossy lobe of a ball of some roughness, or the diffuse lobe for None.

    Lobes are cached, up to 200 MB, because materials appear in many lights.
    """
    return diffuse_lobe(NORMALS) if roughness is None else glossy_lobe(NORMALS, roughness)


class Appearances:
    """Balls of many materials in one light; each part of the reflection is rendered once."""

    def __init__(self, light: OctahedralLight):
        self.diffuse = ball_lobe(None)(light)
        self.glossy = cache(lambda roughness: ball_lobe(roughness)(light))

    def ball(self, material: Reflectance) -> Samples:
        """Return the radiance of a ball of `material`, one row per normal, RGB."""
        value = np.asarray(material.diffuse) * self.diffuse
        if not any(material.specular):
            return value
        return value + np.asarray(material.specular) * self.glossy(material.roughness)


@lru_cache(maxsize=64)
def appearances(light: OctahedralLight) -> Appearances:
    """Return the `Appearances` of a light, cached because several scores use them."""
    return Appearances(light)


def compare_relighting(
    estimates: Mapping[str, Reflectance],
    truths: Mapping[str, Reflectance],
    estimated_lights: Mapping[str, OctahedralLight],
    true_lights: Mapping[str, OctahedralLight],
    observed: Mapping[str, Sequence[str]],
) -> Relighting | None:
    """Compare every material with a truth in every light with a truth; None if there is no such pair.

    Args:
        estimates: recovered materials by name
        truths: true materials by name
        estimated_lights: recovered lights by name
        true_lights: true lights by name
        observed: the materials observed in each light
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
    whites = [white_level(t[None], np.ones((1, len(t)), bool)) for t in true]

    def error(ball: Samples, i: int) -> PictureError:
        """Return the error of a scaled ball against the true one."""
        return picture_error(ball_picture(ball), ball_picture(true[i]), INSIDE, whites[i])

    balls: dict[str, dict[str, RelitBall]] = {}
    for (li, m), white, errors in zip(pairs, whites, errors_by_gauge(kinds, true, whites, error, below_white=True)):
        balls.setdefault(li, {})[m] = RelitBall(m in observed.get(li, ()), 1 / white, errors)
    every = [b for row in balls.values() for b in row.values()]
    hidden = [b for b in every if not b.observed]
    return Relighting(balls, _mean(every), _mean(hidden) if hidden else None)


def ball_picture(samples: Samples) -> Float[np.ndarray, "h w 3"]:
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
        scores[m, light] = displayed_psnr(appearances(estimated_lights[light]).ball(estimates[m]), ball)
        nulls.append(displayed_psnr(np.broadcast_to(ball.mean(axis=0), ball.shape), ball))
    if not scores:
        return None
    worst = min(scores, key=scores.__getitem__)
    mean, null = (round(float(np.mean(v)), 6) for v in (list(scores.values()), nulls))
    factor = set_factor((estimates[m], truths[m]) for m in names)
    return RelitSet(len(scores), mean, scores[worst], null, *worst, factor)


def set_factor(pairs: Iterable[tuple[Reflectance, Reflectance]]) -> Vec3:
    """Return the factor per channel from recovered to true reflectances, given (recovered, true) pairs of materials.

    >>> true = Reflectance((0.4, 0.4, 0.1), (0.2, 0.1, 0.0), 0.3)
    >>> set_factor([(Reflectance((0.2, 0.4, 0.1), (0.1, 0.1, 0.1), 0.3), true)])
    (2.0, 1.0, 1.0)
    """
    parameters = np.array([[(m.diffuse, m.specular) for m in pair] for pair in pairs], float)
    recovered, true = (parameters[:, k].reshape(-1, 3).T for k in (0, 1))
    logs = [np.log(t[k]) - np.log(r[k]) for r, t in zip(recovered, true) for k in [(r > 0) & (t > 0)]]
    return vec3(round(float(np.exp(np.median(values))), 9) if values.size else 1.0 for values in logs)


def displayed_psnr(recovered: Samples, true: Samples) -> float:
    """Return the PSNR in dB of two balls at the exposure of the true one, or at exposure 1 if that is black."""
    mean = float(np.mean(true, dtype=float))
    exposure = MEAN_SHOWN / mean if mean > np.finfo(np.float32).tiny else 1.0
    return psnr(tone_map(recovered, exposure), tone_map(true, exposure), 1.0)


GLOSSY_ROUGHNESS = 0.4
COVERAGE_ROWS = 32  # rows of the mask of mirrored directions
COVERAGE_DILATION = 1  # texels by which the mask grows

SPHERES = ("mirror", "glossy", "lambertian")
VIEWS: dict[str, Callable[[OctahedralLight], Samples]] = {
    "mirror": lambda light: mirror_ball(light, NORMALS, BALL_SIZE),
    "glossy": lambda light: appearances(light).glossy(GLOSSY_ROUGHNESS),
    "lambertian": lambda light: appearances(light).diffuse,
    **dict.fromkeys(("map_all", "map_mirrored", "map_unmirrored"), lambda light: light.wide),
}


def light_error(estimate: Samples, truth: Samples) -> LightError:
    """Return the errors of samples of a light, all of the same weight.

    >>> light_error(np.full((4, 3), 2.0), np.ones((4, 3)))
    LightError(rmse=1.0, rmse_scale_invariant=0.0, rgb_angle_deg=0.0)
    """
    scale = np.sqrt(np.mean(truth**2)) or 1.0
    best = float((estimate * truth).sum() / ((estimate**2).sum() or 1.0))
    rmse, scaled = (round(float(np.sqrt(np.mean((f * estimate - truth) ** 2)) / scale), 9) for f in (1.0, best))
    return LightError(rmse, scaled, round(rgb_angle(estimate, truth), 6))


def rgb_angle(estimate: Samples, truth: Samples) -> float:
    """Return the mean angle between RGB vectors, in degrees.

    Samples where either is black are left out.  The angle is 90 if no samples are left.
    """
    lit = (np.linalg.norm(estimate, axis=-1) > 0) & (np.linalg.norm(truth, axis=-1) > 0)
    return float(angles_deg(estimate[lit], truth[lit]).mean()) if lit.any() else 90.0


def compare_lights(
    estimates: Mapping[str, OctahedralLight],
    truths: Mapping[str, OctahedralLight],
    mirrored: Mapping[str, Bool[np.ndarray, "h w"]],
) -> LightErrors | None:
    """Return the errors of the lights that have a truth; None if there are none.

    Args:
        estimates: recovered lights by name
        truths: true lights by name
        mirrored: lat-long masks from `mirrored_directions`, by name
    """
    names = [n for n in estimates if n in truths]
    if not names:
        return None
    lights: dict[str, dict[str, dict[str, ScoredLight]]] = {n: {gauge: {} for gauge in GAUGES} for n in names}
    hits = {n: mirrored[n][_texels_of_octahedron(mirrored[n])] for n in names if n in mirrored}
    parts = {"map_mirrored": hits, "map_unmirrored": {n: ~hit for n, hit in hits.items()}}
    for view, render in VIEWS.items():
        samples = {n: part for n, part in parts.get(view, dict.fromkeys(names, np.True_)).items() if part.any()}
        for name, scored in _scored_view(render, estimates, truths, samples).items():
            for gauge, score in scored.items():
                lights[name][gauge][view] = score
    mean = {}
    for gauge in GAUGES:
        by_view = {v: [lights[n][gauge][v] for n in names if v in lights[n][gauge]] for v in VIEWS}
        mean[gauge] = {v: mean_error_with_null(scores, 9) for v, scores in by_view.items() if scores}
    fraction = {n: float(np.mean(hits[n])) if n in hits else None for n in names}
    return LightErrors(lights, mean, fraction)


def mirrored_directions(
    normals: Float[np.ndarray, "n 3"], views: Float[np.ndarray, "n 3"], frame_from_camera: Float[np.ndarray, "3 3"]
) -> Bool[np.ndarray, "h w"]:
    """Return a lat-long mask of the directions that some pixel mirrors into its view, dilated by one texel of 5.6°.

    Args:
        normals: unit normals, camera frame
        views: unit directions toward the viewer, camera frame
        frame_from_camera: rotation into the light's frame; the identity for a light fixed to the camera
    """
    mirror = mirror_directions(normals, views)
    row, column = lat_long_of_direction(mirror @ (YUP_FROM_CAMERA @ frame_from_camera).T)
    shape = np.array([COVERAGE_ROWS, 2 * COVERAGE_ROWS])
    hit = np.zeros(shape, bool)
    hit[tuple(np.minimum((np.stack([row, column]) * shape[:, None]).astype(int), shape[:, None] - 1))] = True
    wide = np.concatenate([hit[:, -1:], hit, hit[:, :1]], axis=1)  # The map is periodic in azimuth.
    return binary_dilation(wide, np.ones((3, 3)), iterations=COVERAGE_DILATION)[:, 1:-1]


def sphere_row(light: OctahedralLight) -> Float[np.ndarray, "s w 3"]:
    """Render the three spheres side by side, black around them."""
    return np.concatenate([ball_picture(VIEWS[name](light)) for name in SPHERES], axis=1)


def _texels_of_octahedron(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the texels of a lat-long mask at the centres of the octahedral texels."""
    row, column = lat_long_of_direction(octahedral_directions(WIDE_SIDE))
    return tuple(np.minimum((t * n).astype(int), n - 1) for t, n in zip((row, column), mask.shape))


def _scored_view(
    render: Callable[[OctahedralLight], Samples],
    estimates: Mapping[str, OctahedralLight],
    truths: Mapping[str, OctahedralLight],
    samples: Mapping[str, Bool[np.ndarray, "*t"]],
) -> dict[str, dict[str, ScoredLight]]:
    """Return the errors of each light by gauge; `samples` selects the samples that count, by light."""
    true = [render(truths[n])[part].reshape(-1, 3) for n, part in samples.items()]
    kinds = {
        "estimate": [render(estimates[n])[part].reshape(-1, 3) for n, part in samples.items()],
        "null": [render(uniform_light(truths[n].mean))[part].reshape(-1, 3) for n, part in samples.items()],
    }
    whites = [float(np.sqrt(np.mean(t**2))) or 1.0 for t in true]
    errors = errors_by_gauge(kinds, true, whites, lambda scaled, i: light_error(scaled, true[i]))
    return {n: {g: ScoredLight(**kind) for g, kind in each.items()} for n, each in zip(samples, errors, strict=True)}
