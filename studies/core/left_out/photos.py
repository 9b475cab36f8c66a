"""What the pipeline sees of a data set: its own stages `masks`, `align` and `urm`, photo by photo; and what is left without a chair."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from factorlib.dataset.read import read_dataset
from factorlib.dataset.schema import Dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.stage import Inputs, Progress, silent
from factorlib.urm.observations import Observations
from stages import align, masks, urm

STAGES = (masks, align, urm)
SLICES = ("materials", "photo", "objects", "light")


def observe(folder: Path, photos: Sequence[str], out: Path, progress: Progress) -> None:
    """Write masks/, align/ and urm/ of these photos into `out`; poses are searched where the data set gives none."""
    dataset, folders = read_dataset(folder), {}
    for number, stage in enumerate(STAGES):
        home = out / stage.__name__.rpartition(".")[2]
        home.mkdir(exist_ok=True)
        for k, photo in enumerate(photos):
            progress(number * len(photos) + k, len(STAGES) * len(photos), f"{home.name} {photo}")
            stage.main(stage.Params(), inputs_of(dataset, photo, folders), home, silent)
        folders[home.name] = home


def inputs_of(dataset: Dataset, photo: str, folders: dict[str, Path]) -> Inputs:
    """What a stage over photos is handed of one."""
    slices = {name: dataset_slice(dataset, name, photo) for name in SLICES}
    files = {file: dataset.folder / file for each in slices.values() for file in each.files}
    return Inputs(dict(folders), {f"dataset.{name}": each.facts for name, each in slices.items()}, files, photo=photo)


def without(seen: Observations, material: str) -> Observations:
    """A photo's observations but for those of a material."""
    return seen.take(seen.material != seen.materials.index(material))


def flat_colour(seen: dict[str, Observations], photo: str, shell: str, beside: str) -> np.ndarray:
    """The shell's mean colour in the other photos, over that of `beside` there, times that of `beside` here: RGB radiance.

    What can be said of a left-out chair without any model of light: `beside` (the wood of the legs) is in all photos.
    """
    others = [p for p in seen if p != photo and len(_of(seen[p], shell)) and len(_of(seen[p], beside))]
    ratio = np.mean([np.log(_of(seen[p], shell).mean(0) / _of(seen[p], beside).mean(0)) for p in others], axis=0)
    return _of(seen[photo], beside).mean(0) * np.exp(ratio)


def _of(seen: Observations, material: str) -> np.ndarray:
    return seen.radiance[seen.material == seen.materials.index(material)].astype(float)
