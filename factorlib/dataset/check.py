"""Checks of a dataset that its types do not express and that open no image or mesh, each with a key and a cure.

`check_dataset` reports all violations in a decoded file, `check_truth` the first.  `check_lights` runs after cameras
from external sources have been read.
"""

import math
from collections.abc import Iterator
from pathlib import Path

from factorlib.dataset.paths import Refusal, labelmap_beside
from factorlib.dataset.schema import (
    RAW,
    SOURCES,
    CameraSource,
    DatasetFile,
    GroundEntry,
    KnownMaterial,
    MeshEntry,
    MeshInstance,
    MirrorBall,
    PhotoEntry,
    TruthFile,
)
from factorlib.errors import raise_all

IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".exr", ".hdr", ".heic", ".heif", ".hif", *RAW)
MASK_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif", ".tga")
MASKS = (*MASK_IMAGES, ".json")
ONE_PART = (".ply", ".stl", ".off")  # formats with one part, which has the file's own name
MESHES = (".obj", ".gltf", ".glb", *ONE_PART)
MAPS = (".exr", ".hdr")
RESERVED_PHOTOS = ("photos", "poses")  # <photo>.json would collide with photos.json and poses.json
ALL_OF_IT = "all"  # the one part of a reconstructed shape
EXCLUDED = {  # keys that a source of cameras excludes, and why
    "colmap": (("obj_ids", "mesh_unit_mm"), "world_from_object gives its poses"),
    "transforms": (("obj_ids", "mesh_unit_mm"), "world_from_object gives its poses"),
    "bop": (("world_from_object", "world_from_camera"), "obj_ids gives its poses"),
    "sfm": (
        ("images", "world_from_object", "world_from_camera", "up", "obj_ids", "mesh_unit_mm"),
        "its world is not known beforehand",
    ),
}
LEAST_OUTLINES = 2  # least number of outlines of a hull, with known cameras
LEAST_KEYPOINTS = 4
GOOD_KEYPOINTS = 6  # recommended number for an unknown focal length
LEAST_OFF_LINE = 1e-3  # least distance of some keypoint from a line, in extents of the keypoints


def check_dataset(spec: DatasetFile, file: Path) -> None:
    """Check dataset.yaml for consistency; InputError names file, key and cure of each fault."""
    refuse = Refusal(file, file.parent)
    for name, mesh in spec.meshes.items():
        refuse.collect(_check_mesh, name, mesh, spec, refuse)
    refuse.collect(refuse.check_distinct, "photos", (photo.name for photo in spec.photos), "photo")
    for index, photo in enumerate(spec.photos):
        _check_photo(f"photos[{index}]", photo, spec, refuse)
    refuse.collect(
        refuse.refuse_if,
        all(photo.held_out for photo in spec.photos),
        "photos",
        "every photo is held out, so that none is left to solve from",
        "leave held_out out of at least one photo",
    )
    if spec.cameras is not None:
        refuse.collect(_check_source, spec.cameras, spec, refuse)
    if spec.truth is not None:
        refuse.collect(refuse.check_path, "truth", spec.truth, (".yaml", ".yml"), False)
    raise_all(refuse.faults)
    _check_known(spec, refuse)  # requires valid objects and meshes
    raise_all(refuse.faults)


def check_truth(truth: TruthFile, spec: DatasetFile, file: Path, folder: Path) -> None:
    """Check truth.yaml against the dataset.

    Args:
        truth: content of truth.yaml
        spec: content of dataset.yaml
        file: the path of truth.yaml, for errors
        folder: the folder that must contain every map

    Raises:
        InputError: A name is unknown, or the path of a map is outside the folder.
    """
    refuse = Refusal(file, folder)
    photos = {photo.name: photo for photo in spec.photos}
    for name in truth.materials:
        refuse.check_known(f"materials.{name}", name, spec.materials, "material")
    for group, known, kind in (
        ("illumination", {photo.light for photo in spec.photos}, "illumination"),
        ("normals", photos, "photo"),
        ("albedo", photos, "photo"),
    ):
        for name, path in getattr(truth, group).items():
            refuse.check_known(f"{group}.{name}", name, known, kind)
            refuse.check_path(f"{group}.{name}", path, MAPS, must_exist=False)
    for name, poses in truth.poses.items():
        refuse.check_known(f"poses.{name}", name, photos, "photo")
        for obj, pose in poses.items():
            refuse.check_known(f"poses.{name}.{obj}", obj, [o.name for o in photos[name].objects], "object")
            refuse.check_rotation(f"poses.{name}.{obj}.rotation", pose.rotation)


