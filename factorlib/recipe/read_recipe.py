"""Reading of recipes for a data set: every name and file in a recipe must exist, and every error names the choices."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

from factorlib.dataset.check import MESHES
from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import Dataset, MeshInstance
from factorlib.errors import InputError, did_you_mean
from factorlib.recipe import kinds
from factorlib.recipe.kinds import BALL, KINDS, AnyRecipe, is_light_file, is_mesh_file, materials_of
from factorlib.yamlfile import load_yaml, read_yaml


def read_recipe(path: Path, dataset: Dataset) -> AnyRecipe:
    """Read the recipe in a file; InputError if it is invalid or refers to something that the data set lacks."""
    refuse = Refusal(path, path.parent)
    content = load_yaml(path)
    kind = content.get("kind") if isinstance(content, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        refuse(
            "kind",
            "the recipe does not say what kind of picture to make" if kind is None else f"there is no kind {kind!r}",
            did_you_mean(str(kind), KINDS),
        )
    recipe = read_yaml(path, KINDS[kind])
    objects = {photo.name: photo.objects for photo in dataset.spec.photos}
    check_recipe(recipe, path, objects, {photo.light for photo in dataset.spec.photos}, dataset.spec.materials)
    return recipe


def check_recipe(
    recipe: AnyRecipe,
    path: Path,
    objects: Mapping[str, Sequence[MeshInstance]],
    lights: Collection[str],
    materials: list[str],
) -> None:
    """Check a recipe against a data set.

    Args:
        recipe: the recipe
        path: the recipe's file, which errors name and to which its files are relative
        objects: objects of each photo
        lights: names of the lights of all photos
        materials: materials of the data set

    Raises:
        InputError: The recipe refers to something that the data set lacks.
    """
    refuse = Refusal(path, path.parent)
    photos = list(objects)
    meshes = sorted({obj.mesh for each in objects.values() for obj in each})
    for name, file in files_of(recipe, path).items():
        if not file.is_file():
            raise InputError(
                f"there is no file {name!r}",
                file=path,
                cure=f"paths are relative to the recipe; meshes without a file are {', '.join([BALL, *meshes])}",
            )
    if isinstance(recipe, kinds.PhotoRecipe):
        _check_photos(recipe, photos, refuse)
    if isinstance(recipe, kinds.RelightRecipe | kinds.GridRecipe):
        _check_names(refuse, "lights", [name for name in recipe.lights if not is_light_file(name)], photos, "photo")
    if isinstance(recipe, kinds.RelightRecipe):
        _check_distinct(refuse, "lights", [Path(name).stem for name in recipe.lights], "light")
        if not recipe.lights and len(lights) == 1:
            refuse(
                "lights",
                f"the photos share one light, '{next(iter(lights))}', so there is no other to relight by",
                "name light maps: `lights: [studio.hdr]`, lat-long .hdr or .exr files, relative to the recipe",
            )
    if isinstance(recipe, kinds.TransferRecipe | kinds.GridRecipe):
        _check_names(refuse, "materials", recipe.materials, materials, "material")
    if isinstance(recipe, kinds.TransferRecipe | kinds.InsertRecipe) and recipe.table is not None:
        table = recipe.table
        materials = [*materials, *materials_of(table, path.parent / table if isinstance(table, str) else path)]
    if isinstance(recipe, kinds.TransferRecipe):
        _check_names(refuse, "materials", recipe.materials.values(), materials, "material")
    if isinstance(recipe, kinds.InsertRecipe):
        _check_new_object(recipe, objects, meshes, materials, refuse)


def _check_names(refuse: Refusal, key: str, names: Iterable[str], known: list[str], kind: str) -> None:
    for name in names:
        refuse.check_known(key, name, known, kind)


def _check_distinct(refuse: Refusal, key: str, names: list[str], kind: str) -> None:
    for name in names:
        if names.count(name) > 1:
            refuse(key, f"the {kind} {name!r} is named twice: one picture would replace the other", "name it once")


def _check_photos(recipe: kinds.PhotoRecipe, photos: list[str], refuse: Refusal) -> None:
    """Check the photos, the size, the camera and the assumed sun of a recipe."""
    _check_names(refuse, "photos", recipe.photos, photos, "photo")
    _check_distinct(refuse, "photos", recipe.photos, "photo")
    if isinstance(recipe, kinds.ResizedRecipe):
        refuse.refuse_if(
            recipe.across is not None and recipe.width is not None,
            "across",
            "cannot be combined with width",
            "keep across, which crops to the objects, or width, which shows the whole frame",
        )
    if isinstance(recipe, kinds.ViewedRecipe) and recipe.camera is not None:
        _check_camera(recipe, recipe.camera, photos, refuse)
    if recipe.sun is None:
        return
    if isinstance(recipe, kinds.RelightRecipe):
        refuse("sun", "a recipe of kind relight takes its lights from `lights`", "remove `sun`")
    if len(recipe.photos) != 1:
        refuse(
            "sun.direction",
            f"the direction is relative to the light of one photo, and the recipe has {len(recipe.photos) or 'all'}",
            "name one photo: `photos: [...]`",
        )
    if not any(recipe.sun.direction):
        refuse("sun.direction", "the direction has no length", "give a vector other than [0, 0, 0]")


def _check_camera(recipe: kinds.ViewedRecipe, camera: kinds.ViewCamera, photos: list[str], refuse: Refusal) -> None:
    refuse.refuse_if(
        (camera.photo is None) == (camera.pose is None),
        "camera",
        "needs exactly one of photo and pose",
        "write `camera: {photo: NAME}`, or `camera: {pose: [[r, r, r, t], [r, r, r, t], [r, r, r, t]]}`",
    )
    usual = type(recipe)()
    moved = [name for name in ("azimuth", "elevation", "zoom") if getattr(recipe, name) != getattr(usual, name)]
    refuse.refuse_if(moved, "camera", f"cannot be combined with {' and '.join(moved)}", "keep one of the two")
    if camera.photo is not None:
        refuse.check_known("camera.photo", camera.photo, photos, "photo")
    if camera.pose is not None:
        refuse.check_rotation("camera.pose", tuple(row[:3] for row in camera.pose))


def _check_new_object(
    recipe: kinds.InsertRecipe,
    objects: Mapping[str, Sequence[MeshInstance]],
    meshes: list[str],
    materials: list[str],
    refuse: Refusal,
) -> None:
    """Check the mesh and the materials of a new object, and that every photo has the object beside which it stands."""
    for photo in recipe.photos or objects if recipe.beside is not None else ():
        names = [obj.name for obj in objects[photo]]
        if recipe.beside not in names:
            refuse(
                "beside",
                f"there is no object {recipe.beside!r} in photo '{photo}', "
                f"whose objects are: {', '.join(names) or 'none'}",
                "name the photos that have it: `photos: [...]`",
            )
    if isinstance(recipe.material, dict):
        _check_names(refuse, "material", recipe.material.values(), materials, "material")
        if recipe.mesh not in meshes:
            refuse(
                "material",
                f"materials of parts can be replaced in a mesh of the data set only, and {recipe.mesh!r} is none",
                "name one material",
            )
    elif recipe.material is not None:
        refuse.check_known("material", recipe.material, materials, "material")
    if not is_mesh_file(recipe.mesh):
        refuse.check_known("mesh", recipe.mesh, [BALL, *meshes], "mesh")
    elif Path(recipe.mesh).suffix.lower() not in MESHES:
        refuse("mesh", f"{recipe.mesh!r} is not a mesh file that can be read", f"give one of {', '.join(MESHES)}")


def files_of(recipe: AnyRecipe, path: Path) -> dict[str, Path]:
    """Return the absolute paths of the files that a recipe names, by the names it uses."""
    named = [name for name in getattr(recipe, "lights", []) if is_light_file(name)]
    named += [name for name in [getattr(recipe, "table", None)] if isinstance(name, str)]
    named += [name for name in [getattr(recipe, "mesh", "")] if is_mesh_file(name)]
    return {name: Path(os.path.abspath(path.parent / name)) for name in named}
