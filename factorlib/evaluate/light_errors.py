"""Errors of recovered light.

Three spheres  A white `mirror`, a `glossy` (GGX, roughness 0.4) and a `lambertian` sphere, rendered in the estimated
               and in the true light, as in LeGendre et al. 2019 ("DeepLight").
Env map        The maps themselves, averaged to texels of equal solid angle about 3° across: over all directions, over
               those that an observed pixel mirrors toward the camera (within about 6°), and over the rest.
Errors         rmse: √mean (e − t)² over √mean t²; black scores 1.  rmse_scale_invariant: rmse after the best
               single factor (Grosse et al. 2009).  rgb_angle_deg: mean angle between the RGB vectors, in degrees.
Null           A constant light of the true map's mean colour: a strong null, because no method knows that colour.
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_of_direction
from factorlib.evaluate.ball import (
    WIDE_SIDE,
    OctahedralLight,
    constant_light,
    mirror_ball,
    octahedral_directions,
)
from factorlib.evaluate.comparison_gauge import GAUGES, errors_by_gauge
from factorlib.evaluate.picture_errors import mean_scored
from factorlib.evaluate.relighting import BALL_SIZE, NORMALS, appearances, disc
from factorlib.evaluate.truth import angles_deg
from factorlib.geometry.sphere import mirror_directions
from factorlib.results.metrics import LightError, LightErrors, ScoredLight

GLOSSY_ROUGHNESS = 0.4
COVERAGE_ROWS = 32  # rows of the mask of mirrored directions
COVERAGE_DILATION = 1  # texels by which the mask grows

Samples = Float[np.ndarray, "_ 3"]
SPHERES = ("mirror", "glossy", "lambertian")
VIEWS: dict[str, Callable[[OctahedralLight], Samples]] = {
    "mirror": lambda light: mirror_ball(light, NORMALS, BALL_SIZE),
    "glossy": lambda light: appearances(light).glossy(GLOSSY_ROUGHNESS),
    "lambertian": lambda light: appearances(light).diffuse,
    **dict.fromkeys(("map_all", "map_mirrored", "map_unmirrored"), lambda light: light.wide),
}


def light_error(estimate: Samples, truth: Samples) -> LightError:
    """Return the errors of samples that stand for equal areas.

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
        mean[gauge] = {v: mean_scored(scores, 9) for v, scores in by_view.items() if scores}
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
    return np.concatenate([disc(VIEWS[name](light)) for name in SPHERES], axis=1)


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
        "null": [render(constant_light(truths[n].mean))[part].reshape(-1, 3) for n, part in samples.items()],
    }
    whites = [float(np.sqrt(np.mean(t**2))) or 1.0 for t in true]
    errors = errors_by_gauge(kinds, true, whites, lambda scaled, i: light_error(scaled, true[i]))
    return {n: {g: ScoredLight(**kind) for g, kind in each.items()} for n, each in zip(samples, errors, strict=True)}
