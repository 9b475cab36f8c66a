"""Real photo sets, which the project does not carry: `python -m studies.real ../shared/real/liberty [--docs]`.

There is no truth of photographs: all that can be said is how well the answer gives back the photos it was solved from.  So DSSIM and
PSNR of the re-synthesis stand beside that of flat colours, each material of each photo in its own mean colour, which nothing solved knows of.

The pipeline runs first, as `make evaluate` does, as far as anything must run.  A folder that is not there is said to be absent, and
leaves docs/studies.md as it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from factorlib.results.metrics import Metrics, read_metrics
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets
from studies.measured.tools import exact, refresh, table

DOCS, PLACE = LIBRARY / "docs" / "studies.md", "real sets"
PSNR, FLAT = "PSNR, tone-mapped, of the re-synthesis (dB)", "of flat colours"
HEAD = ["set: photo", "DSSIM of the re-synthesis", FLAT, PSNR, FLAT]


def rows_of(name: str, metrics: Metrics) -> list[list[str]]:
    """A row for each photo, and the mean: DSSIM and PSNR of the re-synthesis, each beside that of flat colours."""
    scored = {photo: errors.gauges["none"] for photo, errors in metrics.resynthesis.photos.items() if errors.gauges}
    scored |= {"mean": metrics.resynthesis.mean["none"]} if metrics.resynthesis.mean else {}
    both = {photo: (errors.estimate, errors.null) for photo, errors in scored.items()}
    return [
        [f"{name}: {photo}", *(exact(e.dssim, 3) for e in of), *(f"{e.psnr_tonemapped_db:.1f}" for e in of)]
        for photo, of in both.items()
    ]


def measured(folder: Path) -> Metrics:
    """Run the pipeline up to `evaluate` on the data set in `folder`."""
    project = Project(LIBRARY, photo_sets())
    if verbs.make(project, verbs.Wish(str(folder.resolve()), targets=["evaluate"])) != 0:
        raise SystemExit(1)
    return read_metrics(project.build / folder.resolve().name / "evaluate" / "metrics.json")


def main(
    folders: Annotated[list[Path], typer.Argument(help="data sets of photographs, by path")],
    docs: Annotated[bool, typer.Option(help="also refresh the table in docs/studies.md")] = False,
) -> None:
    """Run, read, print."""
    present = [folder for folder in folders if (folder / "dataset.yaml").is_file()]
    for folder in (folder for folder in folders if folder not in present):
        print(f"{folder}: absent: nothing is measured of it")
    rows = [row for folder in present for row in rows_of(folder.resolve().name, measured(folder))]
    if rows:
        print(table(HEAD, rows))
        if docs:
            refresh(DOCS, {PLACE: table(HEAD, rows)})


if __name__ == "__main__":
    typer.run(main)
