"""Comparison of two runs: parameters, errors, materials in standard errors, lights and re-syntheses."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.images.picture import data_uri, exposure_of, picture
from factorlib.pack import check_whole
from factorlib.report.artifacts import STAGES, Artifacts, Picture
from factorlib.report.pictures import downsample
from factorlib.report.template import DASH, headlines, number, percent, render_template
from factorlib.results.exchange import exchanged_folders
from factorlib.results.materials import MaterialTable, SolvedMaterial, read_materials
from factorlib.results.photos import read_photos

# results that both runs must have
PHOTOS = "masks/photos.json"
MATERIALS = "export/materials.json"
WIDTH = 480  # longest side of a picture, pixels


def comparison(first: Path, second: Path, changes: Sequence[str] | None) -> str:
    """Return the page of a comparison as HTML.

    Args:
        first: a result folder such as build/eames
        second: the other result folder
        changes: differences between the inputs of the two runs, in words

    Raises:
        InputError: A run is incomplete, or the two have no material and no photo in common.
    """
    runs = [_read_run(folder) for folder in (first, second)]
    tables = [read_materials(folder / MATERIALS) for folder in (first, second)]
    photos = [name for name in runs[0].set.photos if name in runs[1].set.photos]
    materials = [name for name in tables[0].materials if name in tables[1].materials]
    if not photos and not materials:
        raise InputError(
            f"has no photo and no material in common with {first}",
            file=second,
            cure="name results of one data set, or of sets that share photos or materials",
        )
    names = [{run.illumination_of(photo) for run in runs} for photo in photos]
    lights = dict.fromkeys(name for pair in names if len(pair) == 1 for name in pair)

    def pairs(stage: str, kind: str, names: Sequence[str]) -> list[dict[str, str | None]]:
        """Return both runs' pictures of a kind, by name."""
        return [_pair(name, *(run.rgb(stage, f"{kind}/{name}") for run in runs)) for name in names]

    return render_template(
        "comparison.html",
        names=[str(first), str(second)],
        changes=changes,
        numbers=_numbers(runs),
        rows=_rows(tables, materials),
        only=[sorted(set(tables[k].materials) - set(tables[1 - k].materials)) for k in (0, 1)],
        lights=pairs("export", "illumination", list(lights)),
        resyntheses=pairs("render", "resynthesis", photos),
    )


def _read_run(folder: Path) -> Artifacts:
    """Return the results of a run; InputError if it did not reach `export`."""
    check_whole(folder, (PHOTOS, MATERIALS))
    photo_set = SimpleNamespace(name=folder.name, photos=list(read_photos(folder / PHOTOS)))
    return Artifacts(exchanged_folders({stage: folder / stage for stage in STAGES}), photo_set)


def _numbers(runs: list[Artifacts]) -> list[tuple[str, list[str]]]:
    """Return the headlines of both runs by label; a dash if one has none."""
    metrics = [run.metrics for run in runs]
    values = [{h["label"]: f"{h['value']} {h['unit']}".strip() for h in headlines(m)} if m else {} for m in metrics]
    return [(label, [run.get(label, DASH) for run in values]) for label in dict.fromkeys([*values[0], *values[1]])]


def _rows(tables: list[MaterialTable], names: list[str]) -> list[dict[str, Any]]:
    """Return a row for each part of each material, in a common gauge.

    One factor per channel brings the second run's reflectances to the first's sum.  It is fitted to each group of
    materials that lie in one connected component of both results.
    """
    groups: dict[tuple[int, ...], list[str]] = {}
    for name in names:
        groups.setdefault(tuple(table.gauge.component.get(name, 0) for table in tables), []).append(name)
    factor: dict[str, np.ndarray] = {}
    first, second = (table.materials for table in tables)
    for group in groups.values():
        pair = ([table.materials[name] for name in group] for table in tables)
        sums = [np.sum([np.add(m.diffuse, m.specular) for m in each], axis=0) for each in pair]
        factor |= dict.fromkeys(group, np.divide(sums[0], sums[1], out=np.ones(3), where=sums[1] > 0))
    parts = ("diffuse", "specular", "roughness")
    return [_row(name, part, first[name], second[name], factor[name]) for name in names for part in parts]


def _row(
    name: str, part: str, first: SolvedMaterial, second: SolvedMaterial, factor: Float[np.ndarray, "3"]
) -> dict[str, Any]:
    """Return both values per channel in words, and `off`, their difference in standard errors.

    `off` is None if neither value has a standard error.
    """
    scales = 1.0, factor if part != "roughness" else 1.0
    values, errors = (
        [np.atleast_1d(getattr(result, part)) * scale for result, scale in zip(each, scales)]
        for each in ((first, second), (first.stderr, second.stderr))
    )
    off = [float(d / e) if e > 0 else None for d, e in zip(values[1] - values[0], np.hypot(*errors), strict=True)]
    words = [[f"{number(v, 3)} ± {number(e, 3)}" for v, e in zip(*pair, strict=True)] for pair in zip(values, errors)]
    return {"material": name, "part": part, "first": words[0], "second": words[1], "off": off}


def _pair(name: str, first: Picture | None, second: Picture | None) -> dict[str, str | None]:
    """Return two pictures of one thing at one exposure, with their difference in words; either may be missing."""
    present = [each for each in (first, second) if each is not None]
    exposure = exposure_of(present[0]) if present else 1.0
    uris = [None if each is None else data_uri(picture(downsample(each, WIDTH), exposure)) for each in (first, second)]
    if first is None or second is None:
        apart = ""
    elif first.shape != second.shape:
        apart = "of different sizes"
    else:
        relative = float(np.sqrt(np.mean((second - first) ** 2)) / (np.sqrt(np.mean(first**2)) or 1.0))
        apart = f"RMS difference {percent(relative)} of the first's RMS"
    return {"name": name, "first": uris[0], "second": uris[1], "apart": apart}
