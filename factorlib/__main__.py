"""The command line: `python -m factorlib all|<stage>|plan|why|status|validate|verify|clean --dataset eames`.

`argparse` reads it, because a run with nothing to do must not wait for a heavier library.  An option that is not given
has the value of an environment variable, by which make passes NAME=value on without a shell.
"""

import argparse
import contextlib
import io
import logging
import os
import signal
import sys
import threading
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from factorlib.errors import InputError
from factorlib.runner import results_folder, verbs
from factorlib.runner.dataset_state import Request
from factorlib.runner.display import printable, printable_streams
from factorlib.runner.project import LIBRARY, PIPELINE, Project, photo_sets
from factorlib.wholefile import disk_error


def project() -> Project:
    """Return the project: the checkout of FACTORLIB_ROOT, of this package, or of the current folder."""
    cwd = Path.cwd()
    checkout = next((folder for folder in (LIBRARY, cwd, *cwd.parents) if (folder / PIPELINE).is_file()), None)
    if not (root := os.environ.get("FACTORLIB_ROOT") or checkout):
        cure = f"run it in a checkout, or name one: FACTORLIB_ROOT=<folder with {PIPELINE}, stages and data>"
        raise InputError(f"neither this folder nor one above it has a {PIPELINE}", file=cwd, cure=cure)
    return Project(Path(root).resolve(), photo_sets())


def dataset_of(arguments: Namespace) -> str:
    """Return the dataset's name or path; InputError if none is given."""
    if arguments.dataset is None:
        cure = "add DATASET=<a name in data/, or a path to a folder>"
        raise InputError("no dataset is named", key="DATASET", cure=cure)
    return arguments.dataset


def switched_on(key: str, option: bool) -> bool:
    """Return True if an option is given, or the environment variable `key` is 1.

    Raises:
        InputError: The variable is neither 0 nor 1 nor empty.
    """
    word = os.environ.get(key, "")
    if not option and word not in ("", "0", "1"):
        raise InputError(f"{word!r} is neither 1 nor 0", key=key, cure=f"write {key}=1, or leave it out")
    return option or word == "1"


def _path(word: str) -> Path:
    return Path(word).expanduser()


# arguments of `ArgumentParser.add_argument`; the environment variable `key` has the default
OPTIONS: dict[str, dict[str, Any]] = {
    "--dataset": {"key": "DATASET", "help": "dataset: a name in data/ or a path to a folder"},
    "--set": {
        "key": "SET",
        "action": "append",
        "metavar": "X.Y=Z",
        "help": "set a parameter, as stage.parameter=value",
    },
    "--force": {"key": "FORCE", "action": "store_true", "help": "run again"},
    "--strict": {"key": "STRICT", "action": "store_true", "help": 'return 3 if the verdict is "do not trust"'},
    "--recipe": {"key": "RECIPE", "action": "append", "help": "recipe: a path, a name in recipes/, or all"},
    "--held-out": {
        "key": "HELD_OUT",
        "action": "append",
        "metavar": "PHOTO,PHOTO",
        "help": "photos that this run predicts and does not solve from",
    },
    "--photos": {"key": "PHOTOS", "type": _path, "help": "folder of photos"},
    "--masks": {"key": "MASKS", "type": _path, "help": "folder of masks"},
    "--meshes": {"key": "MESHES", "type": _path, "help": "folder of meshes"},
    "--matte": {"key": "MATTE", "type": _path, "help": "ONNX file of a matting network, otherwise U2-Net small"},
    "--whole": {
        "key": "WHOLE",
        "action": "store_true",
        "help": "take the thing for one material, whatever its colours",
    },
    "--port": {"key": "PORT", "type": int, "help": "port on 127.0.0.1, otherwise a free one"},
    "--sheet": {"key": "SHEET", "action": "store_true", "help": "also draw photos, labels and meshes"},
    "stages": {"key": "STAGE", "nargs": "*", "help": "stages; otherwise all"},
    "name": {},
}


def add_option(parser: argparse.ArgumentParser, name: str) -> None:
    """Add an option to the parser of a verb; the default is the value of its environment variable."""
    more = {"key": "", **OPTIONS[name]}
    if key := more.pop("key"):
        value = os.environ.get(key)
        more["help"] += f"; default: {key}"
        more["default"] = value if key == "DATASET" else value or None  # An empty name is not a missing one.
        if "action" in more:
            more["default"] = switched_on(key, False) if more["action"] == "store_true" else [value] if value else []
        elif more.get("nargs") == "*":
            more["default"] = (value or "").split()
    parser.add_argument(*(["-d"] if name == "--dataset" else []), name, **more)


def request(arguments: Namespace, stages: list[str] | None = None) -> Request:
    """Return the request that the options describe; without `stages` it is for all stages."""
    force = getattr(arguments, "force", False)
    return Request(dataset_of(arguments), stages or None, arguments.set, force, arguments.recipe, arguments.held_out)


