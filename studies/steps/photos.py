"""What photos of data sets show, by the stages `masks`, `align` and `urm` themselves: writes <set>/ with a folder for each stage.

`run_stages` calls stages one after another without the runner, as a case's own process does; what each takes is read in pipeline.yaml.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import yaml

from factorlib.dataset.read import read_dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.jsonfile import read_json, write_json
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, Progress, silent
from stages import align, masks, urm
from studies.steps import Params

CHECKOUT = Path(__file__).resolve().parents[2]


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """All rendered sets, or some photos of a data set of this checkout; poses are searched as in every run."""
    facts = inputs.facts["dataset.sets"]
    folders = [CHECKOUT / facts["folder"]] if "folder" in facts else sorted(inputs["sets"].iterdir())
    for number, folder in enumerate(folders):
        progress(number, len(folders), f"set {folder.name}")
        run_stages(folder, out / folder.name, (masks, align, urm), photos=facts.get("photos"))


def run_stages(
    folder: Path, out: Path, stages: Sequence[ModuleType], params: Mapping[str, dict[str, Any]] = {}, photos: Sequence[str] | None = None
) -> None:  # fmt: skip
    """Run stages, of which the first is `masks`, on the data set in `folder`, each into out/<stage>/.

    params: by stage, those that differ from their defaults;  photos: None for all of the set
    """
    dataset, said = read_dataset(folder), yaml.safe_load((CHECKOUT / "pipeline.yaml").read_text(encoding="utf-8"))
    photos = [photo.name for photo in dataset.spec.photos] if photos is None else photos
    done = {"train": SHIPPED}
    for stage in stages:
        name = stage.__name__.rpartition(".")[2]
        entry, done[name] = said["stages"][name], out / name
        given = msgspec.convert(params.get(name, {}), stage.Params)
        slices = [each.removeprefix("dataset.") for each in entry["inputs"] if each.startswith("dataset.")]
        (out / name).mkdir(parents=True)
        for photo in photos if entry.get("over") == "photo" else [None]:
            parts = {slice_: dataset_slice(dataset, slice_, photo) for slice_ in slices}
            facts = {f"dataset.{slice_}": part.facts for slice_, part in parts.items()}
            files = {file: dataset.folder / file for part in parts.values() for file in part.files}
            stage.main(given, Inputs(dict(done), facts, files, photo), out / name, silent)
        if "gather" in entry:
            write_json(out / name / entry["gather"], {p: read_json(out / name / f"{p}.json") for p in photos})
