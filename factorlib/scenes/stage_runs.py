"""Stages run on a data set without the runner, as tests and studies call them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import yaml

from factorlib.dataset.schema import Dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.jsonfile import read_json, write_json
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, silent

CHECKOUT = Path(__file__).resolve().parents[2]


def run_stages(
    dataset: Dataset,
    out: Path,
    stages: Sequence[ModuleType],
    params: Mapping[str, dict[str, Any]] = {},
    photos: Sequence[str] | None = None,
) -> None:
    """Run stages on a data set, each into out/<stage>/, with the inputs that pipeline.yaml declares.

    Args:
        dataset: Data set.
        out: Folder of the results.
        stages: Modules of the stages, the first of which is `masks`.
        params: Parameters by stage that differ from their defaults.
        photos: Names of photos; None for all of the set.
    """
    declared = yaml.safe_load((CHECKOUT / "pipeline.yaml").read_text(encoding="utf-8"))["stages"]
    photos = [photo.name for photo in dataset.spec.photos] if photos is None else photos
    folders = {"train": SHIPPED}
    for stage in stages:
        name = stage.__name__.rpartition(".")[2]
        entry = declared[name]
        folders[name] = out / name
        stage_params = msgspec.convert(params.get(name, {}), stage.Params)
        slices = [each.removeprefix("dataset.") for each in entry["inputs"] if each.startswith("dataset.")]
        (out / name).mkdir(parents=True)
        for photo in photos if entry.get("over") == "photo" else [None]:
            parts = {each: dataset_slice(dataset, each, photo) for each in slices}
            facts = {f"dataset.{each}": part.facts for each, part in parts.items()}
            files = {file: dataset.folder / file for part in parts.values() for file in part.files}
            stage.main(stage_params, Inputs(dict(folders), facts, files, photo), out / name, silent)
        if "gather" in entry:
            write_json(out / name / entry["gather"], {p: read_json(out / name / f"{p}.json") for p in photos})
