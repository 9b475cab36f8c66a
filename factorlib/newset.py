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
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from factorlib.dataset.check import IMAGES, MESHES, RESERVED_PHOTOS
from factorlib.dataset.schema import LEFT_OUT, LONGEST_NAME, MAX_MATERIALS
from factorlib.errors import InputError
from factorlib.labels.coco import Category
from factorlib.labels.png import read_values
from factorlib.meshes.read import read_parts
from factorlib.reading import read_bytes, reading
from factorlib.wholefile import write_text

UNKNOWN = "?"


class Files(msgspec.Struct):
    """A data set as its files say it.

    masks: by photo, a path or {material: path};  silhouettes: by photo, {object: path};  parts: by mesh
    missing: what is left to do, in words
    """

    photos: dict[str, Path]
    masks: dict[str, str | dict[str, str]] = {}
    silhouettes: dict[str, dict[str, str]] = {}
    materials: list[str] = []
    meshes: dict[str, Path] = {}
    parts: dict[str, list[str]] = {}
    missing: list[str] = []

    def shown_in(self, photo: str) -> list[str]:
        """The meshes that a photo shows: the only one there is, or those whose names are whole words of the photo's."""
        word = r"(?<![A-Za-z0-9]){}(?![A-Za-z0-9])"
        return [mesh for mesh in self.meshes
                if len(self.meshes) == 1 or re.search(word.format(re.escape(mesh)), photo)]  # fmt: skip


def new_dataset(target: Path, photos: Path, masks: Path | None, meshes: Path | None) -> list[str]:
    """Copy the files, write target/dataset.yaml, and return what is still missing, in words.

    Raises InputError where the folder is there already, one of the others is not, or there are no photos.
    """
    if target.exists():
        raise InputError("is there already", file=target, key="DATASET", cure="choose another name, or delete it")
    files = Files(_by_name(_files(photos, IMAGES, "PHOTOS"), "PHOTOS"))
    if not files.photos:
        fault = f"there are no photos ({', '.join(IMAGES[:6])}, …) in it"
        raise InputError(fault, file=photos, key="PHOTOS", cure="name their folder")
    if masks is not None:
        _look_at_masks(masks, files)
    if meshes is not None:
        _look_at_meshes(meshes, files)
    for photo in [photo for photo in files.photos if photo not in files.masks]:
        files.missing.append(f"photo {photo}: no mask called {photo}.png or {photo}_<material>.png")
    for photo in [photo for photo in files.photos if photo in RESERVED_PHOTOS]:
        files.missing.append(f"photo {photo}: write another `name`: a file of the results is called {photo}")
    if not files.meshes:
        files.missing.append("there is no mesh: give MESHES=<folder>; rough ones will do")
    if not files.materials:
        files.missing.append("no mask names a material: write the names in `materials`, label k of a mask the k-th")
    target.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
        draft, chosen = Path(folder) / target.name, set(files.photos.values())
        _copy(photos, draft / "photos", lambda path: path in chosen)
        _copy(masks, draft / "masks", lambda path: path.suffix.lower() in (".png", ".json"))
        _copy(meshes, draft / "meshes", Path.is_file)  # with .mtl, buffers
        write_text(draft / "dataset.yaml", _yaml(files, photos, meshes))
        draft.rename(target)
    return files.missing


def _copy(source: Path | None, target: Path, wanted: Callable[[Path], bool]) -> None:
    for path in source.rglob("*") if source is not None else ():
        if wanted(path):
            place = target / path.relative_to(source)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)


def _look_at_masks(folder: Path, files: Files) -> None:
    paths = _files(folder, (".png", ".json"), "MASKS", deep=True)
    coco = [path for path in paths if path.suffix.lower() == ".json"]
    names: dict[str, None] = {}
    if coco:
        file = f"masks/{coco[0].relative_to(folder)}"
        files.masks = dict.fromkeys(files.photos, file)
        for category in _categories(coco[0]):
            names[name := _word(category.name)] = None
            if name != category.name:
                letters = "names are made of A-Z a-z 0-9 _ and -"
                files.missing.append(f"{file}: rename its category {category.name!r} to {name!r}: {letters}")
        files.missing += [f"masks/{path.relative_to(folder)}: a second COCO file is not used" for path in coco[1:]]
    labels = 0
    free = [path for path in paths if _word(path.stem) not in files.photos]  # kitchen_2.png may be a photo's own
    for photo in files.photos if not coco else ():
        whole = [path for path in paths if path.parent == folder and _word(path.stem) == photo]
        each = {name: path for path in free if (name := _material(path, photo, folder))}
        written = {name: f"masks/{path.relative_to(folder)}" for name, path in sorted(each.items())}
        if whole:
            values = set(np.unique(read_values(whole[0], photo)).tolist())
            labels = max([labels, *(value for value in values if value <= MAX_MATERIALS)])
            if values <= {0, LEFT_OUT}:
                cure = f"the mask of one material is called {photo}_<material>.png"
                fault = f"{whole[0].name} has no label, for {LEFT_OUT} means left out"
                files.missing.append(f"photo {photo}: {fault}; {cure}")
            files.masks[photo], files.silhouettes[photo] = f"masks/{whole[0].relative_to(folder)}", written
        elif each:
            files.masks[photo] = written
            names |= dict.fromkeys(written)
    files.materials = list(names) or [f"label_{k}" for k in range(1, labels + 1)]


