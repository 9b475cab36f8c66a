"""What people read of studies: a study's table, figure and paragraph, index.html, which stands alone, and the tables of docs/studies.md."""

from __future__ import annotations

import base64
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import msgspec

from factorlib.jsonfile import json_text, read_json
from factorlib.runner.project import LIBRARY, Project
from factorlib.wholefile import replace_file
from studies.conclusion import Conclusion, concluded, csv_text, head, paragraph
from studies.figures import figure
from studies.measured.tools import refresh, table
from studies.run import STUDIES, studies
from studies.study import FULL, QUICK, Scale, Score, Study, case_name

DOCS = LIBRARY / "docs" / "studies.md"
COLUMNS = 4  # measures of a study that the documentation has
FINISHED = ("figure.svg", "table.csv", "table.json", "paragraph.md")


def conclude(study: Study, scale: Scale, scores: Path, home: Path) -> None:
    """Write what a study comes to into the folder `home`: table.json and .csv, figure.svg, paragraph.md and pictures/.

    scores: the folder of its last step, with scores.json, and <case>.png of some cases
    """
    result = concluded(study, scale, msgspec.convert(read_json(scores / "scores.json"), dict[str, Score]))
    cases = {case_name(s.name, n): f"{s.label}, {study.over.removesuffix('s')} {n}" for s in study.settings(scale) for n in study.numbers(scale)}  # fmt: skip
    pictures = {f"{case}.png": caption for case, caption in cases.items() if (scores / f"{case}.png").is_file()}
    result = msgspec.structs.replace(result, pictures=pictures)
    texts = (figure(result), csv_text(result), json_text(result), paragraph(result))
    for file, words in zip(FINISHED, texts, strict=True):
        replace_file(home / file, words.encode())
    shutil.rmtree(home / "pictures", ignore_errors=True)
    for name in pictures:
        (home / "pictures").mkdir(exist_ok=True)
        shutil.copy(scores / name, home / "pictures")


def write_page(project: Project) -> Path:
    """index.html of all studies of this scale that are done; it stands alone."""
    sections = []
    for name, c in done_of(project).items():
        folder = project.build / name
        images = {c.pictures[f]: base64.b64encode((folder / "pictures" / f).read_bytes()).decode() for f in c.pictures}
        sections.append((c, (folder / "figure.svg").read_text(encoding="utf-8"), images))
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    template = environment.from_string(Path(__file__).with_name("index.html").read_text(encoding="utf-8"))
    text = template.render(studies=sections, quick=any(c.quick for c, _, _ in sections), head=head)
    replace_file(project.build / "index.html", text.encode())
    return project.build / "index.html"


def done_of(project: Project) -> dict[str, Conclusion]:
    """What studies came to, by name; a table that another version of the project wrote in another form is left out."""
    done = {}
    for name in STUDIES:
        if (file := project.build / name / "table.json").is_file():
            try:
                done[name] = msgspec.convert(read_json(file), Conclusion, str_keys=True)
            except msgspec.ValidationError:
                print(
                    f"{project.shown(file)}: of another version, and not shown: make study STUDY={name} makes it anew"
                )
    return done


# ── docs/studies.md ──────────────────────────────────────────────────────────────────────────────────────────────────


def refresh_docs(names: Sequence[str], quick: bool) -> None:
    """Write the tables of studies, and that of all answers to the paper, into docs/studies.md.

    What the page has of a full study stays until there is a full one to replace it: a quick one says less.
    """
    small, full = (done_of(studies(scale)) for scale in (QUICK, FULL))
    text, new = DOCS.read_text(encoding="utf-8"), small if quick else full
    parts = {name: numbers(new[name]) for name in names if name in new and not (quick and is_full(text, name))}
    refresh(DOCS, {"conclusions": against_the_paper(small | full, text)} | parts)


def against_the_paper(done: Mapping[str, Conclusion], text: str = "") -> str:
    """The table of the answers of all studies; where `done` has none, or a quick one and the page a full one, that of the page's text."""
    rows, before = [], [line.split(" | ") for line in part_of(text, "conclusions").splitlines()]
    for name, study in STUDIES.items():
        title = f"[{study.title}](#{study.title.lower().replace(' ', '-')})"
        answer = next((row[-1].removesuffix(" |") for row in before if row[0] == f"| {title}"), "not run")
        if name in done and not (done[name].quick and is_full(text, name)):
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
    first = f"{c.varied} ({c.quick})" if c.quick else c.varied
    rows = [[row.label, *(str(row.cells.get(m, "–")) for m in measures)] for row in c.rows]
    sentences = [] if c.quick else ["\n" + "\n".join(f"- {sentence}" for sentence in c.sentences)]
    return "\n".join([table([first, *map(head, measures)], rows), *sentences])
