"""The command line: `python -m factorlib all|<stage>|plan|why|status|graph|validate|verify|clean|gc --dataset eames`."""

from __future__ import annotations

import errno
import logging
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from factorlib.disk import disk_error
from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, PIPELINE, Project, photo_sets
from factorlib.runner.stop import heed_stops


class Verbs(typer.core.TyperGroup):
    """A word that is no verb is the name of a stage."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Read a first word that is neither an option nor a verb as `stage <word>`."""
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            args = ["stage", *args]
        return super().resolve_command(ctx, args)


NOT_OURS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ELOOP, errno.ENAMETOOLONG}  # what the system refuses to this user

app = typer.Typer(cls=Verbs, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

Dataset = Annotated[str | None, typer.Option("--dataset", "-d", help="its name in data/, or a path to its folder; else DATASET")]
Settings = Annotated[list[str] | None, typer.Option("--set", help="stage.parameter=value, as in solve.lobes=64; else SET")]
Force = Annotated[bool, typer.Option("--force", help="run again, whatever the store holds; as FORCE=1")]
Recipes = Annotated[list[str] | None, typer.Option("--recipe", help="pictures to make: a path, a name in recipes/, or all; else RECIPE")]
Stages = Annotated[list[str] | None, typer.Argument(help="stages; all without it")]


def project() -> Project:
    """The checkout that FACTORLIB_ROOT names, or this package lies in, or, where it is installed, the current folder lies in."""
    return Project(Path(os.environ.get("FACTORLIB_ROOT") or _checkout()).resolve(), photo_sets())


def _checkout() -> Path:
    here = Path.cwd()
    for folder in (LIBRARY, here, *here.parents):
        if (folder / PIPELINE).is_file():
            return folder
    cure = f"run it in a checkout, or name one: FACTORLIB_ROOT=<a folder with {PIPELINE}, stages and data>"
    raise InputError(f"neither this folder nor one above it has a {PIPELINE}", file=here, cure=cure)


# ── what the environment says where the command line does not: make passes it on so, untouched by any shell ──────────


def named(dataset: str | None) -> str:
    """The dataset, by its name or path; whether it may be called so is the project's affair."""
    if (dataset := named_if_any(dataset)) is None:
        raise InputError("no dataset is named", key="DATASET", cure="add DATASET=<a name in data/, or a path to a folder>")
    return dataset


def named_if_any(dataset: str | None) -> str | None:
    """The data set's name or path: the option's, else the environment's DATASET, else None."""
    return os.environ.get("DATASET") if dataset is None else dataset


def chosen(settings: list[str] | None) -> list[str]:
    """Parameters `stage.name=value` as they were written: the options', else the environment's SET."""
    return settings or [os.environ.get("SET", "")]


def wish(
    dataset: str | None, stages: list[str] | None, settings: list[str] | None, recipes: list[str] | None, force: bool = False
) -> verbs.Wish:
    """What is asked for, by the options, else by the environment."""
    return verbs.Wish(named(dataset), stages or None, chosen(settings), forced(force), recipes or [name for name in [os.environ.get("RECIPE")] if name])


def forced(force: bool) -> bool:
    """Whether to run again what is current: --force or FORCE=1."""
    return switched_on("FORCE", force)


def switched_on(key: str, option: bool) -> bool:
    """Whether an option, or the environment's `key`, is on.  InputError where the latter is neither 0, 1 nor empty."""
    word = os.environ.get(key, "")
    if not option and word not in ("", "0", "1"):
        raise InputError(f"{word!r} is neither 1 nor 0", key=key, cure=f"write {key}=1, or leave it out")
    return option or word == "1"


# ── verbs ────────────────────────────────────────────────────────────────────────────────────────────────────────────


@app.command("all")
def all_(dataset: Dataset = None, settings: Settings = None, force: Force = False, recipe: Recipes = None) -> None:
    """Run the whole pipeline, as far as anything must run, and make the pictures of recipes that are named."""
    raise typer.Exit(verbs.make(project(), wish(dataset, None, settings, recipe, force)))


@app.command()
def stage(name: str, dataset: Dataset = None, settings: Settings = None, force: Force = False, recipe: Recipes = None) -> None:
    """Run one stage and what it needs (`python -m factorlib solve`); `render` with a recipe makes that one's pictures alone."""
    known = project()
    verbs.check_stage(known, name, [command.name or command.callback.__name__ for command in app.registered_commands])
    raise typer.Exit(verbs.make(known, wish(dataset, [name], settings, recipe, force)))


@app.command()
def plan(
    stages: Stages = None, dataset: Dataset = None, settings: Settings = None, force: Force = False, recipe: Recipes = None
) -> None:
    """What would run; with a recipe and no stage, for its pictures alone."""
    raise typer.Exit(verbs.show_plan(project(), wish(dataset, stages, settings, recipe, force)))


@app.command()
def why(stages: Stages = None, dataset: Dataset = None, settings: Settings = None, force: Force = False, recipe: Recipes = None) -> None:
    """Every reason why it would run."""
    raise typer.Exit(verbs.show_why(project(), wish(dataset, stages, settings, recipe, force)))


@app.command()
def status(stages: Stages = None, dataset: Dataset = None, settings: Settings = None, recipe: Recipes = None) -> None:
    """How far each stage is, and what the current results warned of."""
    raise typer.Exit(verbs.show_status(project(), wish(dataset, stages, settings, recipe)))


@app.command()
def graph(mermaid: Annotated[bool, typer.Option("--mermaid", help="as a Mermaid diagram")] = False) -> None:
    """The stages and what they take."""
    raise typer.Exit(verbs.show_graph(project(), mermaid))


@app.command()
def params(stages: Stages = None) -> None:
    """Every parameter of stages with its default, its range and its meaning (make params STAGE=…)."""
    raise typer.Exit(verbs.show_params(project(), stages or os.environ.get("STAGE", "").split() or None))


@app.command()
def new(
    dataset: Dataset = None,
    photos: Annotated[Path | None, typer.Option(help="folder of photos; else PHOTOS")] = None,
    masks: Annotated[Path | None, typer.Option(help="folder of masks; else MASKS")] = None,
    meshes: Annotated[Path | None, typer.Option(help="folder of meshes; else MESHES")] = None,
) -> None:
    """Begin a dataset of your own: copy photos, masks and meshes to data/<name>, and write its dataset.yaml."""
    folders = [given or _folder_named(key) for given, key in ((photos, "PHOTOS"), (masks, "MASKS"), (meshes, "MESHES"))]
    raise typer.Exit(verbs.begin(project(), named(dataset), *folders))


def _folder_named(key: str) -> Path | None:
    """The folder that the environment names."""
    return Path(os.environ[key]).expanduser() if os.environ.get(key) else None


@app.command()
def compare(
    first: Annotated[str | None, typer.Argument(help="folder of a result, as build/eames; else A")] = None,
    second: Annotated[str | None, typer.Argument(help="another; else B")] = None,
) -> None:
    """A page that shows two results side by side: what differs in parameters, numbers, materials, lights and re-syntheses."""
    folders = [given or os.environ.get(key) for given, key in ((first, "A"), (second, "B"))]
    if not all(folders):
        raise InputError("two results are to be named", key="compare", cure="make compare A=build/eames B=<another>")
    raise typer.Exit(verbs.compare(project(), *map(Path, folders)))


@app.command()
def validate(
    dataset: Dataset = None, settings: Settings = None, sheet: Annotated[bool, typer.Option("--sheet", help="as SHEET=1")] = False
) -> None:
    """Check pipeline.yaml, settings and dataset without running anything; with a sheet, draw photos, labels and meshes side by side."""
    raise typer.Exit(verbs.validate(project(), named(dataset), chosen(settings), switched_on("SHEET", sheet)))


@app.command()
def verify(dataset: Dataset = None) -> None:
    """Read every kept result, of a dataset or of all, and name what is damaged."""
    raise typer.Exit(verbs.verify(project(), named_if_any(dataset)))


@app.command()
def clean(dataset: Dataset = None) -> None:
    """Forget a dataset's results, or, where neither --dataset nor DATASET is given, those of all."""
    raise typer.Exit(verbs.clean(project(), named_if_any(dataset)))


@app.command()
def gc(force: Annotated[bool, typer.Option("--force", help="without asking; as FORCE=1")] = False) -> None:
    """Show which results in the store are current for no dataset, and delete them; a terminal is asked first, but for --force."""
    ask = sys.stdin.isatty() and not switched_on("FORCE", force)
    raise typer.Exit(verbs.collect(project(), lambda: not ask or typer.confirm("delete them?")))


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def worker(
    context: typer.Context,
    scheduler: Annotated[str, typer.Argument(help="its address, as tcp://10.0.0.1:8786")],
    cores: Annotated[int | None, typer.Option(min=1, help="that it computes on; default: all of this machine")] = None,
) -> None:
    """Work for the Dask cluster of a scheduler, until it ends; further options are those of `dask worker` (docs/distributed.md)."""
    from factorlib.runner.cluster import start_worker

    start_worker(scheduler, cores, context.args)


@app.command()
def ship(stage: str, dataset: Dataset = None) -> None:
    """Put a stage's current result into the package (for those who change the stage)."""
    raise typer.Exit(verbs.ship(project(), stage, named(dataset)))


def main() -> None:
    """Run the verb of the command line; an error of the input ends the program with its message and exit code 1."""
    logging.basicConfig(format="warning: %(message)s", level=logging.WARNING)
    sys.stdout.reconfigure(errors="backslashreplace")  # names of files may be anything
    try:
        with heed_stops():
            app(prog_name="factorlib" if Path(sys.argv[0]).name == "factorlib" else "python -m factorlib")
    except InputError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        known = disk_error(error, project().build)
        if known is None and error.errno in NOT_OURS:
            cure = "check that the folder is there, and that you may read it and write to it"
            known = InputError(error.strerror, file=error.filename, cure=cure)
        if known is None:
            raise
        sys.exit(f"error: {known}")


if __name__ == "__main__":
    main()
