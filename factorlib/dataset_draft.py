"""Draft of a dataset.yaml for a user's own photos: `make new DATASET=mychair PHOTOS=… MASKS=… MESHES=…`.

The files are copied to data/<name>/.  A mask belongs to the photo of the same name: `kitchen.png` with labels,
`kitchen_oak.png` or `kitchen/oak.png` for one material, `kitchen.json` of labelme, one COCO json for all, or CVAT's
masks with labelmap.txt.  A `kitchen.png` without labels, or the alpha of a photo, is the silhouette of one material.
Beside a mask with labels, `kitchen_chair1.png` is the silhouette of an object.  Materials are the names in those, or
label_1, label_2, … for labels.

A part that is called as a material has it.  Values that no file determines are left as `?`, which `make validate`
rejects, and listed.  Names that must change are listed too.
"""

import os
import re
import shutil
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any
from unicodedata import normalize

import msgspec

from factorlib.dataset.check import IMAGES, MASK_IMAGES, MASKS, MESHES, RESERVED_PHOTOS
from factorlib.dataset.paths import plain_path
from factorlib.dataset.read_dataset import UNKNOWN
from factorlib.dataset.schema import LEFT_OUT, LONGEST_NAME
from factorlib.errors import InputError
from factorlib.images.photo import open_photo
from factorlib.images.scanlines import MOST_MEGAPIXELS, check_pixels, check_values
from factorlib.labels.mask_files import (
    BACKGROUND,
    LabelmeCoco,
    read_annotations,
    read_labelmap,
    read_labels_in,
)
from factorlib.meshes.read_mesh import read_parts
from factorlib.onboarding.matte import opaque_pixels
from factorlib.onboarding.photo_folder import SUFFIXES, UNREAD, Cameras, left_out, read_photo_folder, stem_of_mask
from factorlib.wholefile import disk_error, write_text
from factorlib.yamlfile import yaml_text

REMARK = """\
# What the files say; `?` is for you to write.  Every key: docs/dataset.md
# materials: label k of a mask is the k-th, from 1;  parts: part of a mesh -> material
# objects: of each the mesh; another material for a part by `materials: {part: material}`
"""
LABELMAP = "labelmap.txt"  # names of the colours in CVAT's masks
HULL = "thing"  # name of the mesh if none is given
NO_MESH = (
    "there is no mesh: `hull: true` and `cameras: {sfm: true}` are written, which need photos that overlap, "
    "each 10 to 20° from the next; "
    "else write `lathe: true` or `primitive: ball | box | cylinder`, or give MESHES=<folder>: rough ones will do"
)

NO_MASKS = (
    "there are no masks: `make label` draws them in the browser, once `materials` has their names; "
    "or give MASKS=<folder>"
)


class Masks(msgspec.Struct):
    """Masks of all photos, as dataset.yaml names them.

    Attributes:
        materials: Names of the materials, label k the k-th, from 1.
        by_photo: Path of a photo's mask with labels, or of the mask of each material.
        silhouettes: Path of each object's mask, by photo and object, of photos with a mask with labels.
    """

    materials: list[str] = []
    by_photo: dict[str, str | dict[str, str]] = {}
    silhouettes: dict[str, dict[str, str]] = {}


def photos_in(photos: Path) -> tuple[dict[str, Path], dict[str, Path], Cameras | None]:
    """Return the photos of a folder by name, the masks of some by the same name, and cameras."""
    files, masks, cameras = read_photo_folder(photos, _files(photos, SUFFIXES, "PHOTOS", deep=True))
    images = _by_name(files, "PHOTOS", photos)
    if not images:
        raise InputError(
            f"the folder has no photos ({', '.join(IMAGES[:6])}, …)",
            file=photos,
            key="PHOTOS",
            cure="name the folder of the photos",
        )
    return images, {name: masks[path] for name, path in images.items() if path in masks}, cameras


