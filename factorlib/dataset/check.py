"""What can be wrong with a dataset without opening a single image or mesh; each is refused with its key and a cure.

`check_dataset` and `check_truth` walk a decoded file once and raise at the first rule that does not hold; `check_lights`
follows once cameras that are known from elsewhere have been read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path

from factorlib.dataset.numbers import check_centre, check_focal, check_numbers, check_rotation, check_share, check_unit
from factorlib.dataset.paths import Refusal, check_folder, check_path
from factorlib.dataset.schema import (
    ENCODINGS,
    FORMAT,
    MAX_MATERIALS,
    RAW,
    SOURCES,
    CameraSource,
    DatasetFile,
    Ground,
    MeshEntry,
    ObjectEntry,
    PhotoEntry,
    TrueMaterial,
    TruthFile,
)
from factorlib.errors import did_you_mean

NAME = re.compile(r"[A-Za-z0-9_-]+")
LONGEST_NAME = 100  # characters; names of files are made of it, and file systems allow these 255 bytes
IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".hdr", ".heic", ".heif", ".hif", *RAW)
MASKS = (".png", ".json")
ONE_PART = (".ply", ".stl", ".off")  # their one part goes by the file's own name
MESHES = (".obj", ".gltf", ".glb", *ONE_PART)
MAPS = (".exr", ".hdr")
RESERVED_PHOTOS = ("photos", "poses")  # `<photo>.json` would be the gathered photos.json, poses.json
LEAST_KEYPOINTS, GOOD_KEYPOINTS = 4, 6
LEAST_OFF_LINE = 1e-3  # of the keypoints' extent


def check_dataset(spec: DatasetFile, file: Path) -> None:
    """Raise InputError, naming `file`, key and cure, unless everything in dataset.yaml holds together."""
    refuse = Refusal(file, file.parent)
    if spec.format != FORMAT:
        refuse("format", f"format {spec.format} is not known", f"this version reads format: {FORMAT}")
    check_numbers(spec, refuse)
    _check_materials(spec.materials, refuse)
    for name, mesh in spec.meshes.items():
        _check_mesh(name, mesh, spec.materials, refuse)
    if not spec.photos:
        refuse("photos", "there are no photos", "add at least one: {name: …, image: …, masks: …}")
    _check_unique("photos", (photo.name for photo in spec.photos), "photo", refuse)
    for index, photo in enumerate(spec.photos):
        _check_photo(f"photos[{index}]", photo, spec, refuse)
    if spec.cameras is not None:
        _check_source(spec.cameras, spec, refuse)
    if spec.truth is not None:
        check_path("truth", spec.truth, (".yaml", ".yml"), refuse, must_exist=False)


def check_truth(truth: TruthFile, spec: DatasetFile, file: Path, folder: Path) -> None:
    """The same for truth.yaml: every name in it is one of the dataset's, every map a path inside `folder`."""
    refuse = Refusal(file, folder)
    check_numbers(truth, refuse)
    photos = {photo.name: photo for photo in spec.photos}
    lights = {photo.illumination or photo.name for photo in spec.photos}
    for name, material in truth.materials.items():
        check_known(f"materials.{name}", name, spec.materials, "material", refuse)
        _check_true_material(f"materials.{name}", material, refuse)
    for group, known, kind in (("illumination", lights, "illumination"), ("normals", photos, "photo")):
        for name, path in getattr(truth, group).items():
            check_known(f"{group}.{name}", name, known, kind, refuse)
            check_path(f"{group}.{name}", path, MAPS, refuse, must_exist=False)
    for name, poses in truth.poses.items():
        check_known(f"poses.{name}", name, photos, "photo", refuse)
        for obj, pose in poses.items():
            check_known(f"poses.{name}.{obj}", obj, [o.name for o in photos[name].objects], "object", refuse)
            check_rotation(f"poses.{name}.{obj}.rotation", pose.rotation, refuse)


def _check_true_material(key: str, material: TrueMaterial, refuse: Refusal) -> None:
    for name in ("diffuse", "specular"):
        for channel, share in enumerate(getattr(material, name)):
            check_share(f"{key}.{name}[{channel}]", share, refuse)
    check_share(f"{key}.roughness", material.roughness, refuse)


def _check_name(key: str, name: str, refuse: Refusal) -> None:
    if not NAME.fullmatch(name):
        refuse(key, f"{name!r} is not a name", "names are made of A-Z a-z 0-9 _ and -, for they name files")
    if len(name) > LONGEST_NAME:
        fault = f"the name {name[:20]}… has {len(name)} characters"
        refuse(key, fault, f"names have at most {LONGEST_NAME}, for they name files")


def check_known(key: str, name: str, known: Iterable[str], kind: str, refuse: Refusal) -> None:
    """Refuse a name that is not among `known`, and suggest the nearest one."""
    known = list(known)
    if name not in known:
        refuse(
            key, f"unknown {kind} {name!r}", did_you_mean(name, known) if known else f"the dataset has no {kind} here"
        )


