"""Report of the run: a self-contained page, and a figure of each photo as PNG.

Writes index.html, which needs no other file and no network, and for each photo figures/photos/<photo>.png: photo,
materials, re-synthesis and difference side by side.  Except for the section on cost, the page has the same bytes in
every run.
"""

from itertools import count
from pathlib import Path

import msgspec

from factorlib.dataset.schema import LightSlice, ObjectsSlice, SetSlice
from factorlib.render.solved_set import SolvedSet
from factorlib.report.artifacts import Artifacts
from factorlib.report.page import page
from factorlib.report.pictures import exposures, first_pictures, material_tags, photo_row, strip, surface_rows
from factorlib.report.viewer import viewer_data
from factorlib.results.exchange import with_exchange
from factorlib.stage import Inputs, Progress
from factorlib.wholefile import write_bytes, write_text


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Empty parameters: the page shows all results."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Write the page and its figures."""
    inputs = with_exchange(inputs)
    run = Artifacts(inputs.folders, msgspec.convert(inputs.facts["dataset.set"], SetSlice), inputs.log)
    metrics = run.metrics
    assert metrics is not None  # `evaluate` is an input of this stage
    errors = metrics.photos
    rows = []
    tags = material_tags(run)
    (out / "figures" / "photos").mkdir(parents=True)
    total = len(run.set.photos) + 4
    counter = count()
    for name in run.set.photos:
        progress(next(counter), total, name)
        rows.append(photo_row(run, name, tags, errors.get(name)))
        write_bytes(out / "figures" / "photos" / f"{name}.png", strip(rows[-1]))
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    objects = msgspec.convert(inputs.facts["dataset.objects"], dict[str, ObjectsSlice])
    progress(next(counter), total, "viewer")
    viewer = viewer_data(run, lights, objects, exposures(run))
    progress(next(counter), total, "surfaces")
    moved = surface_rows(run, objects)
    progress(next(counter), total, "first pictures")
    first = first_pictures(run, rows, SolvedSet(inputs))
    progress(next(counter), total, "page")
    write_text(out / "index.html", page(run, rows, tags, viewer, moved, first))
