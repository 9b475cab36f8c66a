"""The rules of a dataset that its types do not say and no image or mesh must be opened for, each with its key and a cure.

`check_dataset` and `check_truth` walk a decoded file once and raise at the first rule that does not hold; `check_lights`
follows once cameras that are known from elsewhere have been read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from factorlib.dataset.paths import Refusal, check_folder, check_path
from factorlib.dataset.schema import (
    RAW,
    SOURCES,
    CameraSource,
    DatasetFile,
    Ground,
    MeshEntry,
    ObjectEntry,
    PhotoEntry,
    TruthFile,
)

IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".hdr", ".heic", ".heif", ".hif", *RAW)
MASKS = (".png", ".json")
ONE_PART = (".ply", ".stl", ".off")  # their one part goes by the file's own name
MESHES = (".obj", ".gltf", ".glb", *ONE_PART)
MAPS = (".exr", ".hdr")
RESERVED_PHOTOS = ("photos", "poses")  # `<photo>.json` would be the gathered photos.json, poses.json
LEAST_KEYPOINTS, GOOD_KEYPOINTS = 4, 6
LEAST_OFF_LINE = 1e-3  # of the keypoints' extent
ROTATION_TOLERANCE = 1e-3  # largest entry of RᵀR − 1: matrices typed with four digits pass


def check_dataset(spec: DatasetFile, file: Path) -> None:
    """Raise InputError, naming `file`, key and cure, unless everything in dataset.yaml holds together."""
    refuse = Refusal(file, file.parent)
    for index, name in enumerate(spec.materials):
        if name in spec.materials[:index]:
            fault = f"material {name!r} is named twice"
            refuse(f"materials[{index}]", fault, "label k is the k-th material: name each once")
    for name, mesh in spec.meshes.items():
        _check_mesh(f"meshes.{name}", mesh, spec.materials, refuse)
    _check_unique("photos", (photo.name for photo in spec.photos), "photo", refuse)
    for index, photo in enumerate(spec.photos):
        _check_photo(f"photos[{index}]", photo, spec, refuse)
    if spec.cameras is not None:
        _check_source(spec.cameras, spec, refuse)
    if spec.truth is not None:
        check_path("truth", spec.truth, (".yaml", ".yml"), refuse, must_exist=False)


def check_truth(truth: TruthFile, spec: DatasetFile, file: Path, folder: Path) -> None:
    """Raise InputError unless every name in truth.yaml is one of the dataset's, every map a path inside `folder`."""
    refuse = Refusal(file, folder)
    photos = {photo.name: photo for photo in spec.photos}
    lights = {photo.light for photo in spec.photos}
    for name in truth.materials:
        refuse.known(f"materials.{name}", name, spec.materials, "material")
    for group, known, kind in (("illumination", lights, "illumination"), ("normals", photos, "photo")):
        for name, path in getattr(truth, group).items():
            refuse.known(f"{group}.{name}", name, known, kind)
            check_path(f"{group}.{name}", path, MAPS, refuse, must_exist=False)
    for name, poses in truth.poses.items():
        refuse.known(f"poses.{name}", name, photos, "photo")
        for obj, pose in poses.items():
            refuse.known(f"poses.{name}.{obj}", obj, [o.name for o in photos[name].objects], "object")
            check_rotation(f"poses.{name}.{obj}.rotation", pose.rotation, refuse)


def check_lights(photos: list[PhotoEntry], file: Path) -> None:
    """Raise InputError unless photos that share a light are all fixed to the camera, or all to the world."""
    first: dict[str, PhotoEntry] = {}
    for index, photo in enumerate(photos):
        other = first.setdefault(photo.light, photo)
        if (other.world_from_camera is None) != (photo.world_from_camera is None):
            fault = (
                f"of the photos in illumination {photo.light!r}, only one of {other.name!r} and {photo.name!r} has it"
            )
            cure = "give it for every photo that shares a light fixed to the world, or for none (fixed to the camera)"
            Refusal(file, file.parent)(f"photos[{index}].world_from_camera", fault, cure)


