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

from benchmarks.tools import exact, refresh, table
from factorlib.results.metrics import Metrics, ScoredPicture, read_metrics
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets

DOCS = LIBRARY / "docs" / "studies.md"
PLACE = "real sets"


def rows_of(name: str, found: Metrics) -> list[list[str]]:
    """A row for each photo, and the mean: DSSIM and PSNR of the re-synthesis, each beside that of flat colours."""
    shots = [(photo, errors.gauges["none"]) for photo, errors in found.resynthesis.photos.items() if errors.gauges]
    mean = found.resynthesis.mean
    return [_row(f"{name}: {of}", scores) for of, scores in shots + ([("mean", mean["none"])] if mean else [])]


def _row(label: str, scores: ScoredPicture) -> list[str]:
    both = (scores.estimate, scores.null)
    return [label, *(exact(of.dssim, 3) for of in both), *(f"{of.psnr_tonemapped_db:.1f}" for of in both)]


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
    absent = [folder for folder in folders if not (folder / "dataset.yaml").is_file()]
    for folder in absent:
        print(f"{folder}: absent: nothing is measured of it")
    rows = [
        row for folder in folders if folder not in absent for row in rows_of(folder.resolve().name, measured(folder))
    ]
    if not rows:
        return
    found = table(
        [
            "set: photo",
            "DSSIM of the re-synthesis",
            "of flat colours",
            "PSNR, tone-mapped, of the re-synthesis (dB)",
            "of flat colours",
        ],
        rows,
    )
    print(found)
    if docs:
        refresh(DOCS, {PLACE: found})


if __name__ == "__main__":
    typer.run(main)
