"""Reading a recipe for a data set: what it asks for must be there, and every complaint names what is."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from factorlib.dataset.schema import Dataset
from factorlib.errors import InputError, did_you_mean
from factorlib.jsonfile import read_json
from factorlib.recipe.schema import BALL, KINDS, AnyRecipe, Grid, Insert, Relight, Transfer, is_light_file, is_mesh_file
from factorlib.yamlfile import load_yaml, read_yaml


def read_recipe(path: Path, dataset: Dataset) -> AnyRecipe:
    """The recipe in a file; InputError for one that is not good, or asks for what the data set does not have."""
    written = load_yaml(path)
    kind = written.get("kind") if isinstance(written, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        found = "it does not say what kind of picture to make" if kind is None else f"there is no kind {kind!r}"
        raise InputError(found, file=path, key="kind", cure=did_you_mean(str(kind), KINDS))
    recipe = read_yaml(path, KINDS[kind])
    photos = [photo.name for photo in dataset.spec.photos]
    meshes = sorted({obj.mesh for photo in dataset.spec.photos for obj in photo.objects})
    _check(recipe.photos, photos, "photo", path, "photos")
    if isinstance(recipe, Relight | Grid):
        _check([name for name in recipe.lights if not is_light_file(name)], photos, "photo", path, "lights")
        stems = [Path(name).stem for name in recipe.lights]
        for name in stems:
            if stems.count(name) > 1:
                raise InputError(f"two lights are called {name!r}: one picture would replace the other", file=path, key="lights", cure="rename a file")
    if isinstance(recipe, Grid):
        _check(recipe.materials, dataset.spec.materials, "material", path, "materials")
    if isinstance(recipe, Transfer):
        _check(recipe.materials, dataset.spec.materials, "material", path, "materials")
    if isinstance(recipe, Transfer | Insert):
        _check(_materials_wanted(recipe), [*dataset.spec.materials, *_own(recipe.table, path)], "material", path, "materials")
    if isinstance(recipe, Insert) and recipe.beside is not None:
        for photo in recipe.photos or photos:
            objects = [obj.name for obj in dataset.photo(photo).objects]
            _check([recipe.beside], objects, f"object in photo '{photo}' called", path, "beside")
    for name, file in files_of(recipe, path).items():
        if not file.is_file():
            cure = f"files are relative to the recipe; without a file there are: {', '.join([BALL, *meshes])}"
            raise InputError(f"there is no file {name!r}", file=path, cure=cure)
    if isinstance(recipe, Insert) and not is_mesh_file(recipe.mesh):
        _check([recipe.mesh], [BALL, *meshes], "mesh", path, "mesh")
    return recipe


def files_of(recipe: AnyRecipe, path: Path) -> dict[str, Path]:
    """The files that a recipe names, by how it writes them."""
    named = [name for name in getattr(recipe, "lights", []) if is_light_file(name)]
    named += [name for name in [getattr(recipe, "table", None)] if name is not None]
    named += [name for name in [getattr(recipe, "mesh", "")] if is_mesh_file(name)]
    return {name: (path.parent / name).resolve() for name in named}


def _materials_wanted(recipe: Transfer | Insert) -> list[str]:
    if isinstance(recipe, Transfer):
        return list(recipe.materials.values())
    return [] if recipe.material is None else [recipe.material]


def _own(table: str | None, path: Path) -> list[str]:
    """Names in a table of one's own; nothing for a file that is missing or no table, which is said elsewhere."""
    if table is None or not (path.parent / table).is_file():
        return []
    content = read_json(path.parent / table)
    materials = content.get("materials") if isinstance(content, dict) else None
    return list(materials) if isinstance(materials, dict) else []


def _check(names: Iterable[str], known: list[str], what: str, path: Path, key: str) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"there is no {what} {name!r}", file=path, key=key, cure=did_you_mean(name, known))
