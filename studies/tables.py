"""All studies as tables: `python -m studies.tables [--quick] [--docs]`; --docs refreshes docs/studies.md.

Runs whatever of the studies must run first, so that every number is of the sources that are here.  `benchmarks.stale` names the tables
of the page that are of others.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer

import studies.steps.conclude
import studies.steps.observe
import studies.steps.score
import studies.steps.solve
import studies.steps.worlds  # noqa: F401  (what is measured, so that the tables' stamps have its sources)
from benchmarks.markdown import refresh, table
from factorlib.jsonfile import read_json
from studies.catalogue import STUDIES
from studies.core.measures import MEASURES
from studies.core.study import FULL, QUICK
from studies.core.table import Conclusion
from studies.report.page import number
from studies.report.tables import answer_to_the_paper
from studies.run.project import studies as project_of
from studies.run.verbs import make

DOCS = Path(__file__).resolve().parents[1] / "docs" / "studies.md"
SHOWN = 4  # measures of a study


def as_tables(found: list[Conclusion]) -> dict[str, str]:
    """The table of conclusions, and of each study its first measures; a quick one says in its head that it is."""
    rows = [[f"[{c.title}](#{c.title.lower().replace(' ', '-')})", c.paper, answer_to_the_paper(c)] for c in found]
    return {"conclusions": table(["study", "the paper", "here"], rows)} | {c.study: _numbers(c) for c in found}


def _numbers(found: Conclusion) -> str:
    measures = found.measures[:SHOWN]
    head = [f"{found.varied} ({found.label})" if found.label else found.varied, *(MEASURES[m].label for m in measures)]
    rows = [[row.label, *(number(row.cells.get(m)) for m in measures)] for row in found.rows]
    sentences = "\n".join(f"- {tested.sentence}" for tested in found.claims)
    return f"{table(head, rows)}\n\n{sentences}" if not found.label else table(head, rows)


def main(
    quick: Annotated[bool, typer.Option(help="of the quick studies")] = False,
    docs: Annotated[bool, typer.Option(help="also refresh the tables in docs/studies.md")] = False,
) -> None:
    """Run, read, print."""
    project = project_of(QUICK if quick else FULL)
    if make(project, list(STUDIES)) != 0:
        raise SystemExit(1)
    found = [msgspec.convert(read_json(project.build / name / "table.json"), Conclusion, str_keys=True) for name in STUDIES]
    tables = as_tables(found)
    print("\n\n".join(tables.values()))
    if docs:
        refresh(DOCS, tables, "studies.tables")


if __name__ == "__main__":
    typer.run(main)