def check_rotation(key: str, rows: tuple, refuse: Refusal) -> None:
    """Refuse three rows that are no rotation: RᵀR = 1 within ROTATION_TOLERANCE, determinant +1."""
    gram = [[sum(r[i] * r[j] for r in rows) - (i == j) for j in range(3)] for i in range(3)]
    worst = max(abs(entry) for row in gram for entry in row)
    if not worst <= ROTATION_TOLERANCE:
        fault = f"not a rotation: RᵀR differs from 1 by {worst:.3g}"
        refuse(key, fault, "its columns must be unit vectors at right angles (no scale)")
    a, b, c = rows
    if sum(a[i] * (b[(i + 1) % 3] * c[(i + 2) % 3] - b[(i + 2) % 3] * c[(i + 1) % 3]) for i in range(3)) < 0:
        fault = "not a rotation but a reflection (determinant −1)"
        refuse(key, fault, "one axis is flipped: the camera frame is x right, y down, z forward")


def _check_unique(key: str, names: Iterable[str], kind: str, refuse: Refusal) -> None:
    first: dict[str, int] = {}
    for index, name in enumerate(names):
        if first.setdefault(name, index) != index:
            fault = f"duplicate {kind} name {name!r}"
            refuse(f"{key}[{index}].name", fault, f"{key}[{first[name]}] has it already: rename one")


def _check_mesh(key: str, mesh: MeshEntry, materials: list[str], refuse: Refusal) -> None:
    check_path(f"{key}.file", mesh.file, MESHES, refuse)
    if mesh.parts and mesh.material is not None:
        cure = "keep `parts: {part: material, …}`, or `material:` for a mesh of one"
        refuse(key, "has both parts and a material", cure)
    if not mesh.parts and mesh.material is None:
        refuse(key, "has neither parts nor a material", "add `material: …`, or `parts: {part: material, …}`")
    if mesh.material is not None:
        refuse.known(f"{key}.material", mesh.material, materials, "material")
    _check_parts(f"{key}.parts", mesh.parts or {}, mesh, materials, refuse)


def _check_parts(key: str, parts: dict[str, str], mesh: MeshEntry, materials: list[str], refuse: Refusal) -> None:
    """A file of one part has no other; which parts the others have, only reading them shows."""
    file = Path(mesh.file)
    for part, material in parts.items():
        if file.suffix.lower() in ONE_PART and part != file.stem:
            fault = f"{file.name} has no part {part!r}"
            refuse(f"{key}.{part}", fault, f"it has one, {file.stem!r}; for several, save the mesh as OBJ or glTF")
        if mesh.parts:
            refuse.known(f"{key}.{part}", part, mesh.parts, "part")
        refuse.known(f"{key}.{part}", material, materials, "material")


def _check_photo(key: str, photo: PhotoEntry, spec: DatasetFile, refuse: Refusal) -> None:
    if photo.name in RESERVED_PHOTOS:
        refuse(f"{key}.name", f"the name {photo.name!r} is taken by a file of the results", "rename the photo")
    check_path(f"{key}.image", photo.image, IMAGES, refuse)
    if photo.world_from_camera is not None:
        check_rotation(f"{key}.world_from_camera", photo.world_from_camera, refuse)
    if photo.ground is not None:
        _check_ground(f"{key}.ground.normal", photo.ground, refuse)
    if isinstance(photo.masks, str):
        check_path(f"{key}.masks", photo.masks, MASKS, refuse)
    elif not photo.masks:
        refuse(f"{key}.masks", "names no mask", "give a label PNG, a COCO json, or {material: mask.png, …}")
    else:
        for material, path in photo.masks.items():
            refuse.known(f"{key}.masks.{material}", material, spec.materials, "material")
            check_path(f"{key}.masks.{material}", path, (".png",), refuse)
    if not photo.objects:
        fault = f"photo {photo.name!r} has no objects"
        refuse(f"{key}.objects", fault, "add {name: …, mesh: …}: a mesh gives its pixels their normals")
    _check_unique(f"{key}.objects", (obj.name for obj in photo.objects), "object", refuse)
    for index, obj in enumerate(photo.objects):
        _check_object(f"{key}.objects[{index}]", obj, spec, refuse)


