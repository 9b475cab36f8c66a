"""What people read of studies: index.html, which stands alone, and the tables of docs/studies.md."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import msgspec

from factorlib.jsonfile import read_json
from factorlib.runner.project import LIBRARY
from studies.conclusion import MEASURES, Conclusion
from studies.measured.tools import refresh, table
from studies.run import STUDIES, studies
from studies.study import FULL, QUICK

DOCS = LIBRARY / "docs" / "studies.md"
COLUMNS = 4  # measures of a study that the documentation has


def page(done: Sequence[tuple[Any, Path]]) -> str:
    """HTML of studies, each the value of its table.json and the folder of its figure.svg, which is this project's own and set as it is.

    A table that another version of the project wrote in another form is left out, and the page names it.
    """
    read = [(as_conclusion(value), folder) for value, folder in done]
    sections = [
        (c, (folder / "figure.svg").read_text(encoding="utf-8"), {c.pictures[file]: _data(folder, file) for file in c.pictures})
        for c, folder in read
        if c
    ]  # fmt: skip
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    template = environment.from_string(Path(__file__).with_name("index.html").read_text(encoding="utf-8"))
    others = [folder.name for c, folder in read if not c]
    quick = any(c.label for c, _, _ in sections)
    return template.render(studies=sections, others=others, quick=quick, measures=MEASURES)


def _data(folder: Path, file: str) -> str:
    return base64.b64encode((folder / "pictures" / file).read_bytes()).decode()


def as_conclusion(value: Any) -> Conclusion | None:
    """A table.json as this version writes it; None where it is of another form, or of a measure that is no longer taken."""
    try:
        read = msgspec.convert(value, Conclusion, str_keys=True)
    except msgspec.ValidationError:
        return None
    return read if set(read.measures) <= MEASURES.keys() else None


# ── docs/studies.md ──────────────────────────────────────────────────────────────────────────────────────────────────


def refresh_docs(names: Sequence[str], quick: bool) -> None:
    """Write the tables of studies, and that of all answers to the paper, into docs/studies.md.

    What the page has of a full study stays until there is a full one to replace it: a quick one says less.
    """
    done = {scale.name: _done(scale) for scale in (QUICK, FULL)}
    text, new = DOCS.read_text(encoding="utf-8"), done["quick" if quick else "full"]
    parts = {name: numbers(new[name]) for name in names if name in new and not (quick and is_full(text, name))}
    refresh(DOCS, {"conclusions": against_the_paper(done["quick"] | done["full"], text)} | parts)


def _done(scale: Any) -> dict[str, Conclusion]:
    files = {name: studies(scale).build / name / "table.json" for name in STUDIES}
    read = {name: as_conclusion(read_json(file)) for name, file in files.items() if file.is_file()}
    return {name: c for name, c in read.items() if c}


def against_the_paper(done: Mapping[str, Conclusion], text: str = "") -> str:
    """The table of the answers of all studies; where `done` has none, or a quick one and the page a full one, that of the page's text."""
    rows, before = [], [line.split(" | ") for line in part_of(text, "conclusions").splitlines()]
    for name, study in STUDIES.items():
        title = f"[{study.title}](#{study.title.lower().replace(' ', '-')})"
        answer = next((row[-1].removesuffix(" |") for row in before if row[0] == f"| {title}"), "not run")
        if name in done and not (done[name].label and is_full(text, name)):
            answer = done[name].answer
        rows.append([title, study.paper, answer])
    return table(["study", "the paper", "here"], rows)


def part_of(text: str, name: str) -> str:
    """What a page has between the marks of `name`; nothing where there are none.

    >>> part_of("<!-- begin a -->\\nten\\n<!-- end a -->", "a")
    'ten\\n'
    """
    match = re.search(rf"<!-- begin {re.escape(name)} -->\n(.*?)<!-- end {re.escape(name)} -->", text, re.DOTALL)
    return match[1] if match else ""


def is_full(text: str, name: str) -> bool:
    """Whether a page has a full study's table of that name."""
    return "|" in part_of(text, name) and "(quick" not in part_of(text, name)


def numbers(c: Conclusion) -> str:
    """The first measures of a study, and its sentences; a quick one says in its head that it is."""
    measures = c.measures[:COLUMNS]
    head = [f"{c.varied} ({c.label})" if c.label else c.varied, *(MEASURES[m].head for m in measures)]
    rows = [[row.label, *(str(row.cells.get(m, "–")) for m in measures)] for row in c.rows]
    sentences = [] if c.label else ["\n" + "\n".join(f"- {sentence}" for sentence in c.sentences)]
    return "\n".join([table(head, rows), *sentences])
