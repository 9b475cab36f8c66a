"""`python -m studies.user_study page [--quick] [--most 40]` makes the page; `… analyse FILE …` reads what participants saved."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from factorlib.errors import InputError
from factorlib.jsonfile import write_json
from factorlib.wholefile import write_text
from studies.core.study import FULL, QUICK
from studies.report.conclusion import NO_CONCLUSION
from studies.run.project import studies
from studies.run.verbs import make
from studies.user_study import analysis
from studies.user_study.answers import read_answers
from studies.user_study.page import page as html
from studies.user_study.pictures import trials

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
def page(
    quick: Annotated[bool, typer.Option("--quick", help="of the quick study's pictures")] = False,
    most: Annotated[int, typer.Option(min=1, help="questions at most")] = 40,
) -> None:
    """Make the page of pictures of the study `comparison`, which is run as far as it must."""
    project = studies(QUICK if quick else FULL, kind="baselines")
    if code := make(project, ["comparison"]):
        raise typer.Exit(code)
    found = trials(project.build / "comparison" / "score", project.scale, most)
    home = project.build / "user-study"
    home.mkdir(parents=True, exist_ok=True)
    write_text(home / "index.html", html(found, NO_CONCLUSION if quick else ""))
    print(f"  {len(found)} questions: {project.shown(home / 'index.html')}")


@app.command()
def analyse(
    files: Annotated[list[Path], typer.Argument(help="answers-*.json, a file a participant")],
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("build/studies/user-study/analysis"),
) -> None:
    """Shares of preference, with standard errors: shares.csv, analysis.json, figure.svg, paragraph.md."""
    found = analysis.analysed(read_answers(files))
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "shares.csv", analysis.csv_text(found))
    write_json(out / "analysis.json", found)
    write_text(out / "figure.svg", analysis.figure(found))
    write_text(out / "paragraph.md", analysis.paragraph(found))
    print(analysis.paragraph(found), end="")
    print(f"  {out / 'shares.csv'}, {out / 'figure.svg'}")


def main() -> None:
    """An error of the input ends the program with its message and exit code 1."""
    try:
        app(prog_name="python -m studies.user_study")
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
