"""What the study comes to, with a picture for each way to predict: the photos' chairs above the predicted ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np

from factorlib.images.picture import png_bytes, read_png
from factorlib.stage import Inputs, Progress
from studies.catalogue.contents import STUDIES
from studies.core.measures import MEASURES
from studies.core.study import Scale, case_name
from studies.core.table import Conclusion, Picture
from studies.steps.conclusion import conclude


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sum up the scores of all cases."""
    facts = inputs.facts["dataset.study"]
    study, scale = STUDIES[facts["name"]], msgspec.convert(facts["scale"], Scale)
    pictures = {}
    for setting in study.settings(scale):
        cases = [case_name(setting.name, seed) for seed in study.seeds_of(scale)]
        shown = ", ".join(
            f"{setting.case(seed).photo} ({', '.join(setting.case(seed).shells)})" for seed in study.seeds_of(scale)
        )
        caption = (
            f"{setting.label}: the chairs' shells in the photos (above) and predicted (below), exposed alike: {shown}."
        )
        pictures[Picture(f"{setting.name}.png", caption)] = png_bytes(
            side_by_side([read_png(inputs["score"] / f"chairs-{case}.png") for case in cases])
        )
    photos = {seed: study.settings(scale)[0].case(seed).photo for seed in study.seeds_of(scale)}
    conclude(inputs, out, pictures=pictures, notes=lambda found: [by_photo(found, photos)])


def by_photo(found: Conclusion, photos: Mapping[int, str]) -> str:
    """Each photo's values of the first measure, as a sentence: six photos are few, and one that is unlike the others decides a mean."""
    measure = found.measures[0]
    values = {row.label: row.cells[measure].values for row in found.rows}
    each = "; ".join(f"{photo} {', '.join(f'{of[k]:.2g}' for of in values.values())}" for k, photo in photos.items())
    return f"{MEASURES[measure].label}, photo by photo ({', '.join(values)}): {each}."


def side_by_side(pictures: list[np.ndarray]) -> np.ndarray:
    """White below what is less high.  Halves are kept together: each picture's lower half begins in the same row."""
    half = max(len(picture) // 2 for picture in pictures)
    rows = [[p[: len(p) // 2] for p in pictures], [p[len(p) // 2 :] for p in pictures]]
    padded = [[np.pad(p, ((half - len(p), 0), (4, 4), (0, 0)), constant_values=255) for p in row] for row in rows]
    return np.concatenate([np.concatenate(row, axis=1) for row in padded])