def new_dataset(
    target: Path, photos: Path, masks: Path | None, meshes: Path | None, cameras: Cameras | None = None
) -> list[str]:
    """Copy the files, write target/dataset.yaml, and return what is still missing, in words.

    Args:
        target: the folder to create
        photos: folder of photos
        masks: folder of masks; None: those that lie among the photos
        meshes: folder of meshes
        cameras: cameras of the photos; None: those that lie among them

    Raises:
        InputError: The target exists, or a folder is missing, has no photos, or a link or a file with too many pixels.
    """
    above = check_target(target)
    images, photo_masks, source = photos_in(photos)
    images = {name: path for name, path in images.items() if not cameras or name not in cameras.left_out}
    beside = {} if masks else photo_masks
    mask_files = _files(masks, (*MASKS, LABELMAP), "MASKS", deep=True) if masks else sorted(beside.values())
    if beside:
        masks = Path(os.path.commonpath([path.parent for path in mask_files]))
    mesh_files = _files(meshes, None, "MESHES", deep=True) if meshes else []  # including .mtl and buffers
    others = {*_files(photos, UNREAD, "PHOTOS", deep=True)} - {*mask_files, *photo_masks.values()}
    names = left_out(photos, sorted(others), images.values())
    some = ", ".join([*names[:5], *["…"] * (len(names) > 5)])
    missing = [f"left out, for photos of this kind are not read: {some}; save them as PNG or JPEG"] if names else []
    paths = {name: f"photos/{path.relative_to(photos)}" for name, path in images.items()}
    labelled = _masks(masks, mask_files, paths, beside, missing) if masks else _cut_outs(paths, images, missing)
    entries = _meshes(meshes, mesh_files, labelled.materials) if meshes else {}
    visible = _visible_meshes(list(images), entries, labelled, missing)
    missing += _open_masks(images, labelled, masks is not None)
    spec: dict = {"format": 1, "materials": labelled.materials or [UNKNOWN]}
    if not entries:
        missing += [] if cameras or source else [NO_MESH]
        cameras = cameras or source or Cameras({"sfm": True})
        entries = {HULL: _shape(spec["materials"], cameras)}
        visible = {photo: [HULL] for photo in images}
    cameras = cameras or source or Cameras()
    spec |= {"cameras": cameras.source} if cameras.source else {}
    spec |= {"meshes": entries, "photos": _photo_entries(paths, entries, visible, labelled, cameras)}
    sources = {"photos": (photos, images.values()), "masks": (masks, mask_files), "meshes": (meshes, mesh_files)}
    sources["cameras"] = cameras.folder, cameras.files
    places = {name: (folder, files) for name, (folder, files) in sources.items() if folder}
    missing += [
        f"mesh {name}: write which material {part} is made of"
        for name, entry in entries.items()
        for part, material in entry.get("parts", {}).items()
        if material == UNKNOWN
    ]
    _write(target, spec, places, above)
    return missing


def _open_masks(photos: Iterable[str], labelled: Masks, are_given: bool) -> list[str]:
    """Name the photos without a mask, masks without a material, and photos that must have another name."""
    unmasked = [
        f"photo {photo}: no mask called {photo}.png or {photo}_<material>.png"
        for photo in photos
        if photo not in labelled.by_photo
    ]
    return [
        *(unmasked if are_given or labelled.by_photo else [NO_MASKS]),
        *["no mask names a material: write the names in `materials`, label k of a mask the k-th"]
        * (are_given and not labelled.materials),
        *(
            f"photo {photo}: write another `name`: a file of the results is called {photo}"
            for photo in photos
            if photo in RESERVED_PHOTOS
        ),
    ]


def check_target(target: Path) -> Path:
    """Return the folder in which the target can be created.  Raises InputError where it cannot be."""
    if not target.name.isprintable():
        raise InputError(f"the name {target.name!a} cannot be printed", key="DATASET", cure="choose another name")
    if os.path.lexists(target):
        raise InputError("exists already", file=target, key="DATASET", cure="choose another name, or delete it")
    if not (above := next(path for path in target.absolute().parents if os.path.lexists(path))).is_dir():
        raise InputError("is not a folder", file=above, key="DATASET", cure="name a dataset in an existing folder")
    return above


def _visible_meshes(
    photos: list[str], entries: Mapping[str, dict[str, Any]], labelled: Masks, missing: list[str]
) -> dict[str, list[str]]:
    """Return the meshes that each photo shows, by the photo's name, else by the materials of its masks."""
    words = [(word, mesh) for mesh, entry in entries.items() for word in {mesh, *entry.get("parts", ())}]
    times = Counter(word for word, _ in words)
    visible = {}
    for photo in photos:
        masks = labelled.by_photo.get(photo)
        materials = masks if isinstance(masks, dict) else ()
        visible[photo] = _meshes_named_in(photo, entries) or sorted(
            {mesh for word, mesh in words if word in materials and times[word] == 1}
        )
    if len(entries) > 1:
        missing += [f"photo {photo}: write which of the meshes it shows" for photo in photos if not visible[photo]]
    return visible


