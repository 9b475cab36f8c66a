"""The few numbers at the top, each with what it means, and the cautions that follow from the artifacts.

No better than a guess is what is worse than its null: each light by its spheres and the colour of its map, and each ball in its recovered
light, after a factor per channel and photo; each material by roughness and colours; each photo's normals.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np

from factorlib.evaluate.lights import SPHERES
from factorlib.report.artifacts import Artifacts
from factorlib.report.errors import VIEWS
from factorlib.report.text import number, percent
from factorlib.results.metrics import Metrics, PhotoErrors
from factorlib.results.poses import PhotoPoses

LOW_IOU = 0.85
MANY_CLIPPED = 0.1
MANY_UNCOVERED = 0.15
MANY_UNUSED = 0.3
FEW_PIXELS = 200
GAUGE = "channel_per_photo"
MEANINGS = {
    "psnr": "How close the recovered materials in the recovered light come to the photos: mean over photos, nothing rescaled, after "
    "the tone map. Higher is better.",
    "dssim": "Structural difference, 0 to 1. Lower is better.",
    "roughness": "Mean absolute difference from the true roughness, which lies in 0 to 1.",
    "diffuse": "Mean relative error, after the one factor per channel that no photo can settle.",
    "relighting": "Balls of the recovered materials in the true lights against true balls, one factor for the whole set.",
}


class Headline(msgspec.Struct, frozen=True):
    """One number at the top of the page; beside: what it is compared with; meaning: a sentence for who does not know the measure."""

    label: str
    value: str
    unit: str
    beside: str
    meaning: str


def headlines(metrics: Metrics) -> list[Headline]:
    """Re-synthesis always; materials and relighting where there is a truth."""
    rows, materials = [], metrics.materials
    if metrics.resynthesis.mean:
        score, flat = metrics.resynthesis.mean["none"].estimate, metrics.resynthesis.mean["none"].null
        psnr, dssim = (f"flat colours score {n}" for n in (number(flat.psnr_tonemapped_db, 1), number(flat.dssim, 4)))
        rows.append(("Re-synthesis, PSNR", number(score.psnr_tonemapped_db, 1), "dB", f"{psnr} dB", "psnr"))
        rows.append(("Re-synthesis, DSSIM", number(score.dssim, 4), "", dssim, "dssim"))
    if materials:
        beside = f"worst {number(materials.worst_roughness, 3)}; grey ball {number(materials.null_mean_roughness, 3)}"
        rows.append(("Roughness error", number(materials.mean_roughness, 3), "", beside, "roughness"))
        beside = f"specular {percent(materials.mean_specular)}; grey ball {percent(materials.null_mean_diffuse)}"
        rows.append(("Diffuse colour error", percent(materials.mean_diffuse), "", beside, "diffuse"))
    if metrics.relighting:
        mean = metrics.relighting.mean["scalar_per_set"]
        psnr = {kind: number(error.psnr_tonemapped_db, 1) for kind, error in mean.items()}
        beside = f"grey ball {psnr['null_grey']} dB, mean colour {psnr['null_mean_colour']} dB"
        rows.append(("Relighting, PSNR", psnr["in_true_light"], "dB", beside, "relighting"))
    return [Headline(*row, MEANINGS[meaning]) for *row, meaning in rows]


def cautions(run: Artifacts, metrics: Metrics) -> list[str]:
    """Sentences about what should be distrusted."""
    errors, poses = metrics.resynthesis.photos, run.poses()
    of_photos = [words for name in run.set.photos if name in errors for words in _of_photo(name, errors[name])]
    return [*of_photos, *_of_poses(run.set.photos, poses), *_of_set(run, metrics), *no_better_than_a_guess(metrics)]


def _of_photo(name: str, errors: PhotoErrors) -> Iterator[str]:
    if errors.gauges is None:
        yield f"{name}: mask and mesh agree nowhere, so this photo tells nothing. See its overlay."
        return
    total, score = max(1, errors.pixels + errors.clipped + errors.uncovered), errors.gauges["none"]
    if errors.clipped / total > MANY_CLIPPED:
        yield f"{name}: {percent(errors.clipped / total)} of its pixels are clipped; highlights there are only bounds."
    if errors.uncovered / total > MANY_UNCOVERED:
        yield f"{name}: {percent(errors.uncovered / total)} of the masked pixels are not explained by the mesh."
    if errors.unused / max(1, errors.pixels) > MANY_UNUSED:
        share = percent(errors.unused / errors.pixels)
        yield f"{name}: the solve left out {share} of the pixels, whose normals it does not trust."
    if score.estimate.psnr_tonemapped_db < score.null.psnr_tonemapped_db:
        yield f"{name}: flat colours would fit this photo better than its re-synthesis does."


def _of_poses(photos: list[str], poses: dict[str, PhotoPoses]) -> list[str]:
    """Objects that are left out, then those that overlap badly."""
    objects = [(p, name, each) for p in photos if p in poses for name, each in poses[p].objects.items()]
    left_out = [
        f"{photo}: '{name}' is left out of the solve, its pose is doubtful: {'; '.join(each.doubts)}."
        for photo, name, each in objects
        if each.left_out
    ]
    return left_out + [
        f"{photo}: the mesh of '{name}' and its mask overlap by only {percent(each.silhouette_iou)} (intersection over union)."
        for photo, name, each in objects
        if not each.left_out and each.silhouette_iou is not None and each.silhouette_iou < LOW_IOU
    ]


def _of_set(run: Artifacts, metrics: Metrics) -> Iterator[str]:
    if metrics.set.components > 1:
        yield (
            f"The photos fall into {metrics.set.components} groups that share no material: between groups, colours and "
            "brightness cannot be compared. A photo that shows a material of each group would link them."
        )
    if len(run.illuminations()) == 1:
        yield "There is one light only: only the objects' shape separates light from material."
    facts = run.photo_facts().values()
    for name in run.set.materials:
        pixels = sum(photo.pixels.get(name, 0) for photo in facts)
        if pixels < FEW_PIXELS:
            yield f"Material '{name}' is seen in {pixels} pixels only; its values are hardly more than a guess."


def no_better_than_a_guess(metrics: Metrics) -> list[str]:
    """A sentence for each score that is worse than its null, with both numbers and a reason; none without a truth."""
    return [*_worse_lights(metrics), *_worse_balls(metrics), *_worse_materials(metrics), *_worse_normals(metrics)]


def _worse_lights(metrics: Metrics) -> Iterator[str]:
    for name, gauges in (metrics.light.lights if metrics.light else {}).items():
        scored = gauges[GAUGE]
        beaten = [
            f"a {VIEWS[sphere]} in it is wrong by {percent(scored[sphere].estimate.rmse)} of the truth's RMS, in a constant light by "
            f"{percent(scored[sphere].null.rmse)}"
            for sphere in SPHERES
            if scored[sphere].estimate.rmse > scored[sphere].null.rmse
        ]
        angle, null = (error.rgb_angle_deg for error in (scored["map_all"].estimate, scored["map_all"].null))
        if angle > null:
            beaten.append(
                f"its colours are wrong by {number(angle, 1)}°, those of a constant light by {number(null, 1)}°"
            )
        mirrored, where = metrics.light.mirrored_fraction.get(name), "Its coverage shows where it is only a guess"
        if mirrored is not None:
            where = f"The photos mirror {percent(mirrored)} of its directions; the others are known through diffuse reflection alone. {where}"
        if beaten:
            yield f"the light '{name}' is in part no better than a constant one: {'; '.join(beaten)}. {where}."


def _worse_balls(metrics: Metrics) -> Iterator[str]:
    for light, balls in (metrics.relighting.balls if metrics.relighting else {}).items():
        kinds = {
            material: ball.gauges[GAUGE]
            for material, ball in balls.items()
            if "in_estimated_light" in ball.gauges[GAUGE]
        }
        worse = [
            material
            for material, of in kinds.items()
            if of["in_estimated_light"].psnr_tonemapped_db < of["null_grey"].psnr_tonemapped_db
        ]
        if worse:
            yield (
                f"in the recovered light '{light}', a grey ball in the true light comes nearer to the truth than: {', '.join(worse)}. "
                "Light and material each have their share; balls in the true light show the material's."
            )


def _worse_materials(metrics: Metrics) -> Iterator[str]:
    for name, of in (metrics.materials.materials if metrics.materials else {}).items():
        beaten = []
        if of.error.roughness > of.null.roughness:
            guess = number(of.null.roughness, 2)
            beaten.append(f"roughness is wrong by {number(of.error.roughness, 2)}, a guess of .5 by {guess}")
        for part in ("diffuse", "specular"):
            error, null = (float(np.abs(getattr(one, part)).mean()) for one in (of.error, of.null))
            if error > null:
                beaten.append(f"its {part} colour is wrong by {percent(error)}, a grey one by {percent(null)}")
        if beaten:
            yield (
                f"the material '{name}' is in part no better than a guess: {'; '.join(beaten)}. Where normals are wrong, its standard "
                "errors are too small, too."
            )


def _worse_normals(metrics: Metrics) -> Iterator[str]:
    for photo, of in (metrics.normals or {}).items():
        if of.estimate.median_deg > of.null.median_deg:
            yield (
                f"{photo}: normals are wrong by {number(of.estimate.median_deg, 1)}°, those of a flat disc facing the camera by "
                f"{number(of.null.median_deg, 1)}°. Its overlay shows whether the pose is wrong."
            )
