"""Studies as tables: `python -m studies.tables [study …] [--quick] [--docs]`; --docs refreshes docs/studies.md.

Runs whatever of the studies must run first, so that every number is of the sources that are here.  What the page has of a full study stays until there is a full one to replace it: a quick one says less.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from benchmarks.tools import refresh, table
from factorlib.jsonfile import read_json
from studies.catalogue.contents import STUDIES
from studies.core.study import FULL, QUICK, Study
from studies.core.table import Conclusion
from studies.report.heads import with_unit
from studies.report.page import number
from studies.report.tables import answer_to_the_paper
from studies.report.tables import sentences as said
from studies.run.project import Studies
from studies.run.project import studies as project_of
from studies.run.verbs import make

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs" / "studies.md"
STEPS = ROOT / "studies" / "steps"
SHOWN = 4  # measures of a study


def against_the_paper(found: dict[str, Conclusion], page: str = "") -> str:
    """The table of conclusions of all studies, those that were not run among them.

    page: the text of the page, whose answer stays where `found` has none, or a quick study's and the page a full one's
    """
    rows = []
    for name, study in STUDIES.items():
        title = f"[{study.title}](#{study.title.lower().replace(' ', '-')})"
        new = name in found and (_full(found[name]) or not is_full(page, name))
        rows.append(
            [title, study.paper, answer_to_the_paper(found[name]) if new else _answer_on(page, title) or "not run"]
        )
    return table(["study", "the paper", "here"], rows)


def part_of(page: str, name: str) -> str:
    """What the page has between the marks of `name`; nothing where there are none.

    >>> part_of("<!-- begin a -->\\nten\\n<!-- end a -->", "a")
    'ten\\n'
    """
    found = re.search(rf"<!-- begin {re.escape(name)} -->\n(.*?)<!-- end {re.escape(name)} -->", page, re.DOTALL)
    return found[1] if found else ""


def is_full(page: str, name: str) -> bool:
    """Whether the page has a full study's table of that name."""
    inner = part_of(page, name)
    return "|" in inner and "(quick" not in inner


def _answer_on(page: str, title: str) -> str | None:
    rows = [line.split(" | ") for line in part_of(page, "conclusions").splitlines()]
    return next((row[-1].removesuffix(" |") for row in rows if row[0] == f"| {title}"), None)


def _full(found: Conclusion) -> bool:
    return not found.label


def numbers(found: Conclusion) -> str:
    """The first measures of a study, and its claims; a quick one says in its head that it is."""
    measures = found.measures[:SHOWN]
    head = [f"{found.varied} ({found.label})" if found.label else found.varied, *(with_unit(m) for m in measures)]
    rows = [[row.label, *(number(row.cells.get(m)) for m in measures)] for row in found.rows]
    sentences = "\n".join(f"- {sentence}" for sentence in said(found))
    return f"{table(head, rows)}\n\n{sentences}" if not found.label else table(head, rows)


def conclusions(project: Studies) -> dict[str, Conclusion]:
    """Those of the studies of this scale that were run."""
    files = {name: project.build / name / "table.json" for name in STUDIES}
    return {
        name: msgspec.convert(read_json(file), Conclusion, str_keys=True)
        for name, file in files.items()
        if file.is_file()
    }


def measuring(study: Study) -> list[str]:
    """The modules whose sources decide a study's numbers."""
    steps = sorted(file.stem for file in (STEPS / study.kind).glob("*.py") if file.stem not in ("__init__", "conclude"))
    settings = next(module for module in _modules() if module.rpartition(".")[2] == study.name.replace("-", "_"))
    return [settings, *(f"studies.steps.{study.kind}.{step}" for step in steps), "studies.report.conclusion"]


def _modules() -> list[str]:
    return [f"studies.catalogue.{file.stem}" for file in sorted((ROOT / "studies" / "catalogue").glob("*.py"))]


def main(
    names: Annotated[list[str] | None, typer.Argument(help="studies; all without it")] = None,
    quick: Annotated[bool, typer.Option(help="of the quick studies")] = False,
    docs: Annotated[bool, typer.Option(help="also refresh the tables in docs/studies.md")] = False,
) -> None:
    """Run, read, print.  The table of conclusions has a full study's where there is one, else a quick one's."""
    project = project_of(QUICK if quick else FULL)
    if make(project, names or list(STUDIES)) != 0:
        raise SystemExit(1)
    found = conclusions(project)
    parts = {name: numbers(found[name]) for name in names or STUDIES}
    page = DOCS.read_text(encoding="utf-8")
    everything = against_the_paper(conclusions(project_of(QUICK)) | conclusions(project_of(FULL)), page)
    print("\n\n".join([everything, *parts.values()]))
    if docs:
        refresh(DOCS, {"conclusions": everything})
        for name, part in (
            parts.items() if not quick else [(n, part) for n, part in parts.items() if not is_full(page, n)]
        ):
            refresh(DOCS, {name: part})


if __name__ == "__main__":
    typer.run(main)
