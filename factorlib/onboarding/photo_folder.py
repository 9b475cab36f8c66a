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
        notes: assumptions, in words
        revolved: True if no source is known, and every mask looks like a body of revolution
    """

    source: dict[str, Any] = {}
    folder: Path | None = None
    files: list[Path] = []
    by_photo: dict[str, dict[str, Any]] = {}
    notes: list[str] = []
    revolved: bool = False


def read_photo_folder(folder: Path, files: list[Path]) -> tuple[list[Path], dict[str, Path], Cameras | None]:
    """Sort the files of a folder and its subfolders.

    Returns:
        The photos, their masks by the stems of their names, and their cameras, if files give these.
    """
    pictures = [path for path in files if path.suffix.lower() in IMAGES]
    stems = {path.stem for path in pictures}
    masks = {stem: path for path in pictures if (stem := _masked_stem(path.relative_to(folder), stems))}
    images = sorted(set(pictures).difference(masks.values()))
    cameras, names = _cameras(folder, files)
    if cameras:
        named = {folder_and_stem(name)[1]: cameras.files[0].parent / str(mask) for name, mask in names.items()}
        masks |= {stem: path for stem, path in named.items() if path in files}
        images = _named_images(images, names) or images
    else:
        images = [path for path in images if path.parent == folder] or images
    return images, masks, cameras


def folder_and_stem(name: str) -> tuple[str, str]:
    """Return the folder in a file's path, and its name without the suffix of an image; "r_0.5" has none.

    >>> folder_and_stem("./train/r_0.5"), folder_and_stem("0001.png")
    (('train', 'r_0.5'), ('', '0001'))
    """
    path = PurePosixPath(name)
    return path.parent.name, path.stem if path.suffix.lower() in IMAGES else path.name


def _masked_stem(path: Path, stems: set[str]) -> str | None:
    """Return the stem of the photo whose mask an image is; None if it is a photo."""
    stem = path.stem.removesuffix("_mask")
    inner = folder_and_stem(stem)[1]
    named = inner in stems and inner != path.stem
    in_folder = any(part.lower().startswith("mask") for part in path.parts[:-1])
    return inner if in_folder or (named and path.suffix.lower() == ".png") else None


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


def _named_images(images: list[Path], names: Iterable[str]) -> list[Path]:
    """Return the images that a source of cameras names, each from the largest file if it names no folders."""
    wanted = {folder_and_stem(name) for name in names}
    exact = [path for path in images if folder_and_stem(str(path)) in wanted]
    stems = {stem for _, stem in wanted}
    by_size = sorted((path for path in images if path.stem in stems), key=lambda path: path.stat().st_size)
    return exact or sorted({path.stem: path for path in by_size}.values())
