"""The command line: `python -m factorlib all|<stage>|plan|why|status|graph|validate|verify|clean|gc --dataset eames`.

Read by `argparse`, for a run with nothing to do must not wait: libraries that read it take longer than all that follows.
"""

from __future__ import annotations

import argparse
import errno
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, PIPELINE, Project, photo_sets
from factorlib.runner.stop import heed_stops
from factorlib.runner.terminal import plain_streams, printable

NOT_OURS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ELOOP, errno.ENAMETOOLONG}  # what the system refuses to this user

Verb = Callable[[argparse.Namespace], int]
Option = tuple[tuple[str, ...], dict[str, object]]  # as `ArgumentParser.add_argument` takes them
VERBS: dict[str, tuple[Verb, tuple[Option, ...]]] = {}  # by name, in the order of `--help`


def _option(*names: str, **how: object) -> Option:
    return names, how


DATASET = _option("--dataset", "-d", help="its name in data/, or a path to its folder; else DATASET")
SETTINGS = _option("--set", dest="settings", action="append", metavar="X.Y=Z", help="stage.parameter=value, as in solve.lobes=64; else SET")
FORCE = _option("--force", action="store_true", help="run again, whatever the store holds; as FORCE=1")
RECIPES = _option("--recipe", dest="recipes", action="append", help="pictures to make: a path, a name in recipes/, or all; else RECIPE")
STAGES = _option("stages", nargs="*", help="stages; all without it")


def verb(name: str, *options: Option) -> Callable[[Verb], Verb]:
    """Makes a function the verb `name`, which takes these options; its docstring is its help."""

    def known(function: Verb) -> Verb:
        """Remember it."""
        VERBS[name] = function, options
        return function

    return known


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


def wish(asked: argparse.Namespace, stages: list[str] | None = None) -> verbs.Wish:
    """What is asked for, by the options, else by the environment; `stages`: those of the command line, all where there are none."""
    recipes = asked.recipes or [name for name in [os.environ.get("RECIPE")] if name]
    return verbs.Wish(named(asked.dataset), stages or None, chosen(asked.settings), forced(getattr(asked, "force", False)), recipes)


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


@verb("all", DATASET, SETTINGS, FORCE, RECIPES)
def all_(asked: argparse.Namespace) -> int:
    """Run the whole pipeline, as far as anything must run, and make the pictures of recipes that are named."""
    return verbs.make(project(), wish(asked))


@verb("stage", _option("name"), DATASET, SETTINGS, FORCE, RECIPES)
def stage(asked: argparse.Namespace) -> int:
    """Run one stage and what it needs (`python -m factorlib solve`); `render` with a recipe makes that one's pictures alone."""
    known = project()
    verbs.check_stage(known, asked.name, list(VERBS))
    return verbs.make(known, wish(asked, [asked.name]))


@verb("plan", STAGES, DATASET, SETTINGS, FORCE, RECIPES)
def plan(asked: argparse.Namespace) -> int:
    """What would run; with a recipe and no stage, for its pictures alone."""
    return verbs.show_plan(project(), wish(asked, asked.stages))


@verb("why", STAGES, DATASET, SETTINGS, FORCE, RECIPES)
def why(asked: argparse.Namespace) -> int:
    """Every reason why it would run."""
    return verbs.show_why(project(), wish(asked, asked.stages))


@verb("status", STAGES, DATASET, SETTINGS, RECIPES)
def status(asked: argparse.Namespace) -> int:
    """How far each stage is, and what the current results warned of."""
    return verbs.show_status(project(), wish(asked, asked.stages))


@verb(
    "graph",
    _option("--mermaid", action="store_true", help="as a Mermaid diagram"),
    _option("--svg", type=Path, help="file to draw to; else SVG"),
    DATASET,
    SETTINGS,
    RECIPES,
)
def graph(asked: argparse.Namespace) -> int:
    """The stages and what they take, as text or as a drawing; the drawing of a dataset has its photos, and how far each stage is."""
    svg = asked.svg or _folder_named("SVG")
    return verbs.show_graph(project(), asked.mermaid, svg, wish(asked) if svg and named_if_any(asked.dataset) else None)


@verb("logs", STAGES, DATASET, SETTINGS, RECIPES, _option("--photo", help="its name, or a recipe's; else PHOTO"))
def logs(asked: argparse.Namespace) -> int:
    """What current results cost and were made with: time, peak memory, versions, warnings (make logs STAGE=… PHOTO=…)."""
    stages = asked.stages or os.environ.get("STAGE", "").split() or None
    return verbs.show_logs(project(), wish(asked, stages), asked.photo or os.environ.get("PHOTO") or None)


@verb("params", STAGES)
def params(asked: argparse.Namespace) -> int:
    """Every parameter of stages with its default, its range and its meaning (make params STAGE=…)."""
    return verbs.show_params(project(), asked.stages or os.environ.get("STAGE", "").split() or None)


@verb("new", DATASET, *(_option(f"--{word}", type=Path, help=f"folder of {word}; else {word.upper()}") for word in ("photos", "masks", "meshes")))
def new(asked: argparse.Namespace) -> int:
    """Begin a dataset of your own: copy photos, masks and meshes to data/<name>, and write its dataset.yaml."""
    folders = [given or _folder_named(key) for given, key in ((asked.photos, "PHOTOS"), (asked.masks, "MASKS"), (asked.meshes, "MESHES"))]
    return verbs.begin(project(), named(asked.dataset), *folders)