def check_lights(photos: list[PhotoEntry], file: Path) -> None:
    """Check that photos that share a light are all fixed to the camera, or all to the world; else InputError."""
    first: dict[str, PhotoEntry] = {}
    for index, photo in enumerate(photos):
        first_photo = first.setdefault(photo.light, photo)
        Refusal(file, file.parent).refuse_if(
            (first_photo.world_from_camera is None) != (photo.world_from_camera is None),
            f"photos[{index}].world_from_camera",
            f"photos {first_photo.name!r} and {photo.name!r} share illumination {photo.light!r}, "
            "but only one of them has this key",
            "give it for every photo that shares a light fixed to the world, or for none (fixed to the camera)",
        )


def _check_mesh(name: str, mesh: MeshEntry, spec: DatasetFile, refuse: Refusal) -> None:
    key = f"meshes.{name}"
    kinds = [kind for kind in ("file", "hull", "lathe", "primitive") if getattr(mesh, kind)]
    refuse.refuse_if(
        len(kinds) != 1,
        key,
        f"has {' and '.join(kinds) or 'neither a file nor a shape to be estimated'}",
        "give exactly one of file: <path>, hull: true, lathe: true, primitive: ball | box | cylinder",
    )
    if mesh.file:
        refuse.check_path(f"{key}.file", mesh.file, MESHES)
    refuse.refuse_if(
        mesh.size != 1.0 and kinds[0] in ("file", "hull"),
        f"{key}.size",
        f"cannot be combined with {kinds[0]}",
        "leave it out: the coordinates of the mesh determine its size",
    )
    refuse.refuse_if(
        mesh.parts and kinds[0] in ("lathe", "primitive"),
        f"{key}.parts",
        f"cannot be combined with {kinds[0]}, which has one part",
        "write `material: …` instead",
    )
    refuse.refuse_if(
        bool(mesh.parts) == (mesh.material is not None),
        key,
        f"has {'both parts and' if mesh.parts else 'neither parts nor'} a material",
        "give either `parts: {part: material, …}`, or `material: …` for all of it",
    )
    if mesh.material is not None:
        refuse.check_known(f"{key}.material", mesh.material, spec.materials, "material")
    _check_parts(f"{key}.parts", mesh.parts or {}, mesh, spec.materials, refuse)
    instances = [obj for photo in spec.photos for obj in photo.objects if obj.mesh == name]
    known = sum(obj.pose is not None for obj in instances)
    refuse.refuse_if(
        mesh.hull and spec.cameras is None and known < LEAST_OUTLINES,
        f"{key}.hull",
        f"{known} of the {len(instances)} photos of it have a known camera; a hull needs at least two",
        "add `cameras: {sfm: true}`, another source of cameras, or each object's `pose`; or use lathe or primitive",
    )


def _check_parts(key: str, parts: dict[str, str], mesh: MeshEntry, materials: list[str], refuse: Refusal) -> None:
    """Check the names of parts that are known without opening the mesh, and their materials."""
    file = Path(mesh.file or "")
    for part, material in parts.items():
        refuse.refuse_if(
            not mesh.file and not mesh.parts and part != ALL_OF_IT,
            f"{key}.{part}",
            f"it has no part {part!r}",
            f"its only part is {ALL_OF_IT!r}",
        )
        refuse.refuse_if(
            file.suffix.lower() in ONE_PART and part != file.stem,
            f"{key}.{part}",
            f"{file.name} has no part {part!r}",
            f"its only part is {file.stem!r}; for several parts, save the mesh as OBJ or glTF",
        )
        if mesh.parts:
            refuse.check_known(f"{key}.{part}", part, mesh.parts, "part")
        refuse.check_known(f"{key}.{part}", material, materials, "material")


