"""A dataset.yaml for photos of one's own: `make new DATASET=mychair PHOTOS=… MASKS=… MESHES=…`.

The files are copied to data/<name>/.  A mask belongs to the photo of the same name: `kitchen.png` with labels, `kitchen_oak.png` or
`kitchen/oak.png` for one material, or one COCO json for all.  Beside a mask with labels `kitchen_chair1.png` is the silhouette of an
object.  Materials are the names in those, or label_1, label_2, … for labels.

What no file says (which material a part of a mesh has, which mesh a photo shows) is left as `?`, which `make validate` refuses, and
listed; so is what must be renamed.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from factorlib.dataset.check import IMAGES, LONGEST_NAME, MESHES, RESERVED_PHOTOS
from factorlib.dataset.schema import LEFT_OUT, MAX_MATERIALS
from factorlib.errors import InputError
from factorlib.labels.coco import Category
from factorlib.labels.png import read_values
from factorlib.meshes.read import read_parts
from factorlib.reading import read_bytes, reading
from factorlib.wholefile import write_text

UNKNOWN = "?"


class Found(msgspec.Struct):
    """What the files say.

    masks: by photo, a path or {material: path};  silhouettes: by photo, {object: path};  parts: by mesh
    missing: what is left to do, in words
    """

    photos: dict[str, Path]
    masks: dict[str, str | dict[str, str]]
    silhouettes: dict[str, dict[str, str]]
    materials: list[str]
    meshes: dict[str, Path]
    parts: dict[str, list[str]]
    missing: list[str]


def new_dataset(target: Path, photos: Path, masks: Path | None, meshes: Path | None) -> list[str]:
    """Copy the files, write target/dataset.yaml, and return what is still missing, in words.

    Raises InputError where the folder is there already, one of the others is not, or there are no photos.
    """
    if target.exists():
        raise InputError("is there already", file=target, key="DATASET", cure="choose another name, or delete it")
    found = look(photos, masks, meshes)
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
        draft = Path(folder) / target.name
        _copied(photos, draft / "photos", found.photos.values())
        if masks is not None:
            _copied(
                masks, draft / "masks", [path for path in masks.rglob("*") if path.suffix.lower() in (".png", ".json")]
            )
        if meshes is not None:
            _copied(
                meshes, draft / "meshes", [path for path in meshes.rglob("*") if path.is_file()]
            )  # with .mtl, buffers
        write_text(draft / "dataset.yaml", yaml_text(found, photos, meshes))
        draft.rename(target)
    return found.missing


def look(photos: Path, masks: Path | None, meshes: Path | None) -> Found:
    """What the files in the folders say."""
    pictures = _by_name(_files(photos, IMAGES, "PHOTOS"), "PHOTOS")
    if not pictures:
        fault = f"there are no photos ({', '.join(IMAGES[:6])}, …) in it"
        raise InputError(fault, file=photos, key="PHOTOS", cure="name their folder")
    found = Found(pictures, {}, {}, [], {}, {}, [])
    if masks is not None:
        _look_at_masks(masks, found)
    if meshes is not None:
        _look_at_meshes(meshes, found)
    found.missing += [
        f"photo {name}: no mask called {name}.png or {name}_<material>.png"
        for name in pictures
        if name not in found.masks
    ]
    taken = [name for name in pictures if name in RESERVED_PHOTOS]
    found.missing += [f"photo {name}: write another `name`: a file of the results is called {name}" for name in taken]
    if not found.meshes:
        found.missing.append("there is no mesh: give MESHES=<folder>; rough ones will do")
    if not found.materials:
        found.missing.append("no mask names a material: write the names in `materials`, label k of a mask the k-th")
    return found


def _look_at_masks(folder: Path, found: Found) -> None:
    files = _files(folder, (".png", ".json"), "MASKS", deep=True)
    coco = [path for path in files if path.suffix.lower() == ".json"]
    names: dict[str, None] = {}
    if coco:
        found.masks = dict.fromkeys(found.photos, f"masks/{coco[0].relative_to(folder)}")
        for category in _categories(coco[0]):
            names[name := _word(category.name)] = None
            if name != category.name:
                file = coco[0].relative_to(folder)
                letters = "names are made of A-Z a-z 0-9 _ and -"
                found.missing.append(f"masks/{file}: rename its category {category.name!r} to {name!r}: {letters}")
        found.missing += [f"masks/{path.relative_to(folder)}: a second COCO file is not used" for path in coco[1:]]
    labels = 0
    for photo in found.photos if not coco else ():
        whole = [path for path in files if path.parent == folder and _name(path) == photo]
        mine = [
            path for path in files if _name(path) not in found.photos
        ]  # kitchen_2.png is the photo kitchen_2's, if there is one
        each = {name: path for path in mine if (name := _material(path, photo, folder))}
        if whole:
            values = np.unique(read_values(whole[0], photo))
            labels = max([labels, *(int(value) for value in values if value <= MAX_MATERIALS)])
            if set(values.tolist()) <= {0, LEFT_OUT}:
                cure = f"the mask of one material is called {photo}_<material>.png"
                found.missing.append(
                    f"photo {photo}: {whole[0].name} has no label, for {LEFT_OUT} means left out; {cure}"
                )
            found.masks[photo] = f"masks/{whole[0].relative_to(folder)}"
            found.silhouettes[photo] = _written(each, folder)
        elif each:
            found.masks[photo] = _written(each, folder)
            names |= dict.fromkeys(sorted(each))
    found.materials = list(names) or [f"label_{k}" for k in range(1, labels + 1)]


def _written(files: dict[str, Path], folder: Path) -> dict[str, str]:
    return {name: f"masks/{path.relative_to(folder)}" for name, path in sorted(files.items())}


def _material(path: Path, photo: str, folder: Path) -> str | None:
    """kitchen_oak.png and kitchen/oak.png are the oak of the kitchen."""
    if path.parent == folder:
        return _name(path).removeprefix(f"{photo}_") if _name(path).startswith(f"{photo}_") else None
    return _name(path) if path.parent == folder / photo else None


def _categories(path: Path) -> list[Category]:
    class Categories(msgspec.Struct):
        """The part of a COCO file that names materials."""

        categories: list[Category]

    with reading("COCO", path, cure="it needs images, annotations and categories"):
        return msgspec.json.decode(read_bytes(path, "COCO"), type=Categories).categories


def _look_at_meshes(folder: Path, found: Found) -> None:
    found.meshes = _by_name(_files(folder, MESHES, "MESHES", deep=True), "MESHES")
    found.parts = {
        name: list(dict.fromkeys(names[0] for names in read_parts(path))) for name, path in found.meshes.items()
    }
    for name, parts in found.parts.items():
        if len(found.materials) != 1 and (open_ := [part for part in parts if part not in found.materials]):
            found.missing.append(
                f"mesh {name}: write which material {', '.join(open_)} {'is' if len(open_) == 1 else 'are'} made of"
            )
    for photo in found.photos if len(found.meshes) > 1 else ():
        if not objects_of(photo, found):
            found.missing.append(f"photo {photo}: write which of the meshes it shows")


def objects_of(photo: str, found: Found) -> list[str]:
    """The meshes that a photo shows: the only one there is, or those whose names are whole words of the photo's."""
    return list(found.meshes) if len(found.meshes) == 1 else [name for name in found.meshes if _is_word_of(name, photo)]


