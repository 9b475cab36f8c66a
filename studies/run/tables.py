"""Pages of studies: paragraph.md and table.json of each, and the tables of docs/studies.md."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from factorlib.jsonfile import json_text, read_json
from factorlib.runner.project import LIBRARY, Project
from factorlib.wholefile import replace_file
from studies.catalogue import STUDIES
from studies.conclusion import Conclusion, claims, conclude, numbers, paragraph
from studies.measured.tools import machine, markdown_table, replace_sections
from studies.run import studies
from studies.study import FULL, Scale, Score, Study

DOCS = LIBRARY / "docs" / "studies.md"
MOST_MEASURES = 4  # measures of a study in the documentation


def write_study(study: Study, scale: Scale, scores: Path, folder: Path) -> None:
    """Write the conclusion of a study into a folder, as table.json and paragraph.md; scores: scores.json."""
    table = conclude(study, scale, msgspec.convert(read_json(scores), dict[str, Score]))
    for file, text in {"table.json": json_text(table), "paragraph.md": paragraph(table)}.items():
        replace_file(folder / file, text.encode())


def conclusions(project: Project) -> dict[str, Conclusion]:
    """Read the conclusions of studies, by name; one in the format of another version is left out."""
    tables = {}
    for name in STUDIES:
        if (file := project.build / name / "table.json").is_file():
            try:
                tables[name] = msgspec.convert(read_json(file), Conclusion, str_keys=True)
            except msgspec.ValidationError:
                cure = f"make study STUDY={name} replaces it"
                print(f"{project.short_path(file)}: in the format of another version, and left out: {cure}")
    return tables


def refresh_docs(names: Sequence[str]) -> None:
    """Write tables and answers of full studies, and the table of all answers to the paper, into docs/studies.md."""
    tables = conclusions(studies(FULL))
    sections = {
        n: f"*{machine()}; `make study STUDY={n}`*\n\n{numbers(tables[n], MOST_MEASURES)}\n\n{claims(tables[n])}"
        for n in names
        if n in tables
    }
    answers = {name: table.answer for name, table in tables.items()}
    replace_sections(DOCS, {"conclusions": answers_to_paper(answers, DOCS.read_text(encoding="utf-8"))} | sections)


def answers_to_paper(answers: Mapping[str, str], text: str = "") -> str:
    """Return the table of the answers of all studies; of those without an answer, the page's text is kept."""
    rows = []
    for name, study in STUDIES.items():
        title = f"[{study.title}](#{study.title.lower().replace(' ', '-')})"
        line = re.search(rf"^\| {re.escape(title)} \|.* \| (.*) \|$", text, re.MULTILINE)
        rows.append([title, study.paper, answers.get(name, line[1] if line else "not run")])
    return markdown_table(["study", "the paper", "here"], rows)
