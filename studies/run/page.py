"""Pages of studies: paragraph.md and tables of each, index.md of all, and the tables of docs/studies.md."""

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from factorlib.jsonfile import json_text, read_json
from factorlib.runner.project import LIBRARY, Project
from factorlib.wholefile import replace_file
from studies.conclusion import Conclusion, concluded, csv_text, head, paragraph
from studies.measured.tools import refresh, table
from studies.run import STUDIES, studies
from studies.study import FULL, Scale, Score, Study, case_name

DOCS = LIBRARY / "docs" / "studies.md"
COLUMNS = 4  # measures of a study that the documentation has
HEADS = {"agrees": "Shown", "disagrees": "The opposite is shown", "no difference is shown": "No difference is shown"}
FINISHED = ("table.csv", "table.json", "paragraph.md")


def conclude(study: Study, scale: Scale, scores: Path, home: Path) -> None:
    """Write what a study comes to into the folder `home`: table.json and .csv, paragraph.md and pictures/.

    scores: the folder of its last step, with scores.json, and <case>.png of some cases
    """
    result = concluded(study, scale, msgspec.convert(read_json(scores / "scores.json"), dict[str, Score]))
    cases = {
        case_name(s.name, n): f"{s.label}, {study.over.removesuffix('s')} {n}"
        for s in study.settings(scale)
        for n in study.numbers(scale)
    }
    pictures = {f"{case}.png": caption for case, caption in cases.items() if (scores / f"{case}.png").is_file()}
    shown = [f"![{caption}](pictures/{file})\n" for file, caption in pictures.items()]
    page = "\n".join([paragraph(result), numbers(result, len(result.measures)), "", *shown])
    texts = (csv_text(result), json_text(result), page)
    for file, words in zip(FINISHED, texts, strict=True):
        replace_file(home / file, words.encode())
    shutil.rmtree(home / "pictures", ignore_errors=True)
    for name in pictures:
        (home / "pictures").mkdir(exist_ok=True)
        shutil.copy(scores / name, home / "pictures")


def write_page(project: Project) -> Path:
    """Write index.md, a table of all studies of this scale that are done; returns its path."""
    done = done_of(project)
    rows = [[f"[{c.title}]({name}/paragraph.md)", c.paper, c.answer] for name, c in done.items()]
    text = "# Studies\n\n" + table(["study", "the paper", "here"], rows) + "\n"
    replace_file(project.build / "index.md", text.encode())
    return project.build / "index.md"


def done_of(project: Project) -> dict[str, Conclusion]:
    """Read the conclusions of studies, by name; one that another version of the project wrote otherwise is left out."""
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
    """Write tables and answers of full studies, and the table of all answers to the paper, into docs/studies.md."""
    done = done_of(studies(FULL))
    text = DOCS.read_text(encoding="utf-8")
    parts = {name: f"{numbers(done[name], COLUMNS)}\n\n{claims(done[name])}" for name in names if name in done}
    refresh(DOCS, {"conclusions": against_the_paper({name: c.answer for name, c in done.items()}, text)} | parts)


def against_the_paper(answers: Mapping[str, str], text: str = "") -> str:
    """Return the table of the answers of all studies; of those that are not here, what the page's text has."""
    rows = []
    for name, study in STUDIES.items():
        title = f"[{study.title}](#{study.title.lower().replace(' ', '-')})"
        line = re.search(rf"^\| {re.escape(title)} \|.* \| (.*) \|$", text, re.MULTILINE)
        rows.append([title, study.paper, answers.get(name, line[1] if line else "not run")])
    return table(["study", "the paper", "here"], rows)


def claims(c: Conclusion) -> str:
    """Return a line for each answer that seeds give, with the claims that they answer so."""
    words: dict[str, list[str]] = {}
    for claim in c.claims:
        words.setdefault(HEADS.get(claim.answer, claim.answer), []).append(claim.sentence.partition(": ")[0])
    return "\n".join(f"- **{head}**: {'; '.join(these)}." for head, these in words.items())


def numbers(c: Conclusion, most: int) -> str:
    """Return a table of the first measures of a study, at most so many."""
    rows = [[row.label, *(str(row.cells.get(m, "–")) for m in c.measures[:most])] for row in c.rows]
    return table([c.varied, *map(head, c.measures[:most])], rows)
