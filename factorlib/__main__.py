"""The command line: `python -m factorlib all|<stage>|plan|why|status|graph|validate|verify|clean|gc --dataset eames`.

It is read by `argparse`, for a run with nothing to do must not wait for a library that reads it more comfortably.
"""

from __future__ import annotations

import argparse
import errno
import logging
import os
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.display import plain_streams, printable
from factorlib.runner.project import LIBRARY, PIPELINE, Project, photo_sets
from factorlib.runner.stop import heed_stops

# What the system refuses to this user.
NOT_OURS = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ELOOP, errno.ENAMETOOLONG}


def project() -> Project:
    """The checkout that FACTORLIB_ROOT names, or this package lies in, or else the current folder lies in."""
    here = Path.cwd()
    near = next((folder for folder in (LIBRARY, here, *here.parents) if (folder / PIPELINE).is_file()), None)
    if not (root := os.environ.get("FACTORLIB_ROOT") or near):
        cure = f"run it in a checkout, or name one: FACTORLIB_ROOT=<a folder with {PIPELINE}, stages and data>"
        raise InputError(f"neither this folder nor one above it has a {PIPELINE}", file=here, cure=cure)
    return Project(Path(root).resolve(), photo_sets())


# ── options ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _cores(word: str) -> int:
    if not word.isdigit() or int(word) < 1:
        raise argparse.ArgumentTypeError(f"{word!r} is no number of cores: a whole number from 1")
    return int(word)


