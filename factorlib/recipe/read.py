"""Reading of recipes for a data set: every name and file in a recipe must exist, and every error names the choices."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from factorlib.dataset.check import MESHES
from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import Dataset, ObjectEntry
from factorlib.errors import InputError, did_you_mean
from factorlib.recipe import kinds
from factorlib.recipe.kinds import BALL, KINDS, AnyRecipe, is_light_file, is_mesh_file, read_table
from factorlib.yamlfile import load_yaml, read_yaml


def read_recipe(path: Path, dataset: Dataset) -> AnyRecipe:
    """Read the recipe in a file; InputError if it is invalid or refers to something that the data set lacks."""
    refuse = Refusal(path, path.parent)
    written = load_yaml(path)
    kind = written.get("kind") if isinstance(written, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        found = "it does not say what kind of picture to make" if kind is None else f"there is no kind {kind!r}"
        refuse("kind", found, did_you_mean(str(kind), KINDS))
    recipe = read_yaml(path, KINDS[kind])
    check_recipe(recipe, path, {photo.name: photo.objects for photo in dataset.spec.photos}, dataset.spec.materials)
    return recipe


def check_recipe(
    recipe: AnyRecipe, path: Path, objects: Mapping[str, Sequence[ObjectEntry]], materials: list[str]
) -> None:
    """Check a recipe against a data set.

    Args:
        recipe: the recipe
        path: the recipe's file, which errors name and to which its files are relative
        objects: objects of each photo
        materials: materials of the data set

    Raises:
        InputError: The recipe refers to something that the data set lacks.
    """
    refuse = Refusal(path, path.parent)
    photos = list(objects)
    meshes = sorted({obj.mesh for own in objects.values() for obj in own})

    def check(key: str, names: Iterable[str], known: list[str], what: str, once: bool = False) -> None:
        """Check that names are known and, if `once`, distinct."""
        for name in (names := list(names)):
            refuse.known(key, name, known, what)
            if once and names.count(name) > 1:
                fault = f"the {what} {name!r} is named twice: one picture would replace the other"
                refuse(key, fault, "name it once")

    for name, file in files_of(recipe, path).items():
        if not file.is_file():
            cure = f"files are relative to the recipe; meshes that need no file: {', '.join([BALL, *meshes])}"
            raise InputError(f"there is no file {name!r}", file=path, cure=cure)
    if recipe.denoise and find_spec(kinds.DENOISER) is None:
        cure = "make setup EXTRAS=denoise (outside a checkout: pip install mitsuba-oidn), or leave it out"
        refuse("denoise", "the denoiser is not installed", cure)
    if isinstance(recipe, kinds.PhotoRecipe):
        check("photos", recipe.photos, photos, "photo", once=True)
        if recipe.sun is not None:
            if isinstance(recipe, kinds.RelightRecipe):
                refuse("sun", "a relighting shows lights that are given", "leave it out")
            if len(recipe.photos) != 1:
                cure = "name one photo: `photos: [...]`"
                refuse("sun.direction", "a direction holds in the light of one photo", cure)
            if not any(recipe.sun.direction):
                refuse("sun.direction", "it has no length", "name another")
    if isinstance(recipe, kinds.RelightRecipe | kinds.GridRecipe):
        check("lights", [name for name in recipe.lights if not is_light_file(name)], photos, "photo")
    if isinstance(recipe, kinds.RelightRecipe):
        lights = [Path(name).stem for name in recipe.lights]
        check("lights", lights, lights, "light", once=True)
        if not lights and len(photos) == 1:
            refuse("lights", "there is no other photo whose light could be used", "name a file (.hdr, .exr)")
    if isinstance(recipe, kinds.TransferRecipe | kinds.GridRecipe):
        check("materials", recipe.materials, materials, "material")
    if isinstance(recipe, kinds.TransferRecipe | kinds.InsertRecipe):
        known = [*materials, *(read_table(path.parent / recipe.table) if recipe.table is not None else [])]
    if isinstance(recipe, kinds.TransferRecipe):
        check("materials", recipe.materials.values(), known, "material")
    if isinstance(recipe, kinds.InsertRecipe):
        if isinstance(recipe.material, dict):
            check("material", recipe.material.values(), known, "material")
            if recipe.mesh not in meshes:
                refuse("material", "parts are told apart in a mesh of the data set", "name one material")
        elif recipe.material is not None:
            check("material", [recipe.material], known, "material")
        if not is_mesh_file(recipe.mesh):
            check("mesh", [recipe.mesh], [BALL, *meshes], "mesh")
        elif Path(recipe.mesh).suffix.lower() not in MESHES:
            refuse("mesh", f"{recipe.mesh!r} is no mesh that is read here", f"one of {', '.join(MESHES)}")
        for photo in (recipe.photos or photos) if recipe.beside is not None else ():
            names = [obj.name for obj in objects[photo]]
            if recipe.beside not in names:
                found = (
                    f"there is no object {recipe.beside!r} in photo '{photo}', "
                    f"whose objects are: {', '.join(names) or 'none'}"
                )
                refuse("beside", found, "name the photos that have it: `photos: [...]`")


def files_of(recipe: AnyRecipe, path: Path) -> dict[str, Path]:
    """Return the absolute paths of the files that a recipe names, by the names it uses."""
    named = [name for name in getattr(recipe, "lights", []) if is_light_file(name)]
    named += [name for name in [getattr(recipe, "table", None)] if name is not None]
    named += [name for name in [getattr(recipe, "mesh", "")] if is_mesh_file(name)]
    return {name: Path(os.path.abspath(path.parent / name)) for name in named}
