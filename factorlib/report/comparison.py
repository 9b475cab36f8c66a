"""Two runs side by side: parameters, numbers, materials in standard errors, lights and re-syntheses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.picture import exposure_of, picture
from factorlib.report import text
from factorlib.report.artifacts import Artifacts, Picture
from factorlib.report.headlines import headlines
from factorlib.report.page import STAGES, rendered
from factorlib.report.png import data_uri, reduced
from factorlib.results.materials import MaterialTable, Solved, read_materials
from factorlib.results.photos import read_photos

PHOTOS, MATERIALS = "masks/photos.json", "export/materials.json"  # without which there is nothing to compare
WIDTH = 480  # pixels of a picture
PARTS = ("diffuse", "specular", "roughness")


class Shown(msgspec.Struct, frozen=True):
    """Two pictures of one thing, where they are there, at one exposure, and how far they are apart, in words."""

    name: str
    first: str | None
    second: str | None
    apart: str


class MaterialRow(msgspec.Struct, frozen=True):
    """One part of a material, per channel: both values, and their difference in standard errors; None where one has no error."""

    material: str
    part: str
    first: list[str]
    second: list[str]
    off: list[float | None]


class _Set(msgspec.Struct, frozen=True):
    name: str
    materials: list[str]
    photos: list[str]


def comparison(first: Path, second: Path, changes: Sequence[str] | None) -> str:
    """The page as HTML.  first, second: folders such as build/eames;  changes: in words, between what the two were made from

    InputError where one holds no whole result, or they have no material or photo in common.
    """
    one, two = runs = [_run(folder) for folder in (first, second)]
    tables = [
        read_materials(folder / MATERIALS, f"make export DATASET={_dataset_of(folder)}") for folder in (first, second)
    ]
    photos = [name for name in one.set.photos if name in two.set.photos]
    materials = [name for name in tables[0].materials if name in tables[1].materials]
    if not photos and not materials:
        cure = "name runs of one data set, or of sets that share some"
        raise InputError("the two have no photo and no material in common", file=second, cure=cure)
    lights = dict.fromkeys(one.illumination_of(p) for p in photos if one.illumination_of(p) == two.illumination_of(p))

    def shown(stage: str, kind: str, names: Sequence[str]) -> list[Shown]:
        """A picture of each name, of both runs."""
        return [_shown(name, *(run.rgb(stage, f"{kind}/{name}") for run in runs)) for name in names]

    return rendered(
        "comparison.html",
        names=[str(first), str(second)],
        changes=changes,
        numbers=_numbers(runs),
        rows=_rows(tables, materials),
        only=[sorted(set(tables[k].materials) - set(tables[1 - k].materials)) for k in (0, 1)],
        lights=shown("export", "illumination", list(lights)),
        resyntheses=shown("render", "resynthesis", photos),
    )


def _run(folder: Path) -> Artifacts:
    """InputError where the data set was not run as far as `export`."""
    for file in (PHOTOS, MATERIALS):
        if not (folder / file).is_file():
            stage, _, name = file.partition("/")
            found = f"there is no whole result here: the stage {stage!r} has made no {name}"
            raise InputError(found, file=folder, cure=f"make all DATASET={_dataset_of(folder)}")
    photos = list(read_photos(folder / PHOTOS))
    return Artifacts({stage: folder / stage for stage in STAGES}, _Set(folder.name, [], photos))


def _dataset_of(folder: Path) -> str:
    """The data set whose result it is: a copy may be called otherwise."""
    mark = folder / "dataset.txt"
    return Path(mark.read_text(encoding="utf-8", errors="replace").strip()).name if mark.is_file() else folder.name


def _numbers(runs: list[Artifacts]) -> list[tuple[str, list[str]]]:
    """Headlines of both, by label; a dash where one has none."""
    metrics = [run.metrics() for run in runs]
    both = [{h.label: f"{h.value} {h.unit}".strip() for h in headlines(m)} if m else {} for m in metrics]
    return [(label, [each.get(label, text.DASH) for each in both]) for label in dict.fromkeys([*both[0], *both[1]])]


def _rows(tables: list[MaterialTable], names: list[str]) -> list[MaterialRow]:
    """After the factors that observations leave free, one per channel and group of materials that lie in one connected component of
    the first result, and in one of the second: each group's reflectances of the second are brought to the first's sum."""
    groups: dict[tuple[int, ...], list[str]] = {}
    for name in names:
        groups.setdefault(tuple(table.gauge.component.get(name, 0) for table in tables), []).append(name)
    factor = {name: _factor(tables, group) for group in groups.values() for name in group}
    return [_row(name, part, *(t.materials[name] for t in tables), factor[name]) for name in names for part in PARTS]


def _factor(tables: list[MaterialTable], group: list[str]) -> Float[np.ndarray, "3"]:
    materials = [[table.materials[name] for name in group] for table in tables]
    sums = [np.sum([np.add(m.diffuse, m.specular) for m in each], axis=0) for each in materials]
    return np.divide(sums[0], sums[1], out=np.ones(3), where=sums[1] > 0)


def _row(name: str, part: str, first: Solved, second: Solved, factor: Float[np.ndarray, "3"]) -> MaterialRow:
    scales = 1.0, factor if part != "roughness" else 1.0
    values, errors = (
        [np.atleast_1d(getattr(of, part)) * scale for of, scale in zip(each, scales)]
        for each in ((first, second), (first.stderr, second.stderr))
    )
    off = [float(d / e) if e > 0 else None for d, e in zip(values[1] - values[0], np.hypot(*errors), strict=True)]
    words = [
        [f"{text.number(v, 3)} ± {text.number(e, 3)}" for v, e in zip(*pair, strict=True)]
        for pair in zip(values, errors, strict=True)
    ]
    return MaterialRow(name, part, *words, off)


def _shown(name: str, first: Picture | None, second: Picture | None) -> Shown:
    there = [each for each in (first, second) if each is not None]
    exposure = exposure_of(there[0]) if there else 1.0
    uris = [None if each is None else data_uri(picture(reduced(each, WIDTH), exposure)) for each in (first, second)]
    if len(there) < 2 or first.shape != second.shape:
        return Shown(name, *uris, "" if len(there) < 2 else "of different sizes")
    scale = np.sqrt(np.mean(first**2)) or 1.0
    relative = float(np.sqrt(np.mean((second - first) ** 2)) / scale)
    return Shown(name, *uris, f"RMS difference {text.percent(relative)} of the first's RMS")
