"""Where everything lies: the project's root, its pipeline, its results, its datasets and recipes by name or path."""

from __future__ import annotations

import importlib
import os
import shlex
import signal
import threading
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from factorlib.errors import InputError, did_you_mean

HOW = "name a folder in data/, or give a path to one with a dataset.yaml in it"
PIPELINE = "pipeline.yaml"
LIBRARY = Path(__file__).resolve().parent.parent.parent  # the folder that holds factorlib/
RESERVED = ("studies", "bench", "store", "compare", "docs")  # folders of build/ that are no datasets
LONGEST = 255  # bytes of a name, on every common file system
SHARED = "FACTORLIB_STORE"  # environment variable: the folder of a store that several checkouts share
ALL = "all"  # recipes


class Recipe(msgspec.Struct, frozen=True):
    """What a recipe says.  facts: JSON-able, by field;  files: those it names, as they are written there -> absolute path"""

    facts: dict[str, Any]
    files: dict[str, Path]


class Data(msgspec.Struct, frozen=True):
    """A dataset as the runner sees it: its folder, its photos, a slice of it by name and photo, and what is wrong with it.

    slice: has `facts`, JSON-able; `fields`, the same by their names in the dataset's file; and `files` that they name
    recipe: reads a recipe for this data set; InputError where it asks for what is not there
    faults: of the files that a slice names, as far as looking at headers tells, by the parameters of the stage that takes
            it and the file in which these stand
    recipe_faults: of the files that a recipe names;  cautions: what will run, but leave the answer open, as sentences
    """

    folder: Path
    photos: list[str]
    slice: Callable[[str, str | None], Any]
    faults: Callable[[str, str | None, dict[str, Any], Path], list[InputError]] = lambda *_: []
    recipe: Callable[[Path], Recipe] | None = None
    recipe_faults: Callable[[dict[str, Path]], list[InputError]] = lambda _: []
    cautions: Callable[[], list[str]] = list


class Provider(NamedTuple):
    """How to read datasets: the names of their slices, and a reader."""

    slices: tuple[str, ...]
    read: Callable[[Path], Data]


def take_sigterm_back() -> None:
    """What Python does at SIGTERM holds again: pycolmap, once imported, prints a C stack instead."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def photo_sets() -> Provider:
    """The provider of the project's own datasets."""
    from factorlib.dataset.read import read_dataset
    from factorlib.dataset.slices import SLICES, dataset_slice

    def read(path: Path) -> Data:
        """The data set of a folder, as the runner sees it."""
        dataset = read_dataset(path)
        take_sigterm_back()

        def recipe(file: Path) -> Recipe:
            """Read a recipe when one is asked for."""
            from factorlib.recipe.read import files_of, read_recipe

            read = read_recipe(file, dataset)
            return Recipe(msgspec.to_builtins(read), files_of(read, file))

        @cache
        def look() -> Any:
            """`factorlib.validation`, by its name as stages are, when it is first asked for: it imports science."""
            return importlib.import_module("factorlib.validation").Validation(dataset)

        photos, faults = [photo.name for photo in dataset.spec.photos], lambda *of: look().faults(*of)
        slice_, recipe_faults = partial(dataset_slice, dataset), lambda files: look().recipe_faults(files)
        return Data(dataset.folder, photos, slice_, faults, recipe, recipe_faults, lambda: look().cautions())

    return Provider(SLICES, read)


