"""What tests of faults share: this project in a folder, ways to call it, notes of what was tried."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
from pathlib import Path

import pytest

from factorlib import __main__ as command_line
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets
from factorlib.wholefile import append_text


def note(table: str, name: str, tries: int = 1, lost: int = 0, **more: object) -> None:
    """Add a line to the file that FAULTS_LOG names (`make results ONLY=faults`); without it, nothing is written."""
    if path := os.environ.get("FAULTS_LOG"):
        append_text(Path(path), json.dumps({"table": table, "name": name, "tries": tries, "lost": lost, **more}) + "\n")


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


def make(project: Project, *settings: str, targets: list[str] | None = None, force: bool = False) -> int:
    return verbs.make(project, verbs.Wish("set", targets, list(settings), force))


def call(project: Project, *words: str) -> int | str:
    """What `python -m factorlib` with these words ends with: an exit code, or its last words."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as caught:
        patch.setattr(command_line, "project", lambda: project)
        patch.setattr(sys, "argv", ["factorlib", *words])
        command_line.main()
    return caught.value.code


@contextlib.contextmanager
def own_modules(*packages: str):
    """Whatever of these packages is imported within is forgotten, and what was there before is there again."""
    of_these = lambda: {name: module for name, module in sys.modules.items() if name.split(".")[0] in packages}  # noqa: E731
    before, path, environment = of_these(), list(sys.path), dict(os.environ)
    for name in before:
        del sys.modules[name]
    try:
        yield
    finally:
        for name in of_these():
            del sys.modules[name]
        sys.modules.update(before)
        sys.path[:] = path
        os.environ.clear()
        os.environ.update(environment)
