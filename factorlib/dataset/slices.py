"""The slice of a dataset that a stage sees: its facts (JSON-able) and the files these name.

A step's key holds the slices it declares and the hashes of their files, so a slice carries only what its readers
need, with defaults filled in: naming the default illumination, or reordering photos, changes no photo's facts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from factorlib.dataset import schema
from factorlib.dataset.read import truth_paths
from factorlib.dataset.schema import Dataset, PhotoEntry
from factorlib.errors import did_you_mean


class Slice(msgspec.Struct, frozen=True):
    """facts: plain JSON-able values; files: the dataset-relative paths in them, sorted, each once.

    fields: the same facts, all of them, by the names that they have in dataset.yaml, as in photos.kitchen.camera.focal_px
    """

    facts: Any
    files: list[str]
    fields: dict[str, Any]


def dataset_slice(dataset: Dataset, name: str, photo: str | None = None) -> Slice:
    """The slice `name` of one photo, or of the set.

    photo, objects, light, ground are per photo: the facts of one, or {photo: facts} of all for `photo=None`.
    materials, set, truth are of the set, whatever the photo.  Raises KeyError for an unknown slice.
    """
    if name in _OF_SET:
        facts, files = _OF_SET[name](dataset)
        facts = _json_able(facts)
        fields = _fields(facts, name) if name in ("materials", "truth") else _fields_of_set(facts)
    elif name not in _OF_PHOTO:
        raise KeyError(f"no slice 'dataset.{name}': {did_you_mean(name, SLICES)}")
    elif photo is not None:
        facts, files = _OF_PHOTO[name](dataset, dataset.photo(photo))
        facts = _json_able(facts)
        fields = _fields_of_photo(facts, photo)
    else:
        parts = {entry.name: _OF_PHOTO[name](dataset, entry) for entry in dataset.spec.photos}
        facts = _json_able({key: part[0] for key, part in parts.items()})
        files = [file for part in parts.values() for file in part[1]]
        fields = {name: value for key, part in facts.items() for name, value in _fields_of_photo(part, key).items()}
    return Slice(facts=facts, files=sorted(set(files)), fields=fields)


def _photo(dataset: Dataset, photo: PhotoEntry) -> tuple[schema.PhotoSlice, list[str]]:
    facts = schema.PhotoSlice(
        image=photo.image,
        encoding=photo.encoding,
        masks=photo.masks,
        focal_px=photo.camera.focal_px if photo.camera else None,
        illumination=photo.illumination or photo.name,
        objects=[schema.ObjectMask(obj.name, obj.mask) for obj in photo.objects],
    )
    masks = [photo.masks] if isinstance(photo.masks, str) else list(photo.masks.values())
    return facts, [photo.image, *masks, *_object_masks(photo)]


def _objects(dataset: Dataset, photo: PhotoEntry) -> tuple[schema.ObjectsSlice, list[str]]:
    meshes = {obj.mesh: dataset.spec.meshes[obj.mesh] for obj in photo.objects}
    camera = photo.camera or schema.Camera()
    facts = schema.ObjectsSlice(
        camera=camera, objects=photo.objects, meshes=meshes, external=dataset.external.get(photo.name)
    )
    files = [path for name, mesh in meshes.items() for path in (mesh.file, *dataset.companions.get(name, ()))]
    return facts, files + _object_masks(photo)


def _light(dataset: Dataset, photo: PhotoEntry) -> tuple[schema.LightSlice, list[str]]:
    return schema.LightSlice(photo.illumination or photo.name, photo.world_from_camera), []


def _ground(dataset: Dataset, photo: PhotoEntry) -> tuple[schema.GroundSlice, list[str]]:
    return schema.GroundSlice(photo.ground), []


def _materials(dataset: Dataset) -> tuple[list[str], list[str]]:
    return dataset.spec.materials, []


def _set(dataset: Dataset) -> tuple[schema.SetSlice, list[str]]:
    spec = dataset.spec
    return schema.SetSlice(dataset.name, spec.materials, spec.meshes, [photo.name for photo in spec.photos]), []


def _truth(dataset: Dataset) -> tuple[schema.TruthFile | None, list[str]]:
    return dataset.truth, truth_paths(dataset.truth) if dataset.truth else []


def _object_masks(photo: PhotoEntry) -> list[str]:
    return [obj.mask for obj in photo.objects if obj.mask]


def _json_able(facts: Any) -> Any:
    return msgspec.json.decode(msgspec.json.encode(facts))


# ── facts by their names in dataset.yaml ─────────────────────────────────────────────────────────────────────────────


def _fields_of_photo(facts: dict[str, Any], photo: str) -> dict[str, Any]:
    """Most are keys of the photo; meshes stand beside the photos, and `external` comes from the source of cameras."""
    places = {"focal_px": f"photos.{photo}.camera.focal_px", "meshes": "meshes", "external": f"cameras.{photo}"}
    parts = [_fields(value, places.get(key, f"photos.{photo}.{key}")) for key, value in facts.items()]
    return {name: value for part in parts for name, value in part.items()}


def _fields_of_set(facts: dict[str, Any]) -> dict[str, Any]:
    return {
        name: value
        for key, part in facts.items()
        for name, value in _fields(part, "the folder's name" if key == "name" else key).items()
    }


def _fields(value: Any, name: str) -> dict[str, Any]:
    """
    >>> _fields([{"name": "a", "mask": None}], "objects")
    {'objects[0].name': 'a', 'objects[0].mask': None}
    """
    if value and isinstance(value, dict):
        items = [(f"{name}.{key}", item) for key, item in value.items()]
    elif value and isinstance(value, list) and all(isinstance(item, dict) for item in value):
        items = [(f"{name}[{index}]", item) for index, item in enumerate(value)]
    else:
        return {name: value}
    return {key: leaf for inner, item in items for key, leaf in _fields(item, inner).items()}


_OF_PHOTO: dict[str, Callable] = {"photo": _photo, "objects": _objects, "light": _light, "ground": _ground}
_OF_SET: dict[str, Callable] = {"materials": _materials, "set": _set, "truth": _truth}
SLICES = (*_OF_PHOTO, *_OF_SET)
