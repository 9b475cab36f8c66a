"""The stages from photographs to metrics, called one after another without the runner, as a case's own process does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec

from factorlib.dataset.read import read_dataset
from factorlib.dataset.schema import Dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.jsonfile import read_json, write_json
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, silent
from stages import align, evaluate, export, masks, render, solve, urm


class Step(msgspec.Struct, frozen=True):
    """A stage, the slices of the data set that it takes, and into which file what it writes of each photo is gathered; as in pipeline.yaml."""

    stage: ModuleType
    slices: tuple[str, ...]
    over_photos: bool = False
    gather: str | None = None


STEPS = {
    "masks": Step(masks, ("materials", "photo"), True, "photos.json"),
    "align": Step(align, ("materials", "objects"), True, "poses.json"),
    "urm": Step(urm, ("materials", "objects", "light"), True),
    "solve": Step(solve, ("materials", "light")),
    "export": Step(export, ("materials", "objects", "light")),
    "render": Step(render, ("materials", "light"), True),
    "evaluate": Step(evaluate, ("materials", "light", "truth")),
}


def run_stages(
    folder: Path, out: Path, params: Mapping[str, dict[str, Any]], names: tuple[str, ...] = tuple(STEPS)
) -> None:
    """The named stages on the data set in `folder`, each into out/<stage>/; params: by stage, those that differ from their defaults."""
    dataset = read_dataset(folder)
    for name in names:
        (out / name).mkdir(parents=True)
        step, given = STEPS[name], msgspec.convert(params.get(name, {}), STEPS[name].stage.Params)
        for photo in [photo.name for photo in dataset.spec.photos] if step.over_photos else [None]:
            step.stage.main(given, inputs_of(dataset, step, out, photo), out / name, silent)
        if step.gather:
            write_json(
                out / name / step.gather,
                {p.name: read_json(out / name / f"{p.name}.json") for p in dataset.spec.photos},
            )


def inputs_of(dataset: Dataset, step: Step, out: Path, photo: str | None) -> Inputs:
    """What a stage sees of a photo, or of the set: everything that was made before it, and the networks that ship."""
    found = {slice_: dataset_slice(dataset, slice_, photo) for slice_ in step.slices}
    facts = {f"dataset.{slice_}": each.facts for slice_, each in found.items()}
    files = {file: dataset.folder / file for each in found.values() for file in each.files}
    return Inputs({name: out / name for name in STEPS} | {"train": SHIPPED}, facts, files, photo)
