"""The command line: `python -m factorlib all|<stage>|plan|why|status|graph|validate|verify|clean|gc --dataset eames`."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from factorlib.disk import disk_error
from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets


class Verbs(typer.core.TyperGroup):
    """A word that is no verb is the name of a stage."""

    def resolve_command(self, ctx, args):
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            args = ["stage", *args]
        return super().resolve_command(ctx, args)


app = typer.Typer(cls=Verbs, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

Dataset = Annotated[str, typer.Option("--dataset", "-d", envvar="DATASET", help="its name in data/, or a path to its folder")]
MaybeDataset = Annotated[str | None, typer.Option("--dataset", "-d", help="its name in data/, or a path; all of build/ without it")]
Settings = Annotated[list[str] | None, typer.Option("--set", help="stage.parameter=value, as in solve.lobes=64")]
Force = Annotated[bool, typer.Option("--force", help="run again, whatever the store holds")]
Stages = Annotated[list[str] | None, typer.Argument(help="stages; all without it")]


def project() -> Project:
    """The checkout this package lies in, or the one that FACTORLIB_ROOT names."""
    return Project(Path(os.environ.get("FACTORLIB_ROOT", LIBRARY)).resolve(), photo_sets())


@app.command("all")
def all_(dataset: Dataset, settings: Settings = None, force: Force = False) -> None:
    """Run the whole pipeline, as far as anything must run."""
    raise typer.Exit(verbs.make(project(), dataset, None, settings or [], force))


@app.command()
def stage(name: str, dataset: Dataset, settings: Settings = None, force: Force = False) -> None:
    """Run one stage and what it needs (`python -m factorlib solve`)."""
    known = project()
    known_verbs = [command.name or command.callback.__name__ for command in app.registered_commands]
    raise typer.Exit(verbs.make_stage(known, name, known_verbs, dataset, settings or [], force))


@app.command()
def plan(dataset: Dataset, stages: Stages = None, settings: Settings = None, force: Force = False) -> None:
    """What would run."""
    raise typer.Exit(verbs.show_plan(project(), dataset, stages or None, settings or [], force))


@app.command()
def why(dataset: Dataset, stages: Stages = None, settings: Settings = None, force: Force = False) -> None:
    """Every reason why it would run."""
    raise typer.Exit(verbs.show_why(project(), dataset, stages or None, settings or [], force))


@app.command()
def status(dataset: Dataset, stages: Stages = None, settings: Settings = None) -> None:
    """How far each stage is, and what the current results warned of."""
    raise typer.Exit(verbs.show_status(project(), dataset, stages or None, settings or []))


@app.command()
def graph(mermaid: Annotated[bool, typer.Option("--mermaid", help="as a Mermaid diagram")] = False) -> None:
    """The stages and what they take."""
    raise typer.Exit(verbs.show_graph(project(), mermaid))


@app.command()
def validate(dataset: Dataset, settings: Settings = None) -> None:
    """Check pipeline.yaml, settings and dataset without running anything."""
    raise typer.Exit(verbs.validate(project(), dataset, settings or []))


@app.command()
def verify(dataset: MaybeDataset = None) -> None:
    """Read every kept result and name what is damaged."""
    raise typer.Exit(verbs.verify(project(), dataset))


@app.command()
def clean(dataset: MaybeDataset = None) -> None:
    """Delete a dataset's results, or all of build/."""
    raise typer.Exit(verbs.clean(project(), dataset))


@app.command()
def gc() -> None:
    """Delete results in the store that are current for no dataset."""
    raise typer.Exit(verbs.collect(project()))


@app.command()
def ship(stage: str, dataset: Dataset) -> None:
    """Put a stage's current result into the package (for those who change the stage)."""
    raise typer.Exit(verbs.ship(project(), stage, dataset))


def main() -> None:
    logging.basicConfig(format="warning: %(message)s", level=logging.WARNING)
    try:
        app(prog_name="python -m factorlib")
    except InputError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        known = disk_error(error, project().build)
        if known is None:
            raise
        sys.exit(f"error: {known}")


if __name__ == "__main__":
    main()
