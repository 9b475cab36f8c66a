"""What tests of faults share: this project in a folder, ways to call it."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from factorlib import __main__ as command_line
from factorlib.runner.project import LIBRARY, Project, photo_sets


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
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as caught:
        patch.setattr(command_line, "project", lambda: project)
        patch.setattr(sys, "argv", ["factorlib", *words])
        command_line.main()
    return caught.value.code