def _is_word_of(name: str, text: str) -> bool:
    """
    >>> _is_word_of("chair", "red_chair-2"), _is_word_of("chair", "armchair_2")
    (True, False)
    """
    return re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", text) is not None


def _files(folder: Path, suffixes: tuple[str, ...], key: str, deep: bool = False) -> list[Path]:
    if not folder.is_dir():
        raise InputError("there is no such folder", file=folder, key=key, cure="name one")
    return sorted(
        path
        for path in (folder.rglob("*") if deep else folder.iterdir())
        if path.suffix.lower() in suffixes and path.is_file()
    )


def _by_name(files: list[Path], key: str) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in files:
        if (name := _name(path)) in found:
            words = f"{path.name} and {found[name].name} would both be called {name!r}"
            raise InputError(words, file=path, key=key, cure="rename one of them")
        found[name] = path
    return found


def _name(path: Path) -> str:
    """A name that dataset.yaml takes.

    >>> _name(Path("IMG 0412 (1).jpeg"))
    'IMG_0412_1'
    """
    return _word(path.stem)


def _word(text: str) -> str:
    """
    >>> _word("red shell")
    'red_shell'
    """
    return re.sub(r"[^A-Za-z0-9-]+", "_", text).strip("_")[:LONGEST_NAME] or "unnamed"


def _copied(source: Path, target: Path, files: object) -> None:
    for path in files:
        place = target / path.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)


def yaml_text(found: Found, photos: Path, meshes: Path | None) -> str:
    """dataset.yaml with remarks for whoever edits it."""
    lines = ["# What the files say; `?` is for you to write.  Every key: docs/dataset.md", "format: 1"]
    lines.append(f"materials: [{', '.join(map(_quoted, found.materials))}]    # label k of a mask is the k-th, from 1")
    lines.append("meshes:" if found.meshes else "meshes: {}")
    for name, path in found.meshes.items():
        lines += [f"  {name}:", f"    file: {_quoted(f'meshes/{path.relative_to(meshes)}')}"]
        if len(found.materials) == 1:
            lines.append(f"    material: {_quoted(found.materials[0])}")
        else:
            lines.append("    parts:    # part of the mesh: material")
            lines += [
                f"      {_quoted(part)}: {_quoted(part if part in found.materials else UNKNOWN)}"
                for part in found.parts[name]
            ]
    lines.append("photos:")
    for name, path in found.photos.items():
        lines += [f"  - name: {_quoted(name)}", f"    image: {_quoted(f'photos/{path.relative_to(photos)}')}"]
        masks = found.masks.get(name, UNKNOWN)
        if isinstance(masks, str):
            lines.append(f"    masks: {_quoted(masks)}")
        else:
            lines += [
                "    masks:",
                *(f"      {_quoted(material)}: {_quoted(file)}" for material, file in masks.items()),
            ]
        objects = objects_of(name, found) or ([UNKNOWN] if found.meshes else [])
        remark = "    # of each: the mesh; another material for a part by `materials: {part: material}`"
        lines.append(f"    objects:{remark}" if objects else "    objects: []")
        silhouettes = found.silhouettes.get(name, {}) if objects else {}
        for each, mask in silhouettes.items():
            mesh = objects[0] if len(objects) == 1 else UNKNOWN
            lines += [
                f"      - name: {_quoted(each)}",
                f"        mesh: {_quoted(mesh)}",
                f"        mask: {_quoted(mask)}",
            ]
        for mesh in objects if not silhouettes else ():
            lines += [f"      - name: {_quoted(mesh)}", f"        mesh: {_quoted(mesh)}"]
    return "\n".join(lines) + "\n"


def _quoted(word: str) -> str:
    """As YAML reads it: plain where it is a word and nothing else.

    >>> _quoted("red"), _quoted("yes"), _quoted("?"), _quoted("1.5")
    ('red', '"yes"', '"?"', '"1.5"')
    """
    special = word.lower() in ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
    plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./-]*", word) and not special
    return word if plain else msgspec.json.encode(word).decode()
