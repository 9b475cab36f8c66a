"""`python -m studies.user_study page [--quick] [--most 40]` makes the page; `… analyse FILE …` reads what participants saved.

The page is one HTML file, its pictures in it, which needs no network: two-way forced choice, the truth above, ours and the intrinsic
decomposition below.

Order      of the questions and the side of each candidate: by a generator (mulberry32) of the participant's own random seed, which is kept.
Answers    by the keys ← and →, or by clicking a picture; a question shows nothing of the methods' names.
Results    at the end, as JSON (what `analysis` reads) and as CSV (for spreadsheets), saved from the browser's memory.
Simulated  empty for a person.  Otherwise who answered: the words after #simulated= in the address, or that a program drives the browser.
"""

from __future__ import annotations

import base64
import hashlib
import sys
from pathlib import Path
from typing import Annotated

import jinja2
import msgspec
import typer

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.wholefile import write_text
from studies.conclusion import NO_CONCLUSION
from studies.run import make, studies
from studies.steps.compare import read_shots
from studies.study import FULL, QUICK, Scale, case_name
from studies.user_study import analysis

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


class Trial(msgspec.Struct, frozen=True):
    """One question: files of the truth, of ours and of the intrinsic decomposition; dssim: of the two, nothing scaled."""

    name: str
    files: tuple[Path, Path, Path]
    dssim: tuple[float, float]


def trials(scores: Path, scale: Scale, most: int) -> list[Trial]:
    """At most so many, evenly spread over seeds, materials, lights and views; scores: the folder of the comparison's last step."""
    every = []
    for seed in scale.seeds:
        ours, other = (scores / case_name(method, seed) for method in ("ours", "intrinsic"))
        errors = {shot.name: dssim for shot, dssim in read_shots(other)}
        for name, dssim in ((shot.name, dssim) for shot, dssim in read_shots(ours) if shot.kind != "novel_material"):
            files = (ours / f"{name}-truth.png", ours / f"{name}.png", other / f"{name}.png")
            every.append(Trial(f"{name}-seed{seed}", files, (dssim, errors[name])))
    count = min(most, len(every))
    return [every[(2 * k + 1) * len(every) // (2 * count)] for k in range(count)]


def digest(asked: list[Trial]) -> str:
    """Sixteen digits that name the questions: of all names and pictures."""
    whole = hashlib.sha256()
    for trial in asked:
        for part in (trial.name.encode(), *(file.read_bytes() for file in trial.files)):
            whole.update(hashlib.sha256(part).digest())
    return whole.hexdigest()[:16]


def html(asked: list[Trial], label: str = "") -> str:
    """The page; label: what stands on that of a quick study."""
    pictures = []
    for t in asked:
        data = ["data:image/png;base64," + base64.b64encode(file.read_bytes()).decode() for file in t.files]
        named = dict(zip(("reference", "ours", "other"), data, strict=True))
        pictures.append({"name": t.name, **named, "dssim": t.dssim})
    facts = json_text({"format": analysis.FORMAT, "page": digest(asked), "pictures": pictures}).replace("</", "<\\/")
    template = Path(__file__).with_name("user_study.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(template).render(data=facts, label=label, count=len(asked))


@app.command()
def page(
    quick: Annotated[bool, typer.Option("--quick", help="of the quick study's pictures")] = False,
    most: Annotated[int, typer.Option(min=1, help="questions at most")] = 40,
) -> None:
    """Make the page of pictures of the study `comparison`, which is run as far as it must."""
    scale = QUICK if quick else FULL
    if code := make(scale, ["comparison"]):
        raise typer.Exit(code)
    project = studies(scale)
    asked, home = trials(project.build / "comparison" / "compare", scale, most), project.build / "user-study"
    home.mkdir(parents=True, exist_ok=True)
    write_text(home / "index.html", html(asked, NO_CONCLUSION if quick else ""))
    print(f"  {len(asked)} questions: {project.shown(home / 'index.html')}")


@app.command()
def analyse(
    files: Annotated[list[Path], typer.Argument(help="answers-*.json, a file a participant")],
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("build/studies/user-study/analysis"),
) -> None:
    """Shares of preference, with standard errors: shares.csv, figure.svg, paragraph.md."""
    shares = analysis.analysed(analysis.read_answers(files))
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "shares.csv", analysis.csv_text(shares))
    write_text(out / "figure.svg", analysis.figure(shares))
    write_text(out / "paragraph.md", analysis.paragraph(shares))
    print(analysis.paragraph(shares), end="")
    print(f"  {out / 'shares.csv'}, {out / 'figure.svg'}")


if __name__ == "__main__":
    try:
        app(prog_name="python -m studies.user_study")
    except InputError as error:
        sys.exit(f"error: {error}")
