"""Where everything lies: the project's root, its pipeline, its datasets by name or path, and each dataset's results."""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import msgspec

from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import json_text
from factorlib.wholefile import replace_file

RESERVED = ("studies", "bench", "store")  # folders of build/ that are no datasets
LIBRARY = Path(__file__).resolve().parent.parent.parent  # the folder that holds factorlib/


class Slice(Protocol):
    facts: Any
    files: list[str]


def nothing_to_look_at(slice_: str, photo: str | None, params: dict[str, Any], settings: Path) -> list[InputError]:
    return []


class Data(msgspec.Struct, frozen=True):
    """A dataset as the runner sees it: its folder, its photos, a slice of it by name and photo, and what is wrong with it.

    faults: of the files that a slice names, as far as looking at headers tells, by the parameters of the stage that takes it
            and the file in which these stand
    """

    folder: Path
    photos: list[str]
    slice: Callable[[str, str | None], Slice]
    faults: Callable[[str, str | None, dict[str, Any], Path], list[InputError]] = nothing_to_look_at


class Provider(msgspec.Struct, frozen=True):
    """How to read datasets: the names of their slices, and a reader."""

    slices: tuple[str, ...]
    read: Callable[[Path], Data]


def photo_sets() -> Provider:
    """The provider of the project's own datasets."""
    from factorlib.dataset.read import read_dataset
    from factorlib.dataset.slices import SLICES, dataset_slice

    def read(path: Path) -> Data:
        dataset = read_dataset(path)
        photos = [photo.name for photo in dataset.spec.photos]
        return Data(dataset.folder, photos, lambda name, photo: dataset_slice(dataset, name, photo), _looking_at(dataset))

    return Provider(SLICES, read)


def _looking_at(dataset) -> Callable[..., list[InputError]]:
    """`factorlib.validation`, found by its name as stages are, when it is first asked: it imports science."""

    @cache
    def validation():
        return importlib.import_module("factorlib.validation").Validation(dataset)

    return lambda *arguments: validation().faults(*arguments)


class Project(msgspec.Struct, frozen=True):
    """A checkout: pipeline.yaml, the package of its stages, data/ and build/."""

    root: Path
    provider: Provider
    package: str = "stages"

    @property
    def pipeline_file(self) -> Path:
        return self.root / "pipeline.yaml"

    @property
    def build(self) -> Path:
        return self.root / "build"

    @property
    def source_roots(self) -> list[Path]:
        return list(dict.fromkeys([self.root, LIBRARY]))

    def shown(self, path: Path) -> str:
        """A path as messages write it: from where the user stands, if it lies below."""
        here = Path.cwd()
        return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)

    def dataset_folder(self, name: str) -> Path:
        """A dataset by its name in data/, or by its path."""
        found = self.root / "data" / name
        if "/" not in name and found.is_dir():
            return found
        path = Path(os.path.abspath(name))
        if path.is_dir() or path.is_file():
            return path if path.is_dir() else path.parent
        known = [p.parent.name for p in (self.root / "data").glob("*/dataset.yaml")]
        cure = (
            did_you_mean(name, known)
            if known and "/" not in name
            else "name a folder in data/, or give a path to one with a dataset.yaml in it"
        )
        raise InputError(f"there is no dataset {name!r}", key="DATASET", cure=cure)


class Home(msgspec.Struct, frozen=True):
    """build/<dataset>: links to the current results, which key each step has, and the log of all runs."""

    folder: Path

    @property
    def log(self) -> Path:
        return self.folder / "log.jsonl"

    @property
    def keys_file(self) -> Path:
        return self.folder / "current.json"

    def keys(self) -> dict[str, str]:
        """Key by step, as the last run left it."""
        try:
            return json.loads(self.keys_file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}

    def write_keys(self, keys: dict[str, str]) -> None:
        replace_file(self.keys_file, json_text(keys).encode())


def home_of(project: Project, dataset: Path) -> Home:
    """build/<name of the dataset's folder>; refused where a folder of that name elsewhere has it."""
    name = dataset.name
    if name in RESERVED:
        raise InputError(f"a dataset cannot be called {name!r}", file=dataset, cure="rename its folder: build/ uses that name")
    home = Home(project.build / name)
    owner = owner_of(project, home)
    if owner is not None and owner.is_dir() and not owner.samefile(dataset):
        raise InputError(
            f"two datasets are called {name!r}: build/{name} holds the results of {owner}",
            file=dataset,
            cure=f"rename one of the folders, or give its results up: make clean DATASET={owner}",
        )
    return home


def owner_of(project: Project, home: Home) -> Path | None:
    try:
        words = (home.folder / "dataset.txt").read_text(encoding="utf-8").strip()
    except OSError:
        return None
    return project.root / words


def claim(project: Project, home: Home, dataset: Path) -> None:
    """Write down whose results these are: relative to the project where the dataset lies in it, for checkouts move."""
    home.folder.mkdir(parents=True, exist_ok=True)
    words = str(dataset.relative_to(project.root)) if dataset.is_relative_to(project.root) else str(dataset)
    if owner_of(project, home) != project.root / words:
        replace_file(home.folder / "dataset.txt", f"{words}\n".encode())
