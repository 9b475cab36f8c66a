"""The few numbers at the top, each with what it means, and the cautions that follow from the artifacts."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from factorlib.report.artifacts import Artifacts
from factorlib.report.nulls import no_better_than_a_guess
from factorlib.report.text import number, percent
from factorlib.results.metrics import MaterialErrors, Metrics, Relighting, Resynthesis
from factorlib.results.poses import ObjectEntry, PhotoPoses

LOW_IOU = 0.85
MANY_CLIPPED = 0.1
MANY_UNCOVERED = 0.15
MANY_UNUSED = 0.3
FEW_PIXELS = 200
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
    return [*_resynthesis(metrics.resynthesis), *_materials(metrics.materials), *_relighting(metrics.relighting)]


def _resynthesis(found: Resynthesis) -> list[Headline]:
    if not found.mean:
        return []
    score, flat = found.mean["none"].estimate, found.mean["none"].null
    psnr, dssim = (f"flat colours score {number(value, digits)}" for value, digits in ((flat.psnr_tonemapped_db, 1), (flat.dssim, 4)))
    return [
        Headline("Re-synthesis, PSNR", number(score.psnr_tonemapped_db, 1), "dB", psnr + " dB", MEANINGS["psnr"]),
        Headline("Re-synthesis, DSSIM", number(score.dssim, 4), "", dssim, MEANINGS["dssim"]),
    ]


def _materials(found: MaterialErrors | None) -> list[Headline]:
    if not found:
        return []
    roughness = f"worst {number(found.worst_roughness, 3)}; grey ball {number(found.null_mean_roughness, 3)}"
    diffuse = f"specular {percent(found.mean_specular)}; grey ball {percent(found.null_mean_diffuse)}"
    return [
        Headline("Roughness error", number(found.mean_roughness, 3), "", roughness, MEANINGS["roughness"]),
        Headline("Diffuse colour error", percent(found.mean_diffuse), "", diffuse, MEANINGS["diffuse"]),
    ]


def _relighting(found: Relighting | None) -> list[Headline]:
    if not found:
        return []
    score = {kind: number(error.psnr_tonemapped_db, 1) for kind, error in found.mean["scalar_per_set"].items()}
    beside = f"grey ball {score['null_grey']} dB, mean colour {score['null_mean_colour']} dB"
    return [Headline("Relighting, PSNR", score["in_true_light"], "dB", beside, MEANINGS["relighting"])]


def cautions(run: Artifacts, metrics: Metrics) -> list[str]:
    """Sentences about what should be distrusted."""
    return [*_of_photos(run, metrics), *_of_poses(run), *_of_set(run, metrics), *no_better_than_a_guess(metrics)]


def _of_photos(run: Artifacts, metrics: Metrics) -> list[str]:
    found = []
    for name in run.set.photos:
        errors = metrics.resynthesis.photos.get(name)
        if not errors:
            continue
        total = max(1, errors.pixels + errors.clipped + errors.uncovered)
        if errors.gauges is None:
            found.append(f"{name}: mask and mesh agree nowhere, so this photo tells nothing. See its overlay.")
            continue
        if errors.clipped / total > MANY_CLIPPED:
            found.append(f"{name}: {percent(errors.clipped / total)} of its pixels are clipped; highlights there are only bounds.")
        if errors.uncovered / total > MANY_UNCOVERED:
            found.append(f"{name}: {percent(errors.uncovered / total)} of the masked pixels are not explained by the mesh.")
        if errors.unused / max(1, errors.pixels) > MANY_UNUSED:
            found.append(
                f"{name}: the solve left out {percent(errors.unused / errors.pixels)} of the pixels, whose normals it does not trust."
            )
        if errors.gauges["none"].estimate.psnr_tonemapped_db < errors.gauges["none"].null.psnr_tonemapped_db:
            found.append(f"{name}: flat colours would fit this photo better than its re-synthesis does.")
    return found


def _of_poses(run: Artifacts) -> list[str]:
    poses = run.poses()
    left_out = [
        f"{photo}: '{name}' is left out of the solve, its pose is doubtful: {'; '.join(entry.doubts)}."
        for photo in run.set.photos
        for name, entry in _objects(poses, photo)
        if entry.left_out
    ]
    return left_out + [
        f"{photo}: the mesh of '{name}' and its mask overlap by only {percent(entry.silhouette_iou)} (intersection over union)."
        for photo in run.set.photos
        for name, entry in _objects(poses, photo)
        if entry.silhouette_iou is not None and entry.silhouette_iou < LOW_IOU and not entry.left_out
    ]


def _objects(poses: dict[str, PhotoPoses], photo: str) -> Iterable[tuple[str, ObjectEntry]]:
    return poses[photo].objects.items() if photo in poses else ()


def _of_set(run: Artifacts, metrics: Metrics) -> list[str]:
    found = []
    if metrics.set.components > 1:
        found.append(
            f"The photos fall into {metrics.set.components} groups that share no material: between groups, colours and "
            "brightness cannot be compared. A photo that shows a material of each group would link them."
        )
    if len(run.illuminations()) == 1:
        found.append("There is one light only: only the objects' shape separates light from material.")
    facts = run.photo_facts()
    for material in run.set.materials:
        pixels = sum(f.pixels.get(material, 0) for f in facts.values())
        if pixels < FEW_PIXELS:
            found.append(f"Material '{material}' is seen in {pixels} pixels only; its values are hardly more than a guess.")
    return found