def _shape(materials: list[str], cameras: Cameras) -> dict[str, Any]:
    """Return the entry of a mesh without a file: a hull, a body of revolution, or open where nothing is known.

    A hull has a part of each material without saying so.
    """
    parts = {"parts": {name: name for name in materials}} if len(materials) > 1 else {"material": materials[0]}
    return {"hull": True} if cameras.source else ({"lathe": True} if cameras.revolved else {"file": UNKNOWN}) | parts


def _photo_entries(
    paths: Mapping[str, str],
    entries: Collection[str],
    visible: Mapping[str, list[str]],
    labelled: Masks,
    cameras: Cameras,
) -> list[dict[str, Any]]:
    """Return `photos` of the dataset.yaml: each photo's picture, masks and objects."""
    photos = []
    for photo, path in paths.items():
        objects = [{"name": mesh, "mesh": mesh} for mesh in visible[photo] or [UNKNOWN] * bool(entries)]
        if objects and (silhouettes := labelled.silhouettes.get(photo)):
            only = objects[0]["mesh"] if len(objects) == 1 else UNKNOWN
            mesh_of = {name: (_meshes_named_in(name, entries) or [only])[0] for name in silhouettes}
            objects = [{"name": name, "mesh": mesh_of[name], "mask": mask} for name, mask in silhouettes.items()]
        entry = {
            "name": photo,
            "image": path,
            "masks": labelled.by_photo.get(photo, f"masks/{photo}.png"),
            "objects": objects,
        }
        photos.append(entry | cameras.by_photo.get(photo, {}))
    return photos