def _check_ground(key: str, ground: Ground, refuse: Refusal) -> None:
    if not any(ground.normal):
        refuse(key, "a normal of length 0", "write the direction that points up from the ground, in the camera's axes")
    if sum(n * p for n, p in zip(ground.normal, ground.point, strict=True)) >= 0:
        fault = "it points away from the camera, or the camera lies in the plane"
        refuse(key, fault, "turn its sign: it points toward the objects")


def _check_object(key: str, obj: ObjectEntry, spec: DatasetFile, refuse: Refusal) -> None:
    refuse.known(f"{key}.mesh", obj.mesh, spec.meshes, "mesh")
    _check_parts(f"{key}.materials", obj.materials, spec.meshes[obj.mesh], spec.materials, refuse)
    if obj.mask is not None:
        check_path(f"{key}.mask", obj.mask, (".png",), refuse)
    if obj.pose is not None:
        check_rotation(f"{key}.pose.rotation", obj.pose.rotation, refuse)
    if obj.keypoints:
        _check_keypoints(f"{key}.keypoints", obj, refuse)


def _check_keypoints(key: str, obj: ObjectEntry, refuse: Refusal) -> None:
    """Enough of them, of different places, and not all on a line, about which the object could turn."""
    if obj.pose is not None:
        cure = "keep one: a pose is used as it is, keypoints are where the search begins"
        refuse(key, "has both a pose and keypoints", cure)
    if len(obj.keypoints) < LEAST_KEYPOINTS:
        cure = f"give {LEAST_KEYPOINTS} or more; {GOOD_KEYPOINTS} where the focal length is unknown"
        refuse(key, f"{len(obj.keypoints)} keypoints do not settle a pose", cure)
    for name in ("pixel", "point"):
        places, first = [getattr(keypoint, name) for keypoint in obj.keypoints], {}
        for index, place in enumerate(places):
            if (other := first.setdefault(place, index)) != index:
                refuse(f"{key}[{index}].{name}", f"the same as {key}[{other}]'s", "name each place once")
        arms = [[x - x0 for x, x0 in zip(place, places[0])] for place in places[1:]]
        longest = max(arms, key=lambda arm: math.hypot(*arm))
        unit = [x / math.hypot(*longest) for x in longest]
        along = [sum(x * u for x, u in zip(arm, unit)) for arm in arms]
        off = [math.hypot(*(x - length * u for x, u in zip(arm, unit))) for arm, length in zip(arms, along)]
        if max(off) < LEAST_OFF_LINE * math.hypot(*longest):
            cure = "name places in different directions: about a line the object could turn"
            refuse(key, f"every {name} lies on one line", cure)


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
    cure = "a BOP scene gives poses by obj_ids" if kind == "bop" else "for this source, world_from_object gives poses"
    for key in ("world_from_object", "world_from_camera") if kind == "bop" else ("obj_ids", "mesh_unit_mm"):
        if getattr(source, key) != getattr(CameraSource(), key):
            refuse(f"cameras.{key}", f"does not go with {kind}", f"leave it out: {cure}")
    objects = {obj.name for photo in spec.photos for obj in photo.objects}
    for key, known, of in (
        ("images", [photo.name for photo in spec.photos], "photo"),
        ("world_from_object", objects, "object"),
        ("obj_ids", spec.meshes, "mesh"),
    ):
        for name in getattr(source, key):
            refuse.known(f"cameras.{key}.{name}", name, known, of)
    for name, similarity in source.world_from_object.items():
        check_rotation(f"cameras.world_from_object.{name}.rotation", similarity.rotation, refuse)