def _check_photo(key: str, photo: PhotoEntry, spec: DatasetFile, refuse: Refusal) -> None:
    refuse.collect(
        refuse.refuse_if,
        photo.name in RESERVED_PHOTOS,
        f"{key}.name",
        f"the name {photo.name!r} is reserved for a file of the results",
        "rename the photo",
    )
    refuse.collect(refuse.check_path, f"{key}.image", photo.image, IMAGES)
    if photo.world_from_camera is not None:
        refuse.collect(refuse.check_rotation, f"{key}.world_from_camera", photo.world_from_camera)
    if photo.ground is not None:
        refuse.collect(_check_ground, f"{key}.ground.normal", photo.ground, refuse)
    refuse.collect(
        refuse.refuse_if,
        photo.camera and photo.camera.distortion and photo.camera.focal_px is None,
        f"{key}.camera.distortion",
        "its unit is the focal length, which is not given",
        "give focal_px beside it",
    )
    refuse.collect(
        refuse.refuse_if,
        not photo.masks,
        f"{key}.masks",
        "no mask is named",
        "give a label PNG, a COCO json, or {material: mask.png, …}",
    )
    if isinstance(photo.masks, str) and photo.masks:
        refuse.collect(_check_label_mask, f"{key}.masks", photo.masks, refuse)
    for material, path in {} if isinstance(photo.masks, str) else photo.masks.items():
        refuse.collect(refuse.check_known, f"{key}.masks.{material}", material, spec.materials, "material")
        refuse.collect(refuse.check_path, f"{key}.masks.{material}", path, MASK_IMAGES)
    refuse.collect(
        refuse.refuse_if,
        not photo.objects,
        f"{key}.objects",
        f"photo {photo.name!r} has no objects",
        "add {name: …, mesh: …}: a mesh gives its pixels their normals",
    )
    refuse.collect(refuse.check_distinct, f"{key}.objects", (obj.name for obj in photo.objects), "object")
    for index, obj in enumerate(photo.objects):
        refuse.collect(_check_object, f"{key}.objects[{index}]", obj, spec, refuse)


def _check_label_mask(key: str, masks: str, refuse: Refusal) -> None:
    refuse.check_path(key, masks, MASKS)
    refuse.check_path(key, labelmap_beside(masks, refuse.folder) or masks, (*MASKS, ".txt"))


def _check_object(key: str, obj: MeshInstance, spec: DatasetFile, refuse: Refusal) -> None:
    refuse.check_known(f"{key}.mesh", obj.mesh, spec.meshes, "mesh")
    mesh = spec.meshes[obj.mesh]
    _check_parts(f"{key}.materials", obj.materials, mesh, spec.materials, refuse)
    if obj.mask is not None:
        refuse.check_path(f"{key}.mask", obj.mask, MASK_IMAGES)
    if obj.pose is not None:
        refuse.check_rotation(f"{key}.pose.rotation", obj.pose.rotation)
        refuse.refuse_if(
            mesh.primitive,
            f"{key}.pose",
            "cannot be given for a primitive, whose size is estimated with its pose",
            "leave it out: the pose is estimated",
        )
        refuse.refuse_if(
            mesh.lathe and mesh.size != 1.0,
            f"{key}.pose",
            f"cannot be combined with meshes.{obj.mesh}.size: the pose determines the size",
            "keep one of the two",
        )
    if obj.keypoints:
        refuse.refuse_if(
            not mesh.file,
            f"{key}.keypoints",
            "its mesh has no file, so no points are known on it",
            "leave them out, or give the mesh's file",
        )
        _check_keypoints(f"{key}.keypoints", obj, refuse)


def _check_known(spec: DatasetFile, refuse: Refusal) -> None:
    """Check known materials, exposures and lights."""
    used = {m for photo in spec.photos for obj in photo.objects for m in instance_materials(obj, spec)}
    for name, reflectance in spec.known.materials.items():
        refuse.collect(_check_known_material, name, reflectance, used, spec, refuse)
    for name in spec.known.exposure:
        refuse.collect(_check_exposure, name, spec, refuse)
    for name, light in spec.known.illumination.items():
        refuse.collect(_check_known_light, name, light, spec, refuse)