def _write(target: Path, spec: dict, places: Mapping[str, tuple[Path, Iterable[Path]]], above: Path) -> None:
    """Write the dataset.yaml and copies of the files into the folder `target`, which is there when all of it is."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
            draft = Path(folder) / target.name
            for name, (source, files) in places.items():
                for path in files:
                    place = draft / name / path.relative_to(source)
                    place.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(path, place)
            write_text(draft / "dataset.yaml", REMARK + yaml_text(spec))
            draft.rename(target)
    except OSError as error:
        raise disk_error(error, target.parent) or InputError(
            "no folder can be created here", file=above, key="DATASET", cure="name another folder for the dataset"
        ) from error


def _masks(
    folder: Path,
    paths: list[Path],
    photos: Mapping[str, str],
    beside: Mapping[str, Path],
    missing: list[str],
) -> Masks:
    """Return the masks in a folder: of a labelmap.txt, of json files, or of pictures.

    Args:
        folder: the folder
        paths: the files
        photos: path of each photo in the dataset
        beside: mask of each photo that has one beside the photos, which needs no search by name
        missing: receives what the user has to write
    """
    file = {path: f"masks/{path.relative_to(folder)}" for path in paths}
    tails = {path: _tails(plain_path(path.relative_to(folder))) for path in paths}
    photo_of = _names_of(photos)
    if sources := [path for path in paths if path.suffix.lower() not in MASK_IMAGES]:
        by_file = {path: next((photo_of[tail] for tail in tails[path] if tail in photo_of), None) for path in paths}
        return _annotated_masks(file, sources, by_file, list(photos), missing)
    masks = Masks()
    labels: dict[str, set[int]] = {}  # by photo
    whole, further = (beside, {}) if beside else _masks_by_photo(tails, photo_of)
    for photo in photos:
        each = {name: file[path] for name, path in sorted(further.get(photo, {}).items())}
        if photo in whole:
            check_values(whole[photo], key=photo)
            labels[photo] = read_labels_in(whole[photo], photo)
            masks.by_photo[photo] = file[whole[photo]]
            masks.silhouettes[photo] = each
        elif each:
            masks.by_photo[photo] = each
    names = [name for each in masks.by_photo.values() if isinstance(each, dict) for name in each]
    most = max((label for values in labels.values() for label in values or {1}), default=0)
    masks.materials = list(dict.fromkeys(names)) or [f"label_{k}" for k in range(1, most + 1)]
    _name_outlines(masks, [photo for photo, values in labels.items() if not values], missing)
    return masks


def _annotated_masks(
    file: dict[Path, str],
    sources: list[Path],
    by_file: Mapping[Path, str | None],
    photos: list[str],
    missing: list[str],
) -> Masks:
    """Return the pictures of a labelmap.txt, or the json of each photo or of all.

    Args:
        file: path of each file in the dataset
        sources: the files that are no pictures
        by_file: name of the photo that a file is called as
        photos: names of the photos
        missing: receives what the user has to write
    """
    suffixes = MASK_IMAGES if sources[0].name == LABELMAP else (".json",)
    entries = [path for path in file if path.suffix.lower() in suffixes and path.parent.name != "SegmentationObject"]
    masks = Masks(by_photo={photo: file[path] for path in entries if (photo := by_file[path])})
    coco = [p for p in sources if p.name != LABELMAP and not isinstance(read_annotations(p), LabelmeCoco)]
    if coco and not masks.by_photo:
        masks.by_photo = dict.fromkeys(photos, file[coco[0]])
        missing += [f"{file[path]}: a second COCO file is not used" for path in coco[1:]]
        sources = coco[:1]
    names = [name for path in sources for name in _annotated_materials(path, file[path], missing)]
    masks.materials = list(dict.fromkeys(names))
    return masks


def _name_outlines(masks: Masks, photos: Iterable[str], missing: list[str]) -> None:
    """Make masks without labels, by photo, silhouettes of the only material, and say so."""
    for photo in photos:
        mask = masks.by_photo[photo]
        if len(masks.materials) == 1:
            masks.by_photo[photo] = {masks.materials[0]: str(mask)}
            missing.append(
                f"photo {photo}: {mask} has no labels: cut at half, it is the silhouette of {masks.materials[0]}"
            )
        else:
            missing.append(
                f"photo {photo}: {mask} has no label, for {LEFT_OUT} means left out; "
                f"the mask of one material is called {photo}_<material>.png"
            )


def _cut_outs(photos: Mapping[str, str], images: Mapping[str, Path], missing: list[str]) -> Masks:
    """Return as masks the transparency of photos that have one."""
    masks = Masks()
    for name, path in images.items():
        with suppress(InputError):  # `validate` reports a photo that cannot be read
            check_pixels(open_photo(path).size, MOST_MEGAPIXELS, path)
            if path.suffix.lower() == ".png" and opaque_pixels(path) is not None:
                masks.by_photo[name] = photos[name]
                masks.materials = ["label_1"]
    _name_outlines(masks, list(masks.by_photo), missing)
    return masks


def _annotated_materials(path: Path, file: str, missing: list[str]) -> list[str]:
    """Return the materials of a labelmap.txt or a json, by names that a dataset.yaml can have."""
    if path.name == LABELMAP:
        found = [name for name in read_labelmap(path).values() if name != BACKGROUND]
    else:
        coco = read_annotations(path)
        used = {annotation.category_id for annotation in coco.annotations}
        above = {each.supercategory for each in coco.categories}  # Roboflow names its project as a category
        found = [each.name for each in coco.categories if each.id in used or each.name not in above]
    names = {name: _word(name) for name in found}
    missing += [
        f"{file}: rename its category {name!r} to {word!r}: names are made of A-Z a-z 0-9 _ and -"
        for name, word in names.items()
        if word != name
    ]
    return list(names.values())


def _tails(place: PurePosixPath) -> list[str]:
    """Return the words of a path, by the stem of its photo, with all of its folders, then with fewer.

    >>> _tails(PurePosixPath("rig/front/0001.png"))
    ['rig_front_0001', 'front_0001', '0001']
    """
    parts = *place.parent.parts, stem_of_mask(place)
    return [_word("_".join(parts[k:])) for k in range(len(parts))]


def _names_of(photos: Mapping[str, str]) -> dict[str, str]:
    """Return each photo's name by that name, and by the words of its path that no other photo has."""
    words = [(word, name) for name, place in photos.items() for word in {*_tails(plain_path(place))}]
    times = Counter(word for word, _ in words)
    return {word: name for word, name in words if times[word] == 1} | {name: name for name in photos}