def _material(path: Path, photo: str, folder: Path) -> str | None:
    """kitchen_oak.png and kitchen/oak.png are the oak of the kitchen."""
    name = _word(path.stem)
    if path.parent == folder:
        return name.removeprefix(f"{photo}_") if name.startswith(f"{photo}_") else None
    return name if path.parent == folder / photo else None


def _categories(path: Path) -> list[Category]:
    class Categories(msgspec.Struct):
        """The part of a COCO file that names materials."""

        categories: list[Category]

    with reading("COCO", path, cure="it needs images, annotations and categories"):
        return msgspec.json.decode(read_bytes(path, "COCO"), type=Categories).categories


def _look_at_meshes(folder: Path, files: Files) -> None:
    files.meshes = _by_name(_files(folder, MESHES, "MESHES", deep=True), "MESHES")
    for name, path in files.meshes.items():
        files.parts[name] = list(dict.fromkeys(names[0] for names in read_parts(path)))
        undecided = [part for part in files.parts[name] if part not in files.materials]
        if len(files.materials) != 1 and undecided:
            verb = "is" if len(undecided) == 1 else "are"
            files.missing.append(f"mesh {name}: write which material {', '.join(undecided)} {verb} made of")
    for photo in files.photos if len(files.meshes) > 1 else ():
        if not files.shown_in(photo):
            files.missing.append(f"photo {photo}: write which of the meshes it shows")


def _files(folder: Path, suffixes: tuple[str, ...], key: str, deep: bool = False) -> list[Path]:
    if not folder.is_dir():
        raise InputError("there is no such folder", file=folder, key=key, cure="name one")
    paths = folder.rglob("*") if deep else folder.iterdir()
    return sorted(path for path in paths if path.suffix.lower() in suffixes and path.is_file())


def _by_name(paths: list[Path], key: str) -> dict[str, Path]:
    named: dict[str, Path] = {}
    for path in paths:
        if (other := named.setdefault(name := _word(path.stem), path)) != path:
            fault = f"{path.name} and {other.name} would both be called {name!r}"
            raise InputError(fault, file=path, key=key, cure="rename one of them")
    return named


def _word(text: str) -> str:
    """A name that dataset.yaml takes.

    >>> _word("IMG 0412 (1)")
    'IMG_0412_1'
    """
    return re.sub(r"[^A-Za-z0-9-]+", "_", text).strip("_")[:LONGEST_NAME] or "unnamed"


def _yaml(files: Files, photos: Path, meshes: Path | None) -> str:
    """dataset.yaml with remarks for whoever edits it."""
    only = files.materials[0] if len(files.materials) == 1 else None
    lines = ["# What the files say; `?` is for you to write.  Every key: docs/dataset.md", "format: 1"]
    lines.append(f"materials: [{', '.join(map(_quoted, files.materials))}]    # label k of a mask is the k-th, from 1")
    lines.append("meshes:" if files.meshes else "meshes: {}")
    for name, path in files.meshes.items():
        lines += [f"  {name}:", f"    file: {_quoted(f'meshes/{path.relative_to(meshes)}')}"]
        lines.append(f"    material: {_quoted(only)}" if only else "    parts:    # part of the mesh: material")
        for part in files.parts[name] if not only else ():
            lines.append(f"      {_quoted(part)}: {_quoted(part if part in files.materials else UNKNOWN)}")
    lines.append("photos:")
    for name, path in files.photos.items():
        lines += [f"  - name: {_quoted(name)}", f"    image: {_quoted(f'photos/{path.relative_to(photos)}')}"]
        masks = files.masks.get(name, UNKNOWN)
        lines.append(f"    masks: {_quoted(masks)}" if isinstance(masks, str) else "    masks:")
        for material, file in masks.items() if not isinstance(masks, str) else ():
            lines.append(f"      {_quoted(material)}: {_quoted(file)}")
        objects = files.shown_in(name) or ([UNKNOWN] if files.meshes else [])
        remark = "    # of each: the mesh; another material for a part by `materials: {part: material}`"
        lines.append(f"    objects:{remark}" if objects else "    objects: []")
        silhouettes = files.silhouettes.get(name) if objects else None
        mesh = objects[0] if len(objects) == 1 else UNKNOWN
        for each, of, mask in [(e, mesh, m) for e, m in (silhouettes or {}).items()] or [(o, o, None) for o in objects]:
            lines += [f"      - name: {_quoted(each)}", f"        mesh: {_quoted(of)}"]
            lines += [f"        mask: {_quoted(mask)}"] if mask else []
    return "\n".join(lines) + "\n"


def _quoted(word: str) -> str:
    """As YAML reads it: plain where it is a word and nothing else.

    >>> _quoted("red"), _quoted("yes"), _quoted("?"), _quoted("1.5")
    ('red', '"yes"', '"?"', '"1.5"')
    """
    special = word.lower() in ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
    plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./-]*", word) and not special
    return word if plain else msgspec.json.encode(word).decode()
