"""Recipes: YAML files that say which pictures to make of a result; each that is asked for is a step of a stage over recipes.

    recipes/<name>.yaml             for any data set
    recipes/<dataset>/<name>.yaml   for one
"""

from __future__ import annotations

import os
from pathlib import Path

from factorlib.errors import InputError, did_you_mean
from factorlib.runner.names import check_name
from factorlib.runner.project import Data, Project, Recipe

ALL = "all"


def asked_for(project: Project, data: Data, words: list[str]) -> dict[str, Recipe]:
    """The recipes that words name, by name: each a path, a name in recipes/ or recipes/<dataset>/, or `all` of these.

    InputError where one is not there, is not good, or two are called the same.
    """
    known = _known(project, data)
    paths = [path for word in words for path in (known.values() if word == ALL else [_path_of(word, known)])]
    found: dict[str, Recipe] = {}
    for path in dict.fromkeys(paths):
        name = check_name(path.stem, "a recipe", file=path, key="RECIPE")
        if name in found:
            raise InputError(f"two recipes are called {name!r}: their pictures would lie in one folder", file=path, cure="rename one of them")
        found[name] = data.recipe(path)
    if not found and ALL in words:
        raise InputError("there is none in recipes/", key="RECIPE", cure="name a file: RECIPE=<path>.yaml")
    return found


def _known(project: Project, data: Data) -> dict[str, Path]:
    """By name; one of the data set's own stands in place of one for all."""
    folders = (project.root / "recipes", project.root / "recipes" / data.folder.name)
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}


def _path_of(word: str, known: dict[str, Path]) -> Path:
    if word in known:
        return known[word]
    path = Path(os.path.abspath(word))
    if path.is_file():
        return path
    if "/" in word or path.suffix:
        raise InputError("there is no such recipe", file=word, key="RECIPE", cure=did_you_mean(path.stem, [*known, ALL]))
    raise InputError(f"there is no recipe {word!r}", key="RECIPE", cure=did_you_mean(word, [*known, ALL]))