def _stage(arguments: Namespace) -> int:
    verbs.pipeline_of(project()).check([arguments.name])
    return verbs.make(project(), request(arguments, [arguments.name]))


COMMON = "--dataset --set --force --recipe --held-out"
VERBS: dict[str, tuple[str, Callable[[Namespace], int], str]] = {  # options, function, help; in the order of `--help`
    "all": (f"{COMMON} --strict", lambda a: verbs.make(project(), request(a), a.strict),
            "Run all stages that are not up to date, and render the named recipes."),
    "stage": (f"name {COMMON}", _stage,
              "Run one stage and the stages that it needs; `render` with a recipe renders that recipe only."),
    "plan": (f"stages {COMMON}", lambda a: verbs.show_plan(project(), request(a, a.stages)),
             "List the steps that would run; with a recipe and no stage, those of its pictures only."),
    "why": (f"stages {COMMON}", lambda a: verbs.show_plan(project(), request(a, a.stages), True),
            "List every reason why steps would run."),
    "status": ("stages --dataset --set --recipe --held-out",
               lambda a: verbs.show_status(project(), request(a, a.stages)),
               "Print the progress of each stage, and the warnings of current results."),
    "params": ("stages", lambda a: verbs.show_params(project(), a.stages),
               "List the parameters of stages with default, range and meaning (make params STAGE=…)."),
    "new": ("--dataset --photos --masks --meshes",
            lambda a: verbs.begin(project(), dataset_of(a), a.photos, a.meshes, a.masks),
            "Create data/<name> with a dataset.yaml from your own photos, masks and meshes."),
    "photos": ("--dataset --photos --meshes --matte --whole",
               lambda a: verbs.begin(
                   project(), dataset_of(a), a.photos, a.meshes, verbs.EstimatedMasks(a.matte, a.whole)),
               "Create data/<name> from photographs alone: automatic masks, cameras, a visual hull."),
    "label": ("--dataset --port", lambda a: verbs.label_masks(project(), dataset_of(a), a.port or 0),
              "Draw masks on a page in the browser, served on this machine alone until Ctrl-C."),
    "validate": ("--dataset --set --held-out --sheet",
                 lambda a: verbs.validate(project(), dataset_of(a), a.set, a.sheet, a.held_out),
                 "Check pipeline.yaml, settings and dataset without running anything."),
    "verify": ("--dataset", lambda a: results_folder.verify(project(), a.dataset),
               "Read every stored result of a dataset, or of all, and list damaged ones."),
    "clean": ("--dataset", lambda a: results_folder.clean(project(), a.dataset),
              "Remove the results of a dataset; of all datasets if neither --dataset nor DATASET is given."),
}  # fmt: skip


def dispatch(words: list[str], program: str) -> int:
    """Run the verb of the command line and return its exit code.

    A first word that is neither an option nor a verb is a stage.
    """
    if words and not words[0].startswith("-") and words[0] not in VERBS:
        words = ["stage", *words]
    epilog = "Any other word is the name of a stage: it is run with the stages that it needs."
    parser = argparse.ArgumentParser(program, description=epilog)
    parsers = parser.add_subparsers(title="verbs", metavar="verb", dest="verb", required=True)
    for name, (options, _, text) in VERBS.items():
        verb = parsers.add_parser(name, help=text, description=text, allow_abbrev=False)
        for option in options.split() if name in words[:1] else ():
            add_option(verb, option)
    arguments = parser.parse_args(words or ["--help"])
    return VERBS[arguments.verb][1](arguments)


@contextlib.contextmanager
def raise_on_signals() -> Iterator[None]:
    """Raise SystemExit at SIGTERM, or KeyboardInterrupt at SIGINT, in the code inside; ignore later signals."""
    in_main_thread = threading.current_thread() is threading.main_thread()  # Python sets handlers in no other thread.
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if in_main_thread and signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, _stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(number: int, frame: FrameType | None = None) -> None:
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    raise SystemExit(verbs.TERMINATED) if number == signal.SIGTERM else KeyboardInterrupt


def main() -> NoReturn:
    """Run the verb of the command line; an error of the input ends the program with its message and exit code 1."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # File names may contain anything.
    try:
        with printable_streams(), raise_on_signals():
            logging.basicConfig(format="warning: %(message)s", level=logging.WARNING)
            sys.exit(
                dispatch(sys.argv[1:], "factorlib" if Path(sys.argv[0]).name == "factorlib" else "python -m factorlib")
            )
    except InputError as error:
        sys.exit(printable(f"error: {error}"))
    except BrokenPipeError:  # The reader, such as `head`, has closed the pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # The flush at exit must not fail.
        sys.exit(1)
    except OSError as error:  # A message for errors that the user can fix; anything else is a defect.
        if (known := disk_error(error, project().build)) is None:
            raise
        sys.exit(printable(f"error: {known}"))


if __name__ == "__main__":
    main()
