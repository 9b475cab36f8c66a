"""Reading a recipe for a data set: what it asks for must be there, and every complaint names what is."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from factorlib.dataset.check import MESHES
from factorlib.dataset.schema import Dataset
from factorlib.errors import InputError, did_you_mean
from factorlib.recipe import schema
from factorlib.recipe.schema import BALL, KINDS, AnyRecipe, is_light_file, is_mesh_file
from factorlib.recipe.table import read_table
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
    for name, file in files_of(recipe, path).items():
        if not is_plain_file(file):
            cure = f"files are relative to the recipe; meshes that need no file: {', '.join([BALL, *meshes])}"
            raise InputError(f"there is no file {name!r}", file=path, cure=cure)
    if isinstance(recipe, schema.OfPhotos):
        _check(recipe.photos, photos, "photo", path, "photos")
        _check_once(recipe.photos, "photo", path, "photos")
    if isinstance(recipe, schema.Relight | schema.Grid):
        _check([name for name in recipe.lights if not is_light_file(name)], photos, "photo", path, "lights")
    if isinstance(recipe, schema.Relight):
        _check_once([Path(name).stem for name in recipe.lights], "light", path, "lights")
        if not recipe.lights and len(photos) == 1:
            fault = "there is no other photo whose light could be used"
            raise InputError(fault, file=path, key="lights", cure="name a file (.hdr, .exr)")
    if isinstance(recipe, schema.Transfer | schema.Grid):
        _check(recipe.materials, dataset.spec.materials, "material", path, "materials")
    if isinstance(recipe, schema.Transfer | schema.Insert):
        known = [*dataset.spec.materials, *(read_table(path.parent / recipe.table) if recipe.table is not None else [])]
    if isinstance(recipe, schema.Transfer):
        _check(recipe.materials.values(), known, "material", path, "materials")
    if isinstance(recipe, schema.Insert):
        _check([recipe.material] if recipe.material is not None else [], known, "material", path, "material")
        _check_insert(recipe, meshes, dataset, path)
    return recipe


def _check_insert(recipe: schema.Insert, meshes: list[str], dataset: Dataset, path: Path) -> None:
    if not is_mesh_file(recipe.mesh):
        _check([recipe.mesh], [BALL, *meshes], "mesh", path, "mesh")
    elif Path(recipe.mesh).suffix.lower() not in MESHES:
        found = f"{recipe.mesh!r} is no mesh that is read here"
        raise InputError(found, file=path, key="mesh", cure=f"one of {', '.join(MESHES)}")
    if recipe.beside is not None:
        for photo in recipe.photos or [photo.name for photo in dataset.spec.photos]:
            objects = [obj.name for obj in dataset.photo(photo).objects]
            if recipe.beside not in objects:
                found = f"there is no object {recipe.beside!r} in photo '{photo}', whose objects are: {', '.join(objects) or 'none'}"
                raise InputError(found, file=path, key="beside", cure="name the photos that have it: `photos: [...]`")


def is_plain_file(path: Path) -> bool:
    """Whether there is a file at a path; no path at all is none either."""
    try:
        return path.is_file()
    except ValueError:  # a NUL
        return False


def _check_once(names: list[str], what: str, path: Path, key: str) -> None:
    for name in names:
        if names.count(name) > 1:
            fault = f"the {what} {name!r} is named twice: one picture would replace the other"
            raise InputError(fault, file=path, key=key, cure="name it once")


def files_of(recipe: AnyRecipe, path: Path) -> dict[str, Path]:
    """The files that a recipe names, by how it writes them."""
    named = [name for name in getattr(recipe, "lights", []) if is_light_file(name)]
    named += [name for name in [getattr(recipe, "table", None)] if name is not None]
    named += [name for name in [getattr(recipe, "mesh", "")] if is_mesh_file(name)]
    return {name: Path(os.path.abspath(path.parent / name)) for name in named}


def _check(names: Iterable[str], known: list[str], what: str, path: Path, key: str) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"there is no {what} {name!r}", file=path, key=key, cure=did_you_mean(name, known))