def _option(*flags: str, **more: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    return flags, more


ON, MANY, FEW = {"action": "store_true"}, {"action": "append"}, {"nargs": "*"}
OPTIONS = {  # as `ArgumentParser.add_argument` takes them
    "dataset": _option("--dataset", "-d", help="its name in data/, or a path to its folder; else DATASET"),
    "set": _option("--set", dest="settings", metavar="X.Y=Z", help="stage.parameter=value; else SET", **MANY),
    "force": _option("--force", help="whatever the store holds, or without asking; as FORCE=1", **ON),
    "recipe": _option(
        "--recipe", dest="recipes", help="pictures: a path, a name in recipes/, or all; else RECIPE", **MANY
    ),
    "stages": _option("stages", help="stages; all without it", **FEW),
    "mermaid": _option("--mermaid", help="as a Mermaid diagram", **ON),
    "photo": _option("--photo", help="its name, or a recipe's; else PHOTO"),
    "photos": _option("--photos", type=Path, help="folder; else PHOTOS"),
    "masks": _option("--masks", type=Path, help="folder; else MASKS"),
    "meshes": _option("--meshes", type=Path, help="folder; else MESHES"),
    "first": _option("first", nargs="?", help="folder of a result, as build/eames; else A"),
    "second": _option("second", nargs="?", help="another; else B"),
    "sheet": _option("--sheet", help="also draw photos, labels and meshes; as SHEET=1", **ON),
    "scheduler": _option("scheduler", help="its address, as tcp://10.0.0.1:8786"),
    "cores": _option("--cores", type=_cores, help="that it computes on; default: all of this machine"),
    "name": _option("name"),
}


# ── what the environment says where the command line does not: make passes NAME=value on so, untouched by any shell ──


def named(dataset: str | None, optional: bool = False) -> str | None:
    """The dataset's name or path: the option's, else the environment's DATASET.  InputError where it is not `optional`."""
    dataset = os.environ.get("DATASET") if dataset is None else dataset  # an empty one is not none
    if dataset is None and not optional:
        cure = "add DATASET=<a name in data/, or a path to a folder>"
        raise InputError("no dataset is named", key="DATASET", cure=cure)
    return dataset


def chosen(settings: list[str] | None) -> list[str]:
    """Parameters `stage.name=value` as they were written: the options', else the environment's SET."""
    return settings or [os.environ.get("SET", "")]


def switched_on(key: str, option: bool) -> bool:
    """Whether an option, or the environment's `key`, is on.  InputError where the latter is neither 0, 1 nor empty."""
    word = os.environ.get(key, "")
    if not option and word not in ("", "0", "1"):
        raise InputError(f"{word!r} is neither 1 nor 0", key=key, cure=f"write {key}=1, or leave it out")
    return option or word == "1"


def forced(force: bool) -> bool:
    """Whether to run again what is current: --force or FORCE=1."""
    return switched_on("FORCE", force)


def agreed(force: bool) -> bool:
    """Whether to delete what was shown: a terminal is asked, but for --force or FORCE=1."""
    return forced(force) or not sys.stdin.isatty() or input("delete them? [y/N] ").strip().lower() in ("y", "yes")


def wish(asked: Namespace, stages: list[str] | None = None) -> verbs.Wish:
    """What is asked for; without `stages` all of them."""
    recipes = asked.recipes or list(filter(None, [os.environ.get("RECIPE")]))
    force = forced(getattr(asked, "force", False))
    return verbs.Wish(named(asked.dataset), stages or None, chosen(asked.settings), force, recipes)


def _path(given: Path | None, key: str) -> Path | None:
    return given or (Path(os.environ[key]).expanduser() if os.environ.get(key) else None)


# ── verbs ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _stages(asked: Namespace) -> list[str] | None:
    return asked.stages or os.environ.get("STAGE", "").split() or None


def _stage(asked: Namespace) -> int:
    verbs.check_stage(project(), asked.name, list(VERBS))
    return verbs.make(project(), wish(asked, [asked.name]))


def _new(asked: Namespace) -> int:
    folders = (_path(getattr(asked, word), word.upper()) for word in ("photos", "masks", "meshes"))
    return verbs.begin(project(), named(asked.dataset), *folders)


def _compare(asked: Namespace) -> int:
    folders = [given or os.environ.get(key) for given, key in ((asked.first, "A"), (asked.second, "B"))]
    if not all(folders):
        raise InputError("two results are to be named", key="compare", cure="make compare A=build/eames B=<another>")
    return verbs.compare(project(), *map(Path, folders))


def _worker(asked: Namespace) -> int:
    from factorlib.runner.cluster import start_worker

    start_worker(asked.scheduler, asked.cores, asked.further)
    return 0


ASKED = "dataset set force recipe"
RUN: dict[str, Callable[[Namespace], int]] = {
    "all": lambda a: verbs.make(project(), wish(a)),
    "stage": _stage,
    "plan": lambda a: verbs.show_plan(project(), wish(a, a.stages)),
    "why": lambda a: verbs.show_why(project(), wish(a, a.stages)),
    "status": lambda a: verbs.show_status(project(), wish(a, a.stages)),
    "graph": lambda a: verbs.show_graph(project(), a.mermaid),
    "logs": lambda a: verbs.show_logs(project(), wish(a, _stages(a)), a.photo or os.environ.get("PHOTO") or None),
    "params": lambda a: verbs.show_params(project(), _stages(a)),
    "new": _new,
    "compare": _compare,
    "validate": lambda a: verbs.validate(
        project(), named(a.dataset), chosen(a.settings), switched_on("SHEET", a.sheet)
    ),
    "verify": lambda a: verbs.verify(project(), named(a.dataset, True)),
    "clean": lambda a: verbs.clean(project(), named(a.dataset, True)),
    "gc": lambda a: verbs.collect(project(), lambda: agreed(a.force)),
    "worker": _worker,
    "ship": lambda a: verbs.ship(project(), a.name, named(a.dataset)),
}
VERBS = {  # in the order of `--help`: options, help
    "all": (ASKED, "Run the whole pipeline, as far as anything must run, and make the pictures of named recipes."),
    "stage": (f"name {ASKED}", "Run one stage and what it needs; `render` with a recipe makes its pictures alone."),
    "plan": (f"stages {ASKED}", "What would run; with a recipe and no stage, for its pictures alone."),
    "why": (f"stages {ASKED}", "Every reason why it would run."),
    "status": ("stages dataset set recipe", "How far each stage is, and what the current results warned of."),
    "graph": ("mermaid dataset", "The stages and what they take, as text or as a Mermaid diagram."),
    "logs": (
        "stages dataset set recipe photo",
        "What current results cost and were made with: time, memory, versions.",
    ),
    "params": ("stages", "Every parameter of stages with default, range and meaning (make params STAGE=…)."),
    "new": (
        "dataset photos masks meshes",
        "Begin data/<name> of your own photos, masks and meshes, with a dataset.yaml.",
    ),
    "compare": ("first second", "A page that shows two results side by side: parameters, numbers, materials, lights."),
    "validate": ("dataset set sheet", "Check pipeline.yaml, settings and dataset without running anything."),
    "verify": ("dataset", "Read every kept result, of a dataset or of all, and name what is damaged."),
    "clean": ("dataset", "Forget a dataset's results, or, where neither --dataset nor DATASET is given, all."),
    "gc": ("force", "Show which results are current for no dataset, and delete them; a terminal is asked first."),
    "worker": (
        "scheduler cores",
        "Work for a Dask scheduler until it ends; further options are those of `dask worker`.",
    ),
    "ship": ("name dataset", "Put a stage's current result into the package (for those who change the stage)."),
}


def parser(program: str) -> argparse.ArgumentParser:
    """Reads the words of every verb; `verb` in what it returns is its name."""
    text = "Any other word is the name of a stage: it is run, and what it needs."
    whole = argparse.ArgumentParser(program, description=text)
    verbs_ = whole.add_subparsers(title="verbs", metavar="verb", dest="verb", required=True)
    for name, (options, text) in VERBS.items():
        one = verbs_.add_parser(name, help=text, description=text, allow_abbrev=False)
        for flags, more in (OPTIONS[option] for option in options.split()):
            one.add_argument(*flags, **more)
    return whole


def run(words: list[str], program: str) -> int:
    """What the verb of the command line returns.  A first word that is neither an option nor a verb is a stage."""
    if words and not words[0].startswith("-") and words[0] not in VERBS:
        words = ["stage", *words]
    known = parser(program)
    asked, further = known.parse_known_args(words or ["--help"])
    if further and asked.verb != "worker":
        known.error(f"unrecognized arguments: {' '.join(further)}")
    asked.further = further
    return RUN[asked.verb](asked)


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
    except OSError as error:  # the system's word where a user can mend it; whatever else is a defect
        from factorlib.disk import disk_error

        known = disk_error(error, project().build)
        if known is None and error.errno in NOT_OURS:
            cure = "check that the folder is there, and that you may read it and write to it"
            known = InputError(error.strerror, file=error.filename, cure=cure)
        if known is None:
            raise
        sys.exit(printable(f"error: {known}"))


if __name__ == "__main__":
    main()
