"""A project of four small stages over text files, in a folder and with a provider of its own; and this project in another folder.

`python toy.py <root> <dataset> [setting …]` runs it as a user would, in a process that can be killed.
"""

import json
import shutil
import sys
from pathlib import Path
from unittest.mock import patch

import msgspec

from factorlib import __main__ as command_line
from factorlib.runner import verbs
from factorlib.runner.dataset_state import Request, read_state
from factorlib.runner.plan import PlannedStep
from factorlib.runner.project import LIBRARY, Data, Project, Provider, photo_sets

LETTERS = '''
"""Counting."""
def letters(text):
    """How many letters."""
    return sum(c.isalpha() for c in text)
'''
UPPER = """
import json, logging, time
from typing import Annotated
import msgspec
from factorlib.errors import InputError
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    sleep: float = 0.0
    times: Annotated[int, msgspec.Meta(ge=1)] = 1
def check(params):
    if params.times == 13:
        raise InputError("thirteen is unlucky", key="upper.times", cure="take another number")
def main(params, inputs, out, progress):
    progress(0, 1, "reading")
    text = inputs.file(inputs.facts["dataset.photo"]["image"]).read_text()
    if "bad" in text:
        raise InputError("a bad word", file=inputs.facts["dataset.photo"]["image"], key="line 1", cure="use a better one")
    if "odd" in text:
        logging.getLogger("factorlib.upper").warning("%s is odd", inputs.photo)
    (out / f"{inputs.photo}.txt").write_text(text.upper() * params.times)
    (out / f"{inputs.photo}.json").write_text(json.dumps({"size": len(text)}))
    time.sleep(params.sleep)
"""
COUNT = """
import json
import msgspec
from toylib.letters import letters
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
def main(params, inputs, out, progress):
    (out / f"{inputs.photo}.json").write_text(json.dumps({"letters": letters((inputs["upper"] / f"{inputs.photo}.txt").read_text())}))
"""
TABLE = """
import json
import msgspec
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    scale: int = 2
def main(params, inputs, out, progress):
    (out / "table.json").write_text(json.dumps(params.scale))
"""
TOTAL = """
import json
from pathlib import Path
import msgspec
class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass
def main(params, inputs, out, progress):
    counts = json.loads((inputs["count"] / "counts.json").read_text())
    scale = json.loads((inputs["table"] / "table.json").read_text())
    template = (Path(__file__).parent / "templates" / "total.html").read_text()
    (out / "total.txt").write_text(template + str(scale * sum(c["letters"] for c in counts.values())))
    (out / "log.txt").write_text(str(len(inputs.log.read_text().splitlines())))
"""
PIPELINE = """
format: 1
stages:
  upper: {inputs: [dataset.photo], over: photo, gather: sizes.json, makes: ["{photo}.txt"]}
  count: {inputs: [upper], over: photo, gather: counts.json}
  table: {}
  total: {inputs: [count, table], threads: 2, logs: true, makes: [total.txt]}
"""


class Slice(msgspec.Struct):
    facts: object
    files: list[str]
    fields: dict


def read(folder: Path, held_out=()) -> Data:
    photos = sorted(path.stem for path in folder.glob("*.txt"))

    def slice_(name, photo):
        return Slice({"image": f"{photo}.txt"}, [f"{photo}.txt"], {f"photos.{photo}.image": f"{photo}.txt"})

    return Data(folder, photos, slice_)


def make_project(root: Path, **texts: str) -> Project:
    """The toy at `root`, with a dataset `set` of the given texts."""
    for name, text in {"upper": UPPER, "count": COUNT, "table": TABLE, "total": TOTAL}.items():
        write(root / "stages" / f"{name}.py", text)
    write(root / "stages" / "__init__.py", "")
    write(root / "stages" / "templates" / "total.html", "total: ")
    write(root / "toylib" / "letters.py", LETTERS)
    write(root / "pipeline.yaml", PIPELINE)
    for name, text in (texts or {"a": "Alpha", "b": "Beta"}).items():
        write(root / "data" / "set" / f"{name}.txt", text)
    return toy(root)


def toy(root: Path) -> Project:
    return Project(root, Provider(("photo",), read))


def wait_for(project: Project, file: Path) -> None:
    """Let the steps of `upper` end only once there is such a file."""
    wait = f"while not __import__('os').path.exists({str(file)!r}): time.sleep(0.05)"
    write(project.root / "stages" / "upper.py", UPPER.replace("time.sleep(params.sleep)", wait))


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def make(project: Project, *settings: str, targets: list[str] | None = None, force: bool = False) -> int:
    return verbs.make(project, verbs.Request("set", targets, list(settings), force))


def done(project: Project) -> list[str]:
    """The steps that runs say they have done, in order."""
    log = project.build / "set" / "log.jsonl"
    events = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
    return ["/".join(filter(None, (e["stage"], e["photo"]))) for e in events if e["event"] == "done"]


def new_runs(project: Project, *settings: str, **more) -> list[str]:
    """The steps that the next run does, which succeeds."""
    before = len(done(project))
    assert make(project, *settings, **more) == 0
    return sorted(done(project)[before:])


def edit(project: Project, file: str, old: str, new: str) -> str:
    """Replace a text in a file of the project, which must be there; the text before."""
    text = (project.root / file).read_text()
    assert old in text
    write(project.root / file, text.replace(old, new, 1))
    return text


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def planned(project: Project, dataset: str = "set", settings: tuple[str, ...] = ()) -> list[PlannedStep]:
    return read_state(project, Request(dataset, settings=settings)).plan()


def state(project: Project, dataset: str = "set", settings: tuple[str, ...] = ()) -> dict[str, str]:
    return {str(p.step): p.status for p in planned(project, dataset, settings)}


def reasons(project: Project, step: str, dataset: str = "set", settings: tuple[str, ...] = ()) -> list[str]:
    return next(p.reasons for p in planned(project, dataset, settings) if str(p.step) == step)


def copy(project: Project, target: Path) -> Project:
    shutil.copytree(project.root, target, symlinks=True)
    return toy(target)


def real_project(root: Path, *copied: str) -> Project:
    """This project below a folder: links to what it is made of, copies of those parts that a test will edit."""
    root.mkdir(parents=True, exist_ok=True)
    for name in ("pipeline.yaml", "stages", "factorlib", "recipes", "data"):
        if name in copied and (LIBRARY / name).is_dir():
            shutil.copytree(LIBRARY / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif name in copied:
            shutil.copy(LIBRARY / name, root)
        else:
            (root / name).symlink_to(LIBRARY / name)
    return Project(root, photo_sets())


def call(project: Project, *words: str) -> int | str:
    """What `python -m factorlib` with these words ends with: an exit code, or its last words."""
    with patch.object(command_line, "project", lambda: project), patch.object(sys, "argv", ["factorlib", *words]):
        try:
            command_line.main()
        except SystemExit as end:
            return end.code


if __name__ == "__main__":
    sys.exit(verbs.make(toy(Path(sys.argv[1])), verbs.Request(sys.argv[2], settings=sys.argv[3:])))
