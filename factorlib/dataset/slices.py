"""Slices of a dataset that stages receive: facts (JSON-able) and the files that these name.

The key of a step holds the slices it declares and the hashes of their files.  A slice therefore carries only what its
readers need, with defaults filled in.  Naming the default illumination, or reordering photos, changes no photo's facts.
"""

from collections.abc import Callable
from typing import Any

import msgspec

from factorlib.dataset import schema
from factorlib.dataset.check import instance_materials, mirror_balls
from factorlib.dataset.paths import labelmap_beside
from factorlib.dataset.schema import Dataset, PhotoEntry
from factorlib.errors import did_you_mean


class DatasetSlice(msgspec.Struct, frozen=True):
    """A slice of a dataset.

    Attributes:
        facts: plain JSON-able values
        files: the dataset-relative paths in them, sorted and distinct
        fields: all facts by their keys in dataset.yaml, such as photos.kitchen.camera.focal_px
    """

    facts: Any
    files: list[str]
    fields: dict[str, Any]


def dataset_slice(dataset: Dataset, name: str, photo: str | None = None) -> DatasetSlice:
    """Return a slice of one photo, or of the set.

    The slices photo, objects, light and ground are per photo.  The slices materials, set, shapes, known and truth are
    of the set.

    Args:
        dataset: the dataset
        name: name of the slice
        photo: name of the photo; None returns facts by photo; ignored for slices of the set

    Raises:
        KeyError: There is no such slice.
    """
    fields: dict[str, Any] = {}
    if name in _SET_SLICES:
        facts, files = _SET_SLICES[name](dataset)
        facts = _json_able(facts)
        for key, part in facts.items() if name == "set" else [(name, facts)]:
            fields |= _fields(part, "the folder's name" if (name, key) == ("set", "name") else key)
    elif name in _PHOTO_SLICES:
        names = [photo] if photo is not None else [entry.name for entry in dataset.spec.photos]
        slices = {each: _PHOTO_SLICES[name](dataset, dataset.photo(each)) for each in names}
        files = [file for _, photo_files in slices.values() for file in photo_files]
        facts = {each: _json_able(photo_facts) for each, (photo_facts, _) in slices.items()}
        for each, photo_facts in facts.items():
            places = {"focal_px": f"photos.{each}.camera.focal_px", "meshes": "meshes", "external": f"cameras.{each}"}
            for key, value in photo_facts.items():
                fields |= _fields(value, places.get(key, f"photos.{each}.{key}"))
        facts = facts if photo is None else facts[photo]
    else:
        raise KeyError(f"no slice 'dataset.{name}': {did_you_mean(name, SLICES)}")
    return DatasetSlice(facts=facts, files=sorted(set(files)), fields=fields)


def _photo(dataset: Dataset, photo: PhotoEntry) -> tuple[schema.PhotoSlice, list[str]]:
    facts = schema.PhotoSlice(
        image=photo.image,
        encoding=photo.encoding,
        masks=photo.masks,
        labels=dataset.spec.materials,
        focal_px=photo.camera.focal_px if photo.camera else None,
        illumination=photo.light,
        objects=[schema.ObjectMask(obj.name, obj.mask) for obj in photo.objects],
        camera=photo.camera if photo.camera and photo.camera.distortion else None,
    )
    masks = list(photo.masks.values()) if isinstance(photo.masks, dict) else [photo.masks]
    if isinstance(photo.masks, str) and (labelmap := labelmap_beside(photo.masks, dataset.folder)):
        masks.append(labelmap)
    return facts, [photo.image, *masks, *_object_masks(photo)]


def _objects(dataset: Dataset, photo: PhotoEntry) -> tuple[schema.ObjectsSlice, list[str]]:
    meshes = {obj.mesh: dataset.spec.meshes[obj.mesh] for obj in photo.objects}
    camera = photo.camera or schema.Intrinsics()
    facts = schema.ObjectsSlice(camera, photo.objects, meshes, dataset.external.get(photo.name))
    files = [path for name, mesh in meshes.items() for path in (mesh.file, *dataset.companions.get(name, ())) if path]
    return facts, files + _object_masks(photo)


def _light(dataset: Dataset, photo: PhotoEntry) -> tuple[schema.LightSlice, list[str]]:
    rejoins = photo.name == dataset.test_photo
    return schema.LightSlice(photo.light, photo.world_from_camera, photo.held_out or rejoins, rejoins), []


def _known(dataset: Dataset) -> tuple[schema.KnownSlice, list[str]]:
    known = dataset.spec.known
    balls = {}
    for name, light in known.illumination.items():
        if isinstance(light, schema.MirrorBall):
            photo, obj = next(mirror_balls(dataset.spec, name, light))
            balls[name] = schema.BallSlice(photo.name, *instance_materials(obj, dataset.spec))
    maps = {name: light for name, light in known.illumination.items() if isinstance(light, str)}
    return schema.KnownSlice(known.materials, maps, balls, known.exposure), list(maps.values())


def _shapes(dataset: Dataset) -> tuple[schema.ShapesSlice | None, list[str]]:
    """Return the slice, or None if every mesh has a file and no camera is to be estimated."""
    meshes = {name: mesh for name, mesh in dataset.spec.meshes.items() if not mesh.file}
    sfm = dataset.spec.cameras is not None and dataset.spec.cameras.sfm
    if not meshes and not sfm:
        return None, []
    shows = [photo for photo in dataset.spec.photos if sfm or any(obj.mesh in meshes for obj in photo.objects)]
    return schema.ShapesSlice(meshes, {photo.name: _objects(dataset, photo)[0] for photo in shows}, sfm), []


def _object_masks(photo: PhotoEntry) -> list[str]:
    return [obj.mask for obj in photo.objects if obj.mask]


def _json_able(facts: Any) -> Any:
    return msgspec.json.decode(msgspec.json.encode(facts))


def _fields(value: Any, name: str) -> dict[str, Any]:
    """Return the leaves of a value by their keys.

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


_PHOTO_SLICES: dict[str, Callable[[Dataset, PhotoEntry], tuple[Any, list[str]]]] = {
    "photo": _photo,
    "objects": _objects,
    "light": _light,
    "ground": lambda dataset, photo: (schema.GroundSlice(photo.ground), []),
}
_SET_SLICES: dict[str, Callable[[Dataset], tuple[Any, list[str]]]] = {
    "materials": lambda dataset: (dataset.spec.distinct_materials, []),
    "set": lambda dataset: (
        schema.SetSlice(
            dataset.name,
            dataset.spec.distinct_materials,
            dataset.spec.meshes,
            [photo.name for photo in dataset.spec.photos],
            dataset.up,
        ),
        [],
    ),
    "shapes": _shapes,
    "known": _known,
    "truth": lambda dataset: (dataset.truth, dataset.truth.maps if dataset.truth else []),
}
SLICES = (*_PHOTO_SLICES, *_SET_SLICES)
