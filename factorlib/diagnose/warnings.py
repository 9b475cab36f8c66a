"""What is missing or unusable in the observations, as sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorlib.diagnose.answer import Answer
from factorlib.diagnose.identifiability import (
    poorly_explained,
    tinted_alike,
    undetermined_by_answer,
    undetermined_by_observations,
    unlikely_curves,
)
from factorlib.diagnose.uncertainty import StandardErrors
from factorlib.model.blocks import Block
from factorlib.model.components import connected_components
from factorlib.model.gathered import PhotoObservations

EXPOSURE_DIFFERS = 1.5  # by which factor what is found may differ from EXIF without a word


def unseen_materials(names: Sequence[str], blocks: Sequence[Block]) -> list[str]:
    """Materials that no photo shows; names: of all materials, in the order of their numbers."""
    observed = {int(m) for block in blocks for m in np.unique(block.material)}
    return [
        f"material '{name}' is observed in no photo: its reflectance is only a guess"
        for m, name in enumerate(names)
        if m not in observed
    ]


def photos_without_light(photos: Sequence[str], blocks: Sequence[Block]) -> list[str]:
    """Photos of which no observation is usable."""
    lit = {photo for block in blocks for photo in block.photos}
    return [f"photo '{photo}' has no valid observation and gets no light" for photo in sorted(set(photos) - lit)]


def unlinked_sets(names: Sequence[str], blocks: Sequence[Block]) -> list[str]:
    """Where photos fall into sets that share no material."""
    linked = [component for component in connected_components(blocks, len(names)) if component.illuminations]
    if len(linked) < 2:
        return []
    groups = "; ".join(
        f"{', '.join(lights)} (with {', '.join(names[m] for m in members)})" for members, lights in linked
    )
    return [
        f"the photos fall into {len(linked)} sets that share no material, so their reflectances cannot be compared: {groups}. "
        "A photo that shows a material of each would link them"
    ]


def unusable_observations(photos: Sequence[PhotoObservations]) -> list[str]:
    """Photos of which observations were left out."""
    return [
        f"photo '{', '.join(photo.merged.photos)}': {photo.unusable} of {photo.count} observations are left out, "
        "their radiance, normal or view not finite or their weight not positive"
        for photo in photos
        if photo.unusable
    ]


def exposures_unlike_exif(answer: Answer) -> list[str]:
    """Photos whose exposure is found to be another than their EXIF says."""
    relative = answer.relative
    return [
        f"photo '{photo}': by its EXIF its exposure is {relative[photo]:.3g} of its light's first photo, by its pixels "
        f"{factor * relative[photo]:.3g}: was it made brighter or darker later?"
        for photo, factor in answer.found_exposures().items()
        if relative[photo] != 1 and abs(np.log(factor)) > np.log(EXPOSURE_DIFFERS)
    ]


def before_solving(names: Sequence[str], photos: Sequence[str], blocks: Sequence[Block]) -> list[str]:
    """What observations lack and cannot tell; photos: all that there are."""
    missing = [*unseen_materials(names, blocks), *photos_without_light(photos, blocks), *unlinked_sets(names, blocks)]
    return [*missing, *undetermined_by_observations(names, blocks)]


def after_solving(answer: Answer, errors: StandardErrors) -> list[str]:
    """What the answer leaves open or explains badly."""
    problem, point = answer.solution.shown(answer.problem), answer.solution.point
    return [
        *undetermined_by_answer(answer.names, problem.blocks, point.materials, errors.materials),
        *poorly_explained(problem, point),
        *unlikely_curves(problem.blocks, point.lights),
        *tinted_alike(answer.names, problem.blocks, point.lights),
        *exposures_unlike_exif(answer),
    ]