def _check_unique(key: str, names: Iterable[str], kind: str, refuse: Refusal) -> None:
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        if name in first:
            fault = f"duplicate {kind} name {name!r}"
            refuse(f"{key}[{index}].name", fault, f"{key}[{first[name]}] has it already: rename one")
        first[name] = index


def _check_materials(materials: list[str], refuse: Refusal) -> None:
    if not 0 < len(materials) <= MAX_MATERIALS:
        refuse("materials", f"{len(materials)} materials", f"give 1 to {MAX_MATERIALS}: a mask has no more labels")
    for index, name in enumerate(materials):
        _check_name(f"materials[{index}]", name, refuse)
        if name in materials[:index]:
            fault = f"material {name!r} is named twice"
            refuse(f"materials[{index}]", fault, "label k is the k-th material: name each once")


def _check_mesh(name: str, mesh: MeshEntry, materials: list[str], refuse: Refusal) -> None:
    key = f"meshes.{name}"
    _check_name(key, name, refuse)
    check_path(f"{key}.file", mesh.file, MESHES, refuse)
    if mesh.parts and mesh.material is not None:
        refuse(
            key, "has both parts and a material", "keep `parts: {part: material, …}`, or `material:` for a mesh of one"
        )
    if not mesh.parts and mesh.material is None:
        refuse(key, "has neither parts nor a material", "add `material: …`, or `parts: {part: material, …}`")
    if mesh.material is not None:
        check_known(f"{key}.material", mesh.material, materials, "material", refuse)
    for part, material in (mesh.parts or {}).items():
        _check_part(f"{key}.parts.{part}", part, mesh, refuse)
        check_known(f"{key}.parts.{part}", material, materials, "material", refuse)


def _check_part(key: str, part: str, mesh: MeshEntry, refuse: Refusal) -> None:
    """A file of one part has no other; which parts the others have, only reading them shows."""
    file = Path(mesh.file)
    if file.suffix.lower() in ONE_PART and part != file.stem:
        fault = f"{file.name} has no part {part!r}"
        refuse(key, fault, f"it has one, {file.stem!r}; for several, save the mesh as OBJ or glTF")


def _check_ground(key: str, ground: Ground, refuse: Refusal) -> None:
    if not any(ground.normal):
        fault = "a normal of length 0"
        refuse(f"{key}.normal", fault, "write the direction that points up from the ground, in the camera's axes")
    if sum(n * p for n, p in zip(ground.normal, ground.point, strict=True)) >= 0:
        fault = "it points away from the camera, or the camera lies in the plane"
        refuse(f"{key}.normal", fault, "turn its sign: it points toward the objects")
    for value in ground.diffuse or ():
        check_share(f"{key}.diffuse", value, refuse)


def _check_photo(key: str, photo: PhotoEntry, spec: DatasetFile, refuse: Refusal) -> None:
    _check_name(f"{key}.name", photo.name, refuse)
    if photo.name in RESERVED_PHOTOS:
        refuse(f"{key}.name", f"the name {photo.name!r} is taken by a file of the results", "rename the photo")
    check_path(f"{key}.image", photo.image, IMAGES, refuse)
    if photo.encoding is not None:
        check_known(f"{key}.encoding", photo.encoding, ENCODINGS, "encoding", refuse)
    if photo.illumination is not None:
        _check_name(f"{key}.illumination", photo.illumination, refuse)
    if photo.world_from_camera is not None:
        check_rotation(f"{key}.world_from_camera", photo.world_from_camera, refuse)
    if photo.ground is not None:
        _check_ground(f"{key}.ground", photo.ground, refuse)
    if photo.camera is not None and photo.camera.focal_px is not None:
        check_focal(f"{key}.camera.focal_px", photo.camera.focal_px, refuse)
    if photo.camera is not None and photo.camera.principal_point is not None:
        check_centre(f"{key}.camera.principal_point", photo.camera.principal_point, refuse)
    _check_masks(f"{key}.masks", photo, spec.materials, refuse)
    if not photo.objects:
        fault = f"photo {photo.name!r} has no objects"
        refuse(f"{key}.objects", fault, "add {name: …, mesh: …}: a mesh gives its pixels their normals")
    _check_unique(f"{key}.objects", (obj.name for obj in photo.objects), "object", refuse)
    for index, obj in enumerate(photo.objects):
        _check_object(f"{key}.objects[{index}]", obj, spec, refuse)


def _check_masks(key: str, photo: PhotoEntry, materials: list[str], refuse: Refusal) -> None:
    if isinstance(photo.masks, str):
        return check_path(key, photo.masks, MASKS, refuse)
    if not photo.masks:
        refuse(key, "names no mask", "give a label PNG, a COCO json, or {material: mask.png, …}")
    for material, path in photo.masks.items():
        check_known(f"{key}.{material}", material, materials, "material", refuse)
        check_path(f"{key}.{material}", path, (".png",), refuse)