class Project(msgspec.Struct, frozen=True):
    """A checkout: pipeline.yaml, the package of its stages, data/ and build/.

    shipped: the folder of the first two and of recipes, where the installed package brings them and `root` is any folder
    """

    root: Path
    provider: Provider
    package: str = "stages"
    shipped: Path | None = None

    @property
    def code_root(self) -> Path:
        """The folder of pipeline.yaml and of the package of its stages."""
        return self.shipped or self.root

    @property
    def pipeline_file(self) -> Path:
        """The file that declares the stages."""
        return self.code_root / PIPELINE

    @property
    def build(self) -> Path:
        """The folder of all results."""
        return self.root / "build"

    @property
    def store(self) -> Path:
        """The folder of the store: in `build`, or that which FACTORLIB_STORE names.  InputError where there is none."""
        if not (named := os.environ.get(SHARED)):
            return self.build / "store"
        if not os.path.isdir(folder := Path(named).expanduser()):
            cure = "make it, or name another that you may write; it may be empty"
            raise InputError("there is no such folder", file=named[:100], key=SHARED, cure=cure)
        return folder.resolve()

    def command(self, verb: str, dataset: str) -> str:
        """A verb for a data set, as a user of the checkout, or of the installed package, types it."""
        words = f"factorlib {verb} -d" if self.shipped else f"make {verb} DATASET="
        return f"{words}{' ' * bool(self.shipped)}{shlex.quote(dataset)}"

    def shown(self, path: Path) -> str:
        """A path as messages write it: from where the user stands, if it lies below."""
        here = Path.cwd()
        return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)

    def dataset_folder(self, name: str) -> Path:
        """A dataset by its name in data/, or by its path; InputError where it is not there."""
        if (folder := self.find_dataset(name)) is not None:
            return folder
        known = [p.parent.name for p in (self.root / "data").glob("*/dataset.yaml")]
        cure = did_you_mean(name, known) if known and "/" not in name else HOW
        raise InputError(f"there is no dataset {name!r}", key="DATASET", cure=cure)

    def find_dataset(self, name: str) -> Path | None:
        """The same, None where it is not there; InputError for what can be no dataset's name or path."""
        by_name = "/" not in name or name.rstrip("/") in ("", ".", "..")
        if by_name:
            check_name(name, "a dataset", key="DATASET", reserved=RESERVED)
        for path in ([self.root / "data" / name] if by_name else []) + [Path(os.path.abspath(name))]:
            if not os.path.exists(path):
                continue
            folder = path if os.path.isdir(path) else path.parent
            check_name(folder.name, "a dataset", file=folder, key="DATASET", reserved=RESERVED)
            if self.root.is_relative_to(folder) or folder == self.build:
                words = "a dataset cannot be the folder that holds the project"
                raise InputError(words, file=folder, key="DATASET", cure=HOW)
            return folder
        return None

    def recipes(self, data: Data, words: list[str]) -> dict[str, Recipe]:
        """The recipes that words name, by name: each a path, a name in recipes/ or recipes/<dataset>/, or `all` of these.

        InputError where one is not there, is not good, or two are called the same.
        """
        roots = [root / "recipes" for root in dict.fromkeys([self.code_root, self.root])]
        folders = [*roots, *(root / data.folder.name for root in roots)]  # the latter go before
        known = {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}
        paths, recipes = [], {}
        for word in words:
            path = Path(os.path.abspath(word))
            if word != ALL and word not in known and not path.is_file():
                by_path = "/" in word or path.suffix
                said = "there is no such recipe" if by_path else f"there is no recipe {word!r}"
                cure = did_you_mean(path.stem if by_path else word, [*known, ALL])
                raise InputError(said, file=word if by_path else None, key="RECIPE", cure=cure)
            paths += known.values() if word == ALL else [known.get(word, path)]
        for path in dict.fromkeys(paths):
            name = check_name(path.stem, "a recipe", file=path, key="RECIPE", most=200)
            if name in recipes:
                said = f"two recipes are called {name!r}: their pictures would lie in one folder"
                raise InputError(said, file=path, cure="rename one of them")
            if data.recipe is None:
                raise InputError("there are no recipes of such a dataset", key="RECIPE", cure="leave RECIPE out")
            recipes[name] = data.recipe(path)
        if not recipes and ALL in words:
            raise InputError("there is none in recipes/", key="RECIPE", cure="name a file: RECIPE=<path>.yaml")
        return recipes


def check_name(
    name: str, kind: str, *, file: Any = None, key: str | None = None, reserved: Sequence[str] = (), most: int = LONGEST
) -> str:
    """`name`, where it can be the name of one file or folder and is not taken; InputError otherwise.

    kind: of what it is the name, with its article;  most: bytes that it may have
    """
    good = name.encode(errors="replace").decode() == name and not set("/\0\n") & set(name)
    if not good or name in ("", ".", "..", *reserved) or len(name.encode()) > most:
        but = f", nor {', '.join(reserved)}" if reserved else ""
        cure = f"give it another name: UTF-8 of at most {most} bytes, without a slash or an end of a line{but}"
        raise InputError(f"{kind} cannot be called {name!r}", file=file, key=key, cure=cure)
    return name