def _check_known_material(
    name: str, reflectance: KnownMaterial, used: set[str], spec: DatasetFile, refuse: Refusal
) -> None:
    """Check that a known material occurs on an object, and reflects some light but no more than arrives."""
    key = f"known.materials.{name}"
    specular = reflectance.specular or (0.0, 0.0, 0.0)
    refuse.check_known(key, name, spec.materials, "material")
    refuse.refuse_if(
        name not in used,
        key,
        f"no object is made of material {name!r}",
        "leave it out, or add the object that shows it",
    )
    if reflectance.diffuse is None:
        refuse.refuse_if(
            not reflectance.kind or reflectance.specular or reflectance.roughness,
            key,
            "its diffuse reflectance is missing",
            "give `diffuse: [r, g, b]`, or `kind` alone",
        )
        return
    refuse.refuse_if(
        not min(map(sum, zip(reflectance.diffuse, specular, strict=True))) > 0,
        key,
        "it reflects nothing in some channel, so that the light cannot be derived from it",
        "give what it reflects in every channel, or leave it out",
    )
    refuse.refuse_if(
        max(reflectance.diffuse) + max(specular) > 1,
        key,
        f"diffuse and specular reflectance are {max(reflectance.diffuse) + max(specular):.3g} together",
        "their largest channels may be 1 together: no more light is reflected than falls on it",
    )


def _check_exposure(name: str, spec: DatasetFile, refuse: Refusal) -> None:
    key = f"known.exposure.{name}"
    lights = {photo.name: photo.light for photo in spec.photos}
    refuse.check_known(key, name, lights, "photo")
    without = next((p for p in lights if lights[p] == lights[name] and p not in spec.known.exposure), None)
    refuse.refuse_if(
        without,
        key,
        f"photo {without!r}, of the same light, has none",
        "give all of them an EV, or none",
    )


def _check_known_light(name: str, light: str | MirrorBall, spec: DatasetFile, refuse: Refusal) -> None:
    """Check a known map or mirror ball.

    A mirror ball is an object of the light.  It consists of one known material that nothing else in the photo has.
    """
    key = f"known.illumination.{name}"
    sharing = [photo for photo in spec.photos if photo.light == name]
    refuse.check_known(key, name, [photo.light for photo in spec.photos], "illumination")
    if isinstance(light, str):
        return refuse.check_path(key, light, MAPS)
    key += ".chrome"
    names = [obj.name for photo in sharing for obj in photo.objects]
    refuse.check_known(key, light.chrome, names, "object")
    photo, ball = next(mirror_balls(spec, name, light))
    materials = instance_materials(ball, spec)
    material = min(materials)
    mesh = spec.meshes[ball.mesh]
    known = spec.known.materials.get(material)
    refuse.refuse_if(
        len(materials) > 1 or not (mesh.file or mesh.primitive == "ball"),
        key,
        f"mesh {ball.mesh!r} is not a ball of one material",
        "give a file, or `primitive: ball`",
    )
    refuse.refuse_if(
        any(material in instance_materials(obj, spec) for obj in photo.objects if obj is not ball),
        key,
        f"another object of photo {photo.name!r} is made of {material!r} too",
        "give the ball a material of its own",
    )
    refuse.refuse_if(
        known is None or known.diffuse is None or any(known.diffuse) or not known.specular,
        key,
        f"the specular reflectance of {material!r} is not known, or it is not a mirror",
        f"write known.materials.{material}: {{diffuse: [0, 0, 0], specular: [0.55, 0.55, 0.55]}}, as chrome's is",
    )
    refuse.refuse_if(
        len(sharing) > 1 and photo.name not in spec.known.exposure,
        key,
        f"{len(sharing)} photos of unknown exposure share the light of the ball",
        "give known.exposure of these photos, or give the ball's photo a light of its own",
    )


def mirror_balls(spec: DatasetFile, illumination: str, ball: MirrorBall) -> Iterator[tuple[PhotoEntry, MeshInstance]]:
    """Yield the photos in an illumination that show a mirror ball, each with the ball's object.

    Args:
        spec: content of dataset.yaml
        illumination: name of the illumination
        ball: the mirror ball
    """
    for photo in spec.photos:
        if photo.light == illumination:
            yield from ((photo, obj) for obj in photo.objects if obj.name == ball.chrome)


def instance_materials(obj: MeshInstance, spec: DatasetFile) -> set[str]:
    """Return the materials of an object's parts."""
    materials = spec.meshes[obj.mesh].part_materials
    return set(
        (materials | obj.materials).values()
        if isinstance(materials, dict)
        else obj.materials.values() or [materials or ""]
    )