def _check_object(key: str, obj: ObjectEntry, spec: DatasetFile, refuse: Refusal) -> None:
    _check_name(f"{key}.name", obj.name, refuse)
    check_known(f"{key}.mesh", obj.mesh, spec.meshes, "mesh", refuse)
    mesh = spec.meshes[obj.mesh]
    for part, material in obj.materials.items():
        _check_part(f"{key}.materials.{part}", part, mesh, refuse)
        if mesh.parts:
            check_known(f"{key}.materials.{part}", part, mesh.parts, "part", refuse)
        check_known(f"{key}.materials.{part}", material, spec.materials, "material", refuse)
    if obj.mask is not None:
        check_path(f"{key}.mask", obj.mask, (".png",), refuse)
    if obj.pose is not None:
        check_rotation(f"{key}.pose.rotation", obj.pose.rotation, refuse)
    if obj.keypoints:
        _check_keypoints(f"{key}.keypoints", obj, refuse)


def _check_keypoints(key: str, obj: ObjectEntry, refuse: Refusal) -> None:
    """Enough of them, of different places, and not all on a line, about which the object could turn."""
    if obj.pose is not None:
        fault = "has both a pose and keypoints"
        refuse(key, fault, "keep one: a pose is used as it is, keypoints are where the search begins")
    if len(obj.keypoints) < LEAST_KEYPOINTS:
        cure = f"give {LEAST_KEYPOINTS} or more; {GOOD_KEYPOINTS} where the focal length is unknown"
        refuse(key, f"{len(obj.keypoints)} keypoints do not settle a pose", cure)
    for name in ("pixel", "point"):
        _check_spread(key, name, [getattr(keypoint, name) for keypoint in obj.keypoints], refuse)


def _check_spread(key: str, name: str, places: list[tuple[float, ...]], refuse: Refusal) -> None:
    first: dict[tuple[float, ...], int] = {}
    for index, place in enumerate(places):
        other = first.setdefault(place, index)
        if other != index:
            refuse(f"{key}[{index}].{name}", f"the same as {key}[{other}]'s", "name each place once")
    arms = [[x - x0 for x, x0 in zip(place, places[0])] for place in places[1:]]
    longest = max(arms, key=lambda arm: math.hypot(*arm))
    unit = [x / math.hypot(*longest) for x in longest]
    along = [sum(x * u for x, u in zip(arm, unit)) for arm in arms]
    off = [math.hypot(*(x - length * u for x, u in zip(arm, unit))) for arm, length in zip(arms, along)]
    if max(off) < LEAST_OFF_LINE * math.hypot(*longest):
        fault = f"every {name} lies on one line"
        refuse(key, fault, "name places in different directions: about a line the object could turn")


def _check_source(source: CameraSource, spec: DatasetFile, refuse: Refusal) -> None:
    """One source, its path inside the folder, and every photo, object and mesh it names one of the dataset's."""
    named = [kind for kind in SOURCES if getattr(source, kind) is not None]
    if len(named) != 1:
        refuse("cameras", f"names {' and '.join(named) or 'no source'}", f"name one of {', '.join(SOURCES)}")
    kind, path = named[0], getattr(source, named[0])
    if kind == "transforms":
        check_path("cameras.transforms", path, (".json",), refuse)
    else:
        check_folder(f"cameras.{kind}", path, refuse)
    for key in ("world_from_object", "world_from_camera") if kind == "bop" else ("obj_ids", "mesh_unit_mm"):
        if getattr(source, key) != getattr(CameraSource(), key):
            cure = (
                "a BOP scene gives poses by obj_ids"
                if kind == "bop"
                else "for this source, world_from_object gives poses"
            )
            refuse(f"cameras.{key}", f"does not go with {kind}", f"leave it out: {cure}")
    for name in source.images:
        check_known(f"cameras.images.{name}", name, [photo.name for photo in spec.photos], "photo", refuse)
    for name, similarity in source.world_from_object.items():
        key = f"cameras.world_from_object.{name}"
        check_known(key, name, {obj.name: None for photo in spec.photos for obj in photo.objects}, "object", refuse)
        check_rotation(f"{key}.rotation", similarity.rotation, refuse)
        check_unit(f"{key}.scale", similarity.scale, refuse)
    for name in source.obj_ids:
        check_known(f"cameras.obj_ids.{name}", name, spec.meshes, "mesh", refuse)
    check_unit("cameras.mesh_unit_mm", source.mesh_unit_mm, refuse)


def check_lights(photos: list[PhotoEntry], file: Path) -> None:
    """Photos that share a light are all fixed to the camera, or all to the world."""
    refuse = Refusal(file, file.parent)
    first: dict[str, int] = {}
    for index, photo in enumerate(photos):
        light = photo.illumination or photo.name
        other = first.setdefault(light, index)
        if (photos[other].world_from_camera is None) != (photo.world_from_camera is None):
            refuse(
                f"photos[{index}].world_from_camera",
                f"of the photos in illumination {light!r}, only one of {photos[other].name!r} and {photo.name!r} has it",
                "give it for every photo that shares a light fixed to the world, or for none (a light fixed to the camera)",
            )
