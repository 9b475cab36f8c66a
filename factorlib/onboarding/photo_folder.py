"""Contents of a folder of photographs as other programs leave it: photos, masks and cameras.

Cameras are a NeRF-style transforms.json or a COLMAP model; the photos are then those that it names.  Else they are the
images of the folder, or, if it has none, those of its subfolders.  A mask is the image that transforms.json names as
`mask_path`, `<photo>_mask.png` (Metashape), `<photo>.<suffix>.png` (COLMAP), or an image in a folder `mask…`.
"""

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from factorlib.dataset.check import IMAGES
from factorlib.dataset.paths import Refusal
from factorlib.dataset.sources.colmap import read_colmap
from factorlib.dataset.sources.source_image import MOST_BYTES
from factorlib.reading import read_bytes, reading

TRANSFORMS = ("transforms.json", "transforms_train.json")
MODELS = tuple((f"cameras{suffix}", f"images{suffix}") for suffix in (".bin", ".txt"))
SUFFIXES = (*IMAGES, ".json", ".bin", ".txt")  # suffixes of the files that are examined


class Cameras(msgspec.Struct):
    """A source of cameras.

    Attributes:
        source: the key `cameras` of dataset.yaml; empty if no cameras are known
        folder: folder of its files
        files: its files, to be copied to cameras/ as they lie in the folder
        by_photo: further keys of photos in dataset.yaml
    """

    source: dict[str, Any] = {}
    folder: Path | None = None
    files: list[Path] = []
    by_photo: dict[str, dict[str, Any]] = {}


class PhotoFolder(msgspec.Struct):
    """Contents of a folder of photographs.

    Attributes:
        images: the photos
        masks: mask of a photo by the stem of its name, where there is one
        cameras: cameras of the photos, if files give them
    """

    images: list[Path]
    masks: dict[str, Path]
    cameras: Cameras | None = None


def read_photo_folder(folder: Path, files: list[Path]) -> PhotoFolder:
    """Sort the files of a folder and its subfolders."""
    pictures = [path for path in files if path.suffix.lower() in IMAGES]
    stems = {stem_of(path.name) for path in pictures}
    masks = {stem: path for path in pictures if (stem := _masked_stem(path.relative_to(folder), stems))}
    images = sorted(set(pictures).difference(masks.values()))
    cameras, names = _cameras(folder, files)
    if cameras:
        named = {stem_of(name): cameras.files[0].parent / str(mask) for name, mask in names.items()}
        masks |= {stem: path for stem, path in named.items() if path in files}
        images = _named_images(folder, images, names) or images
    else:
        images = [path for path in images if path.parent == folder] or images
    return PhotoFolder(images, masks, cameras)


def stem_of(name: str) -> str:
    """Return a file's name without folder and without the suffix of an image: "r_0.5" has none."""
    path = PurePosixPath(name)
    return path.stem if path.suffix.lower() in IMAGES else path.name


def _masked_stem(path: Path, stems: set[str]) -> str | None:
    """Return the stem of the photo whose mask an image is; None if it is a photo."""
    stem = path.stem.removesuffix("_mask")
    inner = stem_of(stem)
    named = inner in stems and inner != path.stem
    in_folder = any(part.lower().startswith("mask") for part in path.parts[:-1])
    return inner if path.suffix.lower() == ".png" and (named or in_folder) else None


def _cameras(folder: Path, files: list[Path]) -> tuple[Cameras | None, dict[str, Any]]:
    """Return the cameras in a folder, and the image names in them, each with its mask; the source nearest to the top.

    Of several COLMAP models it is the largest one.
    """
    if transforms := sorted((path for path in files if path.name in TRANSFORMS), key=lambda path: len(path.parts)):
        with reading("transforms.json", transforms[0], "PHOTOS"):
            frames = msgspec.json.decode(read_bytes(transforms[0], "JSON", most_bytes=MOST_BYTES))["frames"]
            names = {str(frame["file_path"]): frame.get("mask_path") for frame in frames}
        place = transforms[0].relative_to(folder).as_posix()
        return Cameras({"transforms": f"cameras/{place}"}, folder, transforms[:1]), names
    pairs = [[path.with_name(camera), path] for camera, image in MODELS for path in files if path.name == image]
    models = [pair for pair in pairs if pair[0] in files]
    if not models:
        return None, {}
    model = max(models, key=lambda pair: pair[1].stat().st_size)
    place = model[0].parent.relative_to(folder).as_posix()
    images = read_colmap(place, Refusal(model[1], folder))
    return Cameras({"colmap": f"cameras/{place}"}, folder, model), {str(image.name): None for image in images}


def _named_images(folder: Path, images: list[Path], names: Iterable[str]) -> list[Path]:
    """Return the images that a source of cameras names, of one folder if it names none."""
    wanted = {(PurePosixPath(name).parent.name, stem_of(name)) for name in names}
    exact = [path for path in images if (path.parent.name, stem_of(path.name)) in wanted]
    if exact:
        return exact
    named = [path for path in images if stem_of(path.name) in {stem for _, stem in wanted}]
    # smaller copies may lie in images_2 and images_4: take the folder of most images, and of these that of most bytes
    sizes: dict[Path, list[int]] = {}
    for path in named:
        sizes.setdefault(path.parent, []).append(path.stat().st_size)
    best = max(sizes, key=lambda parent: (len(sizes[parent]), sum(sizes[parent])), default=folder)
    return [path for path in named if path.parent == best]