def _check_ground(key: str, ground: GroundEntry, refuse: Refusal) -> None:
    refuse.refuse_if(
        not any(ground.normal),
        key,
        "the normal has length 0",
        "write the direction that points up from the ground, in the camera's axes",
    )
    refuse.refuse_if(
        sum(n * p for n, p in zip(ground.normal, ground.point, strict=True)) >= 0,
        key,
        "it points away from the camera, or the camera lies in the plane",
        "negate it: the normal points toward the objects",
    )


def _check_keypoints(key: str, obj: MeshInstance, refuse: Refusal) -> None:
    """Check that keypoints are enough, distinct, and not collinear, which would leave a rotation free."""
    refuse.refuse_if(
        obj.pose is not None,
        key,
        "has both a pose and keypoints",
        "keep one: a pose is used as it is, keypoints are where the search begins",
    )
    refuse.refuse_if(
        len(obj.keypoints) < LEAST_KEYPOINTS,
        key,
        f"{len(obj.keypoints)} keypoints do not determine a pose",
        f"give {LEAST_KEYPOINTS} or more; {GOOD_KEYPOINTS} where the focal length is unknown",
    )
    for name in ("pixel", "point"):
        places = [getattr(keypoint, name) for keypoint in obj.keypoints]
        first: dict[tuple[float, ...], int] = {}
        for index, place in enumerate(places):
            refuse.refuse_if(
                first.setdefault(place, index) != index,
                f"{key}[{index}].{name}",
                f"equals that of {key}[{first[place]}]",
                "name each place once",
            )
        # largest distance of a place from the line through the first and the farthest one
        arms = [[x - x0 for x, x0 in zip(place, places[0])] for place in places[1:]]
        longest = max(arms, key=lambda arm: math.hypot(*arm))
        unit = [x / math.hypot(*longest) for x in longest]
        along = [sum(x * u for x, u in zip(arm, unit)) for arm in arms]
        distances = [math.hypot(*(x - length * u for x, u in zip(arm, unit))) for arm, length in zip(arms, along)]
        refuse.refuse_if(
            max(distances) < LEAST_OFF_LINE * math.hypot(*longest),
            key,
            f"all {name}s lie on one line",
            "add a keypoint away from that line, about which the object could rotate",
        )


def _check_source(source: CameraSource, spec: DatasetFile, refuse: Refusal) -> None:
    """Check that there is one source of cameras, with a path inside the folder and known names."""
    kinds = [kind for kind in (*SOURCES, "sfm") if getattr(source, kind)]
    refuse.refuse_if(
        len(kinds) != 1,
        "cameras",
        f"names {' and '.join(kinds) or 'no source'}",
        f"name one of {', '.join(SOURCES)}, or `sfm: true`",
    )
    kind = kinds[0]
    excluded, reason = EXCLUDED[kind]
    for key in excluded:
        refuse.refuse_if(
            getattr(source, key) != getattr(CameraSource(), key),
            f"cameras.{key}",
            f"cannot be combined with {kind}: {reason}",
            "leave it out",
        )
    own = [index for index, photo in enumerate(spec.photos) if photo.world_from_camera]
    refuse.refuse_if(
        source.up is not None and (not source.world_from_camera or bool(own)),
        "cameras.up",
        f"turns no world: photos[{own[0]}] has its own world_from_camera" if own else "turns no world",
        "leave it out" if own else "add world_from_camera: true, which fixes lights to the source's world",
    )
    if kind == "transforms":
        refuse.check_path("cameras.transforms", source.transforms or "", (".json",))
    elif kind != "sfm":
        refuse.check_subfolder(f"cameras.{kind}", getattr(source, kind))
    for key, known, noun in (
        ("images", [photo.name for photo in spec.photos], "photo"),
        ("world_from_object", {obj.name for photo in spec.photos for obj in photo.objects}, "object"),
        ("obj_ids", spec.meshes, "mesh"),
    ):
        for name in getattr(source, key):
            refuse.check_known(f"cameras.{key}.{name}", name, known, noun)
    for name, similarity in source.world_from_object.items():
        refuse.check_rotation(f"cameras.world_from_object.{name}.rotation", similarity.rotation)
