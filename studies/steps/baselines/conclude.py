"""What the comparison comes to: writes table.csv, table.json, figure.svg, paragraph.md and pictures/: of the first seed, a row a method."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from factorlib.images.picture import png_bytes, read_png
from factorlib.jsonfile import read_json
from factorlib.stage import Inputs, Progress
from studies.catalogue.comparison import LABELS
from studies.core.baselines.case import ShownShot, photo_name
from studies.core.baselines.show import Pixels, sheet
from studies.core.study import case_name
from studies.core.table import Picture
from studies.steps.conclusion import conclude

CAPTIONS = {
    "novel_view": "New views, in the light of a photo: the photo, the truth, and what each method makes of it.  {about}",
    "novel_light": "New light: the material in a photo, the truth in another light, and what each method makes of it.  {about}",
    "novel_material": "Materials that no photo shows, in the light of a photo.  Projective texturing has no answer.  {about}",
}
MOST_COLUMNS = 6


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sum up the scores of all cases."""
    seed = inputs.facts["dataset.study"]["scale"]["seeds"][0]
    conclude(
        inputs, out, pictures={_named(kind, seed): png_bytes(_sheet(inputs["score"], seed, kind)) for kind in CAPTIONS}
    )


def _named(kind: str, seed: int) -> Picture:
    return Picture(
        f"{kind}.png",
        CAPTIONS[kind].format(about=f"Seed {seed}; every column at its truth's exposure, nothing scaled."),
    )


def _sheet(scores: Path, seed: int, kind: str) -> Pixels:
    folders = {label: scores / case_name(method, seed) for method, label in LABELS.items()}
    answered = {label: {shot.asked.name for shot in _shots(folder)} for label, folder in folders.items()}
    first = folders[LABELS["ours"]]
    every = [shot.asked for shot in _shots(first) if shot.asked.kind == kind]
    chosen = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, MOST_COLUMNS).round().astype(int))]
    rows = (
        [("photo", [read_png(first / f"{photo_name(a.material, a.photo)}.png") for a in chosen])]
        if chosen[0].photo is not None
        else []
    )
    rows.append(("truth", [read_png(first / f"{a.name}-truth.png") for a in chosen]))
    for label, names in answered.items():
        rows.append((label, [read_png(folders[label] / f"{a.name}.png") if a.name in names else None for a in chosen]))
    return sheet(rows, [f"{a.material}\n{a.view}, light {a.light}" for a in chosen])


def _shots(folder: Path) -> list[ShownShot]:
    return msgspec.convert(read_json(folder / "shots.json"), list[ShownShot])
