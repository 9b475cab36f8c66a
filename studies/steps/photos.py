"""Observations of photos of data sets, by the stages `masks`, `align` and `urm` themselves.

Each stage writes into a folder of its own in <set>/.

Sets are one of this checkout, or rendered sets of chairs of all seeds, as `factorlib.generate` makes them, which
<set>/data keeps: photographs have all bounces, a mesh coarser than what was photographed, clipped pixels. Mitsuba's
scalar variant traces, which every machine has.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import yaml

from factorlib.dataset.read import read_dataset
from factorlib.dataset.schema import Dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.generate.eames import SET, ChairSetOptions, generate
from factorlib.jsonfile import read_json, write_json
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, Progress, silent
from stages import align, masks, urm
from studies.steps import Params

CHECKOUT = Path(__file__).resolve().parents[2]


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Observe all rendered sets, or some photos of a data set of this checkout; poses are searched as in every run."""
    facts = inputs.facts["dataset.sets"]
    if "folder" in facts:
        folder = CHECKOUT / facts["folder"]
        return run_stages(read_dataset(folder), out / folder.name, (masks, align, urm), photos=facts["photos"])
    os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"  # read where Mitsuba is first used
    size = ChairSetOptions(**{field: facts[field] for field in ("width", "height", "light_rows", "spp")})
    for number, seed in enumerate(facts["seeds"]):
        progress(number, len(facts["seeds"]), f"set {seed}")
        (data := out / str(seed) / "data").mkdir(parents=True)
        generate(data, seed, [], size, silent, SET.shots[: facts["shots"]])
        run_stages(read_dataset(data), out / str(seed), (masks, align, urm))
    return None


def run_stages(
    dataset: Dataset,
    out: Path,
    stages: Sequence[ModuleType],
    params: Mapping[str, dict[str, Any]] = {},
    photos: Sequence[str] | None = None,
) -> None:
    """Run stages, of which the first is `masks`, on a data set, each into out/<stage>/, without the runner.

    What each takes is read in pipeline.yaml.  params: by stage, those that differ from their defaults;  photos: None
    for all of the set
    """
    said = yaml.safe_load((CHECKOUT / "pipeline.yaml").read_text(encoding="utf-8"))
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
