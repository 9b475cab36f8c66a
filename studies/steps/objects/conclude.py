"""What a study of objects comes to, with pictures: spheres by setting where all settings have the same materials, else each setting's matrix."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from factorlib.images.picture import png_bytes, read_png
from factorlib.stage import Inputs, Progress
from studies.catalogue.contents import STUDIES
from studies.core.objects.case import ObjectsCase
from studies.core.study import Scale, Setting, case_name
from studies.core.table import Picture
from studies.steps.conclusion import conclude

MOST = 14  # settings that stand side by side
MARGIN = 10  # pixels between the truth and the rest


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sum up the scores of all cases, and lay the first seed's spheres side by side."""
    facts = inputs.facts["dataset.study"]
    study, scale = STUDIES[facts["name"]], msgspec.convert(facts["scale"], Scale)
    settings, seed = study.settings(scale), scale.seeds[0]
    materials = {tuple(_case(setting, seed).material_names) for setting in settings}
    pictures = (
        by_setting(settings, seed, inputs["score"])
        if len(materials) == 1
        else matrices(settings, seed, inputs["score"])
    )
    conclude(inputs, out, pictures=pictures)


def _case(setting: Setting, seed: int) -> ObjectsCase:
    return setting.case(seed)


def by_setting(settings: list[Setting], seed: int, folder: Path) -> dict[Picture, bytes]:
    """Spheres of the recovered materials, a column for each setting, the truth first; in as many pictures as it takes."""
    found = {}
    for number in range(0, len(settings), MOST):
        some = settings[number : number + MOST]
        pairs = [read_png(folder / f"balls-{case_name(setting.name, seed)}.png") for setting in some]
        half = pairs[0].shape[1] // 2
        gap = np.full((len(pairs[0]), MARGIN, 3), 255, np.uint8)
        picture = np.concatenate([pairs[0][:, :half], gap, *(pair[:, half:] for pair in pairs)], axis=1)
        columns = ", ".join(setting.label for setting in some)
        rows = ", ".join(_case(some[0], seed).material_names)
        caption = f"Seed {seed}: {rows} (rows), each a sphere in a light that is in few photos; truth, then recovered from: {columns}."
        found[Picture(f"spheres-{number // MOST + 1}.png", caption)] = png_bytes(picture)
    return found


def matrices(settings: list[Setting], seed: int, folder: Path) -> dict[Picture, bytes]:
    """Each setting's materials (rows) in its lights (columns), true and recovered."""
    return {
        Picture(
            f"{setting.name}.png",
            f"{setting.label}, seed {seed}: {', '.join(_case(setting, seed).material_names)} (rows) in the set's lights (columns); "
            "left the truth, right recovered materials in recovered lights.  Frames: observed entries.",
        ): (folder / f"matrix-{case_name(setting.name, seed)}.png").read_bytes()
        for setting in settings
    }
