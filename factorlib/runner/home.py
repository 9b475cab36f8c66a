"""The home of a dataset's results, build/<dataset>: links to the current results, marks, and the log of all runs.

    <stage>       link to the current result of a stage, in build/store
    current.json  which key each step has
    log.jsonl     what all runs did
    errors/       where a step failed by a defect, its traceback
    recipes/      links to the current pictures of each recipe
    dataset.txt   whose results these are: only a folder with this mark is a home that the runner made
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import json_text
from factorlib.runner.names import RESERVED, check_name
from factorlib.runner.project import Project, is_path
from factorlib.wholefile import replace_file

Key = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{32}$")]  # it becomes a part of paths


class Home(msgspec.Struct, frozen=True):
    """One such folder, directly in build/."""

    folder: Path

    @property
    def log(self) -> Path:
        """What the runs of this data set cost and reported, one JSON object a line."""
        return self.folder / "log.jsonl"

    @property
    def keys_file(self) -> Path:
        """Which result of each step is current, as JSON: {step: key}."""
        return self.folder / "current.json"

    @property
    def errors(self) -> Path:
        """Folder of the errors of steps that failed, a text file each."""
        return self.folder / "errors"

    def pictures(self, stage: str) -> Path:
        """Folder of the links to the current results of a stage over recipes, one for each recipe."""
        return self.folder / stage

    @property
    def mark(self) -> Path:
        """The file that says whose results these are: the path of the dataset's folder."""
        return self.folder / "dataset.txt"

    def keys(self) -> dict[str, str]:
        """Key by step, as the last run left it; InputError where the file is damaged."""
        try:
            return msgspec.json.decode(self.keys_file.read_bytes(), type=dict[str, Key])
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            found = f"does not say which results are current ({getattr(error, 'strerror', None) or error})"
            cure = "delete it: the next run writes it anew and finds the results that are in the store"
            raise InputError(found, file=self.keys_file, cure=cure) from error

    def last_keys(self) -> dict[str, str]:
        """The same, nothing where the file is damaged."""
        try:
            return self.keys()
        except InputError:
            return {}

    def write_keys(self, keys: dict[str, str]) -> None:
        """Replace the table of current results, step -> key."""
        replace_file(self.keys_file, json_text(keys).encode())


def home_of(project: Project, dataset: Path) -> Home:
    """build/<name of the dataset's folder>; refused where a folder of that name elsewhere has it."""
    home = home_named(project, dataset.name, dataset)
    owner = owner_of(project, home)
    if owner is not None and os.path.isdir(owner) and not owner.samefile(dataset):
        raise _other_owner(home, owner, dataset, f"rename one of the folders, or give its results up: make clean DATASET={_quoted(owner)}")
    return home


def home_named(project: Project, name: str, dataset: Path | None = None) -> Home:
    """build/<name>, which is a folder directly in build/, not a link that leads elsewhere, or is not there yet."""
    check_name(name, "a dataset", file=dataset, key="DATASET", reserved=RESERVED)
    folder = project.build / name
    if os.path.realpath(folder) != os.path.join(os.path.realpath(project.build), name):
        raise InputError("is a link, where the runner keeps a dataset's results", file=folder, cure="delete the link, or move it elsewhere")
    return Home(folder)


def made_home(project: Project, dataset: str) -> Home | None:
    """The home with results of a dataset by its name or path, which need not be there any more; None where it has none yet.

    A name is that of a home in build/; a path must be the one that the home was made for.  InputError for whatever else.
    """
    found = project.find_dataset(dataset)
    folder = found or Path(os.path.abspath(dataset))
    home = home_named(project, folder.name)
    if not home.mark.is_file():
        if found is not None:
            return None
        known = [other.folder.name for other in made_homes(project)]
        cure = did_you_mean(dataset, known) if known else "build/ holds no results of any dataset"
        raise InputError(f"there is no dataset {dataset!r}, and no results of one", key="DATASET", cure=cure)
    owner = owner_of(project, home)
    there = owner is not None and os.path.isdir(owner)
    theirs = owner is not None and not (found and there and owner.samefile(found)) and owner != folder
    if theirs and (is_path(dataset) or (found and there)):
        raise _other_owner(home, owner, folder, f"if it is that one: make clean DATASET={_quoted(owner if there else home.folder.name)}")
    return home


def made_homes(project: Project) -> list[Home]:
    """Every home that the runner made; links are not followed."""
    if not project.build.is_dir():
        return []
    folders = [Path(entry) for entry in os.scandir(project.build) if entry.is_dir(follow_symlinks=False) and entry.name not in RESERVED]
    return [home for home in map(Home, sorted(folders)) if home.mark.is_file()]


def _other_owner(home: Home, owner: Path, dataset: Path, cure: str) -> InputError:
    name = home.folder.name
    return InputError(f"two datasets are called {name!r}: build/{name} holds the results of {owner}", file=dataset, cure=cure)


def _quoted(word: str | Path) -> str:
    return shlex.quote(str(word))


def owner_of(project: Project, home: Home) -> Path | None:
    """The dataset whose results these are; None where nothing says it."""
    try:
        words = home.mark.read_text(encoding="utf-8", errors="surrogateescape").removesuffix("\n")
    except OSError:
        return None
    return project.root / words if words else None


def claim(project: Project, home: Home, dataset: Path) -> None:
    """Write down whose results these are: relative to the project where the dataset lies in it, for checkouts move."""
    home.folder.mkdir(parents=True, exist_ok=True)
    words = str(dataset.relative_to(project.root)) if dataset.is_relative_to(project.root) else str(dataset)
    if owner_of(project, home) != project.root / words:
        replace_file(home.mark, f"{words}\n".encode("utf-8", "surrogateescape"))