def _masks_by_photo(
    tails: Mapping[Path, list[str]], names: Mapping[str, str]
) -> tuple[dict[str, Path], dict[str, dict[str, Path]]]:
    """Return the mask with labels of each photo, and its masks of single materials or objects by their names.

    Args:
        tails: result of `_tails` for each file
        names: names of photos by words
    """
    whole: dict[str, Path] = {}
    further: dict[str, dict[str, Path]] = {}
    for path, words in tails.items():
        words = words[: max(1, len(words) - 1)]  # not the name without any of its folders
        if photo := next((names[word] for word in words if word in names), None):  # may be kitchen_2's
            whole.setdefault(photo, path)
            continue
        for word, cut in [(each, k) for each in words for k, letter in enumerate(each) if letter == "_"]:
            if photo := names.get(word[:cut]):
                further.setdefault(photo, {})[word[cut + 1 :]] = path
    return whole, further


def _meshes(folder: Path, files: list[Path], materials: list[str]) -> dict[str, dict[str, Any]]:
    """Return the entry of each mesh, with a part's own name as its material if there is a material of that name."""
    entries: dict[str, dict[str, Any]] = {}
    for name, path in _by_name([path for path in files if path.suffix.lower() in MESHES], "MESHES").items():
        parts = {names[0]: names[0] if names[0] in materials else UNKNOWN for names in read_parts(path)}
        entries[name] = {"file": f"meshes/{path.relative_to(folder)}"}
        entries[name] |= {"material": materials[0]} if len(materials) == 1 else {"parts": parts}
    return entries


def _meshes_named_in(photo: str, meshes: Collection[str]) -> list[str]:
    """Return the meshes that a photo shows: the only one, or those whose names are whole words of the photo's.

    >>> _meshes_named_in("my_red-chair_2", ["stool", "chair", "red-chair", "hair"])
    ['chair', 'red-chair']
    """
    ends = [end for word in re.finditer("[A-Za-z0-9]+", photo) for end in word.span()]
    words = {photo[begin:end] for k, begin in enumerate(ends[::2]) for end in ends[2 * k + 1 :: 2]}
    return list(meshes) if len(meshes) == 1 else sorted(word for word in words if word in meshes)


def _files(folder: Path, suffixes: tuple[str, ...] | None, key: str, deep: bool = False) -> list[Path]:
    """Return the files of a folder, sorted, without those that macOS keeps beside a file (`._name`).

    `deep` includes its subfolders.  `suffixes` are ends of their names, None for any.
    """
    if not folder.is_dir():
        raise InputError("there is no such folder", file=folder, key=key, cure="correct the path")
    paths = []
    for path in folder.rglob("*") if deep else folder.iterdir():
        if path.name.startswith("._") or (suffixes is not None and not path.name.lower().endswith(suffixes)):
            continue
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise InputError(
                "is a link, or not a plain file", file=path, key=key, cure="put a copy of the file there, or remove it"
            )
        if not path.name.isprintable():
            raise InputError(
                f"the file name {path.name!a} cannot be printed", file=folder, key=key, cure="rename that file"
            )
        if path.is_file():
            paths.append(path)
    return sorted(paths)


def _by_name(paths: list[Path], key: str, folder: Path | None = None) -> dict[str, Path]:
    """Return the files by name; in subfolders of `folder`, namesakes by the names of these as well."""
    named: dict[str, Path] = {}
    times = Counter(path.stem for path in paths)
    for path in paths:
        whole = folder is not None and times[path.stem] > 1 and path.parent != folder
        stem = str(path.relative_to(folder).with_suffix("")) if whole else path.stem  # type: ignore[arg-type]
        if (namesake := named.setdefault(name := _word(stem), path)) != path:
            raise InputError(
                f"{path.name} and {namesake.name} would both be called {name!r}",
                file=path,
                key=key,
                cure="rename one of them",
            )
    return named


def _word(text: str) -> str:
    """Return a name that is valid in dataset.yaml.

    >>> _word("IMG 0412 (1)")
    'IMG_0412_1'
    """
    return re.sub(r"[^A-Za-z0-9-]+", "_", normalize("NFC", text)).strip("_")[:LONGEST_NAME] or "unnamed"