def _folder_named(key: str) -> Path | None:
    """The folder or file that the environment names."""
    return Path(os.environ[key]).expanduser() if os.environ.get(key) else None


@verb("compare", _option("first", nargs="?", help="folder of a result, as build/eames; else A"), _option("second", nargs="?", help="another; else B"))
def compare(asked: argparse.Namespace) -> int:
    """A page that shows two results side by side: what differs in parameters, numbers, materials, lights and re-syntheses."""
    folders = [given or os.environ.get(key) for given, key in ((asked.first, "A"), (asked.second, "B"))]
    if not all(folders):
        raise InputError("two results are to be named", key="compare", cure="make compare A=build/eames B=<another>")
    return verbs.compare(project(), *map(Path, folders))


@verb("validate", DATASET, SETTINGS, _option("--sheet", action="store_true", help="as SHEET=1"))
def validate(asked: argparse.Namespace) -> int:
    """Check pipeline.yaml, settings and dataset without running anything; with a sheet, draw photos, labels and meshes side by side."""
    return verbs.validate(project(), named(asked.dataset), chosen(asked.settings), switched_on("SHEET", asked.sheet))


@verb("verify", DATASET)
def verify(asked: argparse.Namespace) -> int:
    """Read every kept result, of a dataset or of all, and name what is damaged."""
    return verbs.verify(project(), named_if_any(asked.dataset))


@verb("clean", DATASET)
def clean(asked: argparse.Namespace) -> int:
    """Forget a dataset's results, or, where neither --dataset nor DATASET is given, those of all."""
    return verbs.clean(project(), named_if_any(asked.dataset))


@verb("gc", _option("--force", action="store_true", help="without asking; as FORCE=1"))
def gc(asked: argparse.Namespace) -> int:
    """Show which results in the store are current for no dataset, and delete them; a terminal is asked first, but for --force."""
    return verbs.collect(project(), lambda: agreed(asked.force))


def agreed(force: bool) -> bool:
    """Whether to delete what was shown: a terminal is asked, but for --force or FORCE=1."""
    return forced(force) or not sys.stdin.isatty() or input("delete them? [y/N] ").strip().lower() in ("y", "yes")


def _cores(word: str) -> int:
    if not word.isdigit() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"{word!r} is no number of cores: a whole number from 1")
    return int(word)


@verb(
    "worker",
    _option("scheduler", help="its address, as tcp://10.0.0.1:8786"),
    _option("--cores", type=_cores, help="that it computes on; default: all of this machine"),
)
def worker(asked: argparse.Namespace) -> int:
    """Work for the Dask cluster of a scheduler, until it ends; further options are those of `dask worker` (docs/distributed.md)."""
    from factorlib.runner.cluster import start_worker

    start_worker(asked.scheduler, asked.cores, asked.further)
    return 0


@verb("ship", _option("stage"), DATASET)
def ship(asked: argparse.Namespace) -> int:
    """Put a stage's current result into the package (for those who change the stage)."""
    return verbs.ship(project(), asked.stage, named(asked.dataset))


# ── reading the command line ─────────────────────────────────────────────────────────────────────────────────────────


def parser(program: str) -> argparse.ArgumentParser:
    """Reads the words of every verb; `run` in what it returns is the verb's function."""
    whole = argparse.ArgumentParser(program, description="Any other word is the name of a stage: it is run, and what it needs.")
    add = whole.add_subparsers(title="verbs", metavar="verb", required=True).add_parser
    for name, (function, options) in VERBS.items():
        one = add(name, help=function.__doc__, description=function.__doc__, allow_abbrev=False)
        one.set_defaults(run=function)
        for names, how in options:
            one.add_argument(*names, **how)
    return whole


def run(words: list[str], program: str) -> int:
    """What the verb of the command line returns.  A first word that is neither an option nor a verb is read as `stage <word>`."""
    if words and not words[0].startswith("-") and words[0] not in VERBS:
        words = ["stage", *words]
    known = parser(program)
    asked, further = known.parse_known_args(words or ["--help"])
    if further and asked.run is not worker:
        known.error(f"unrecognized arguments: {' '.join(further)}")
    asked.further = further
    return asked.run(asked)


def main() -> NoReturn:
    """Run the verb of the command line; an error of the input ends the program with its message and exit code 1."""
    sys.stdout.reconfigure(errors="backslashreplace")  # names of files may be anything
    try:
        with plain_streams(), heed_stops():
            logging.basicConfig(format="warning: %(message)s", level=logging.WARNING)
            sys.exit(run(sys.argv[1:], "factorlib" if Path(sys.argv[0]).name == "factorlib" else "python -m factorlib"))
    except InputError as error:
        sys.exit(printable(f"error: {error}"))
    except BrokenPipeError:  # whoever reads has enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that the flush at exit says nothing
        sys.exit(1)
    except OSError as error:
        _stop_at(error)


def _stop_at(error: OSError) -> NoReturn:
    """End with the system's word where a user can mend it; whatever else is a defect."""
    from factorlib.disk import disk_error

    known = disk_error(error, project().build)
    if known is None and error.errno in NOT_OURS:
        cure = "check that the folder is there, and that you may read it and write to it"
        known = InputError(error.strerror, file=error.filename, cure=cure)
    if known is None:
        raise error
    sys.exit(printable(f"error: {known}"))


if __name__ == "__main__":
    main()
