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
from studies.study import FULL, Scale, Score, Study, case_name

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


def refresh_docs(names: Sequence[str]) -> None:
    """Write the tables of full studies, and that of all answers to the paper, into docs/studies.md."""
    done, text = done_of(studies(FULL)), DOCS.read_text(encoding="utf-8")
    parts = {name: numbers(done[name]) for name in names if name in done}
    refresh(DOCS, {"conclusions": against_the_paper({name: c.answer for name, c in done.items()}, text)} | parts)


def against_the_paper(answers: Mapping[str, str], text: str = "") -> str:
    """The table of the answers of all studies; of those that are not here, what the page's text has."""
    rows = []
    for name, study in STUDIES.items():
        title = f"[{study.title}](#{study.title.lower().replace(' ', '-')})"
        line = re.search(rf"^\| {re.escape(title)} \|.* \| (.*) \|$", text, re.MULTILINE)
        rows.append([title, study.paper, answers.get(name, line[1] if line else "not run")])
    return table(["study", "the paper", "here"], rows)


def numbers(c: Conclusion) -> str:
    """The first measures of a study, and its sentences."""
    measures = c.measures[:COLUMNS]
    rows = [[row.label, *(str(row.cells.get(m, "–")) for m in measures)] for row in c.rows]
    return "\n".join(
        [table([c.varied, *map(head, measures)], rows), "", *(f"- {sentence}" for sentence in c.sentences)]
    )
