"""Where an answer is no better than a guess, and why: one sentence for each score that is worse than its null.

What is compared: each light by its spheres and the colour of its map, and each ball in its recovered light, after a factor per channel
and photo; each material by roughness and colours; each photo's normals.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factorlib.evaluate.lights import SPHERES
from factorlib.report.errors import VIEWS
from factorlib.report.text import number, percent
from factorlib.results.metrics import LightErrors, MaterialErrors, Metrics, NormalError, Relighting

GAUGE = "channel_per_photo"


def no_better_than_a_guess(metrics: Metrics) -> list[str]:
    """Sentences; none without a truth."""
    return [*_lights(metrics.light), *_balls(metrics.relighting), *_materials(metrics.materials), *_normals(metrics.normals or {})]


def _lights(found: LightErrors | None) -> Iterator[str]:
    for name, gauges in (found.lights if found else {}).items():
        scored, beaten = gauges[GAUGE], []
        for sphere in SPHERES:
            error, null = scored[sphere].estimate.rmse, scored[sphere].null.rmse
            if error > null:
                beaten.append(f"a {VIEWS[sphere]} in it is wrong by {percent(error)} of the truth's RMS, in a constant light by {percent(null)}")
        angle, null_angle = scored["map_all"].estimate.rgb_angle_deg, scored["map_all"].null.rgb_angle_deg
        if angle > null_angle:
            beaten.append(f"its colours are wrong by {number(angle, 1)}°, those of a constant light by {number(null_angle, 1)}°")
        if beaten:
            yield f"the light '{name}' is in part no better than a constant one: {'; '.join(beaten)}. {_why(found.mirrored_fraction.get(name))}"


def _why(mirrored: float | None) -> str:
    where = "Its coverage shows where it is only a guess"
    if mirrored is None:
        return f"{where}."
    return f"The photos mirror {percent(mirrored)} of its directions; the others are known through diffuse reflection alone. {where}."


def _balls(found: Relighting | None) -> Iterator[str]:
    for light, balls in (found.balls if found else {}).items():
        worse = [material for material, ball in balls.items() if _beaten(ball.gauges[GAUGE])]
        if worse:
            yield (
                f"in the recovered light '{light}', a grey ball in the true light comes nearer to the truth than: {', '.join(worse)}. "
                "Light and material each have their share; balls in the true light show the material's."
            )


def _beaten(kinds: dict) -> bool:
    return "in_estimated_light" in kinds and kinds["in_estimated_light"].psnr_tonemapped_db < kinds["null_grey"].psnr_tonemapped_db


def _materials(found: MaterialErrors | None) -> Iterator[str]:
    for name, of in (found.materials if found else {}).items():
        beaten = []
        if of.error.roughness > of.null.roughness:
            beaten.append(f"roughness is wrong by {number(of.error.roughness, 2)}, a guess of .5 by {number(of.null.roughness, 2)}")
        for part in ("diffuse", "specular"):
            error, null = (float(np.abs(getattr(one, part)).mean()) for one in (of.error, of.null))
            if error > null:
                beaten.append(f"its {part} colour is wrong by {percent(error)}, a grey one by {percent(null)}")
        if beaten:
            yield f"the material '{name}' is in part no better than a guess: {'; '.join(beaten)}. Where normals are wrong, its standard errors are too small, too."


def _normals(found: dict[str, NormalError]) -> Iterator[str]:
    for photo, of in found.items():
        if of.estimate.median_deg > of.null.median_deg:
            yield (
                f"{photo}: normals are wrong by {number(of.estimate.median_deg, 1)}°, those of a flat disc facing the camera by "
                f"{number(of.null.median_deg, 1)}°. Its overlay shows whether the pose is wrong."
            )
