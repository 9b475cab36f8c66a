"""Two runs side by side: parameters, numbers, materials in standard errors, lights and re-syntheses."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import jinja2
import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.picture import exposure_of, picture
from factorlib.report import text
from factorlib.report.artifacts import Artifacts
from factorlib.report.headlines import headlines
from factorlib.report.png import data_uri, reduced
from factorlib.results.materials import MaterialTable, Solved, read_materials
from factorlib.results.photos import read_photos

STAGES = ("masks", "align", "urm", "train", "solve", "export", "render", "evaluate")
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
    """Of one part of a material, per channel: both values, and their difference in standard errors; None where one has no error."""

    material: str
    part: str
    first: list[str]
    second: list[str]
    off: list[float | None]


def comparison(first: Path, second: Path, changes: Sequence[str] | None) -> str:
    """The page as HTML.  first, second: folders such as build/eames;  changes: in words, between what the two were made from

    InputError where one holds no whole result, or they have no material or photo in common.
    """
    runs = [_run(folder) for folder in (first, second)]
    tables = [read_materials(folder / MATERIALS, f"make export DATASET={_dataset_of(folder)}") for folder in (first, second)]
    photos = [name for name in runs[0].set.photos if name in runs[1].set.photos]
    materials = [name for name in tables[0].materials if name in tables[1].materials]
    if not photos and not materials:
        raise InputError("the two have no photo and no material in common", file=second, cure="name runs of one data set, or of sets that share some")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    environment.filters |= {name: getattr(text, name) for name in ("number", "significant")}
    environment.tests["of_a_parameter"] = lambda change: ": parameter " in change or ": default of parameter " in change
    folder = files("factorlib.report") / "templates"
    environment.loader = jinja2.FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8"))
    lights = list(dict.fromkeys(runs[0].illumination_of(photo) for photo in photos if runs[0].illumination_of(photo) == runs[1].illumination_of(photo)))
    return environment.get_template("comparison.html").render(
        names=[str(first), str(second)],
        changes=changes,
        numbers=_numbers(runs),
        rows=_rows(tables, materials),
        only=[sorted(set(tables[k].materials) - set(tables[1 - k].materials)) for k in (0, 1)],
        lights=[_shown(name, *(run.illumination(name) for run in runs)) for name in lights],
        resyntheses=[_shown(name, *(run.resynthesis(name) for run in runs)) for name in photos],
    )


class _Set(msgspec.Struct, frozen=True):
    name: str
    materials: list[str]
    photos: list[str]


def _run(folder: Path) -> Artifacts:
    """InputError where the data set was not run as far as `export`."""
    for file in (PHOTOS, MATERIALS):
        if not (folder / file).is_file():
            found = f"there is no whole result here: the stage {file.partition('/')[0]!r} has made no {Path(file).name}"
            raise InputError(found, file=folder, cure=f"make all DATASET={_dataset_of(folder)}")
    return Artifacts({stage: folder / stage for stage in STAGES}, _Set(folder.name, [], list(read_photos(folder / PHOTOS))))


def _dataset_of(folder: Path) -> str:
    """The data set whose result it is: a copy may be called otherwise."""
    mark = folder / "dataset.txt"
    return Path(mark.read_text(encoding="utf-8", errors="replace").strip()).name if mark.is_file() else folder.name


def _numbers(runs: list[Artifacts]) -> list[tuple[str, list[str]]]:
    """Headlines of both, by label; a dash where one has none."""
    found = [{h.label: f"{h.value} {h.unit}".strip() for h in headlines(m)} if (m := run.metrics()) else {} for run in runs]
    labels = dict.fromkeys([*found[0], *found[1]])
    return [(label, [each.get(label, text.DASH) for each in found]) for label in labels]


def _rows(tables: list[MaterialTable], names: list[str]) -> list[MaterialRow]:
    """After the factors that observations leave free, one per channel and group of materials that both results link:
    each group's reflectances of the second are brought to the first's sum."""
    factor = {name: _factor(tables, group) for group in _linked(tables, names) for name in group}
    return [_row(name, part, *(table.materials[name] for table in tables), factor[name]) for name in names for part in PARTS]


def _linked(tables: list[MaterialTable], names: list[str]) -> list[list[str]]:
    """Materials that lie in one connected component of the first result, and in one of the second."""
    groups: dict[tuple[int, ...], list[str]] = {}
    for name in names:
        groups.setdefault(tuple(table.gauge.component.get(name, 0) for table in tables), []).append(name)
    return list(groups.values())


def _factor(tables: list[MaterialTable], group: list[str]) -> Float[np.ndarray, "3"]:
    sums = [np.sum([np.add(table.materials[name].diffuse, table.materials[name].specular) for name in group], axis=0) for table in tables]
    return np.divide(sums[0], sums[1], out=np.ones(3), where=sums[1] > 0)


def _row(name: str, part: str, first: Solved, second: Solved, factor: Float[np.ndarray, "3"]) -> MaterialRow:
    scale = factor if part != "roughness" else np.ones(1)
    values = [np.atleast_1d(getattr(first, part)), np.atleast_1d(getattr(second, part)) * scale]
    errors = [np.atleast_1d(getattr(first.stderr, part)), np.atleast_1d(getattr(second.stderr, part)) * scale]
    together = np.hypot(*errors)
    off = [float(d / e) if e > 0 else None for d, e in zip(values[1] - values[0], together, strict=True)]
    words = [[f"{text.number(v, 3)} ± {text.number(e, 3)}" for v, e in zip(vs, es, strict=True)] for vs, es in zip(values, errors, strict=True)]
    return MaterialRow(name, part, *words, off)


def _shown(name: str, first: np.ndarray | None, second: np.ndarray | None) -> Shown:
    there = [each for each in (first, second) if each is not None]
    exposure = exposure_of(there[0]) if there else 1.0
    uris = [None if each is None else data_uri(picture(reduced(each, WIDTH), exposure)) for each in (first, second)]
    if len(there) < 2 or first.shape != second.shape:
        return Shown(name, *uris, "" if len(there) < 2 else "of different sizes")
    scale = np.sqrt(np.mean(first**2)) or 1.0
    return Shown(name, *uris, f"RMS difference {text.percent(float(np.sqrt(np.mean((second - first) ** 2)) / scale))} of the first's RMS")
