"""Contents of a folder of photographs as other programs leave it: photos, masks and cameras.

Cameras are a NeRF-style transforms.json or a COLMAP model; the photos are then those that it names.  Else they are the
images of the folder, or, if it has none, those of its subfolders.  A mask is the image that transforms.json names as
`mask_path`, `<photo>_mask.png` (Metashape), `<photo>.<suffix>.png` (COLMAP), or an image in a folder `mask…`.  It
belongs to the photo of the same name that shares the most folders with it.  Maps of depth and confidence, thumbnails,
and copies at a smaller size (`images_2` beside `images`) are no photos.
"""

import os
import re
from collections import Counter
from collections.abc import Collection, Container, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from factorlib.dataset.check import IMAGES, MASK_IMAGES
from factorlib.dataset.paths import Refusal, nearest_paths, plain_path
from factorlib.dataset.sources.colmap import read_colmap
from factorlib.dataset.sources.source_image import MOST_BYTES
from factorlib.errors import InputError
from factorlib.reading import read_bytes, reading

TRANSFORMS = ("transforms.json", "transforms_train.json")
MODELS = tuple((f"cameras{suffix}", f"images{suffix}") for suffix in (".bin", ".txt"))
PICTURES = (*IMAGES, *MASK_IMAGES)
AUXILIARY = re.compile(
    r"(depth|confidence|normal|thumb(nail)?|preview)s?([_-]?maps?)?(_\d+)?", re.IGNORECASE
)  # names, no photos
MASK_FOLDER = re.compile(r"(^|[_ -])(mask|msk|segmentation|silhouette)", re.IGNORECASE)
DOWNSAMPLED = re.compile(r"^((?:image|mask)s?)_\d+$")  # folders of copies, as NeRF's programs write them
UNREAD = (".webp", ".avif", ".bmp", ".gif", ".tga", ".jxl", ".jp2")  # pictures that are no photos
SUFFIXES = (*PICTURES, ".json", ".bin", ".txt")  # suffixes of the files that are examined


class Cameras(msgspec.Struct):
    """A source of cameras.

    Attributes:
        source: the key `cameras` of dataset.yaml; empty if no cameras are known
        folder: folder of its files
        files: its files, to be copied to cameras/ as they lie in the folder
        by_photo: further keys of photos in dataset.yaml
        notes: assumptions, in words
        left_out: names of photos that the dataset does without
        revolved: True if no source is known, and every mask looks like a body of revolution
    """

    source: dict[str, Any] = {}
    folder: Path | None = None
    files: list[Path] = []
    by_photo: dict[str, dict[str, Any]] = {}
    notes: list[str] = []
    left_out: list[str] = []
    revolved: bool = False


def read_photo_folder(folder: Path, files: list[Path]) -> tuple[list[Path], dict[Path, Path], Cameras | None]:
    """Sort the files of a folder and its subfolders.

    Returns:
        The photos, the mask of each that has one, and their cameras, if files give these.

    Raises:
        InputError: A mask may be that of several photos, a photo has several masks, or a named mask does not exist.
    """
    places = {plain_path(path.relative_to(folder)): path for path in files if path.suffix.lower() in PICTURES}
    places = {p: places[p] for p in places if not any(map(AUXILIARY.fullmatch, (*p.parent.parts, p.stem)))}
    folders = {above for place in places for above in place.parents}
    full = {p for p in places if not any(_is_copy(above, folders) for above in p.parents if above.name)}
    stems = {stem_of(place) for place in places}
    cameras, frames = _cameras(folder, files)
    masks = {p: stem_of_mask(p) for p in places if _is_mask(p, stems)}
    named_masks = {*frames.values()}
    photos = {p: stem_of(p) for p in places if p.suffix.lower() in IMAGES and p not in masks and p not in named_masks}
    # the images that cameras name, of several copies the largest; else those at the top, or in subfolders
    pairs = _namesakes({name: stem_of(name) for name in frames}, photos)
    named = dict(sorted(pairs, key=lambda pair: (pair[1] in full, places[pair[1]].stat().st_size)))
    images = [*named.values()] or [p for p in photos if p in full and not p.parent.name] or full.intersection(photos)
    # masks that transforms.json names, or that are called as a photo
    paired = {image: mask for name, image in named.items() if (mask := frames[name]) in places}
    unpaired = {p: photos[p] for p in images if p not in paired}
    paired |= _pair(unpaired, {p: masks[p] for p in masks if p in full}, folder)
    if gone := [name for name, image in named.items() if frames[name] and image not in paired]:
        raise InputError(
            f"there is no picture '{frames[gone[0]]}'",
            file=cameras.files[0] if cameras else folder,
            key=f"mask_path of {gone[0]}",
            cure="put it there, or delete the key",
        )
    return sorted(places[p] for p in images), {places[p]: places[mask] for p, mask in paired.items()}, cameras


def left_out(folder: Path, files: Iterable[Path], photos: Collection[Path]) -> list[str]:
    """Return the pictures among `files` that would be photos in another format, relative to the folder.

    Where photos lie in the folder itself, its subfolders have none.
    """
    is_deep = all(path.parent != folder for path in photos)
    places = [plain_path(path.relative_to(folder)) for path in files]
    return [
        str(place)
        for place in places
        if (is_deep or not place.parent.name)
        and stem_of_mask(place) == place.stem
        and not any(map(AUXILIARY.fullmatch, (*place.parent.parts, place.stem)))
        and not any(MASK_FOLDER.search(name) or DOWNSAMPLED.match(name) for name in place.parent.parts)
    ]


def stem_of(path: PurePosixPath) -> str:
    """Return the name of a file without the suffix of an image; "r_0.5" has none.

    >>> stem_of(PurePosixPath("./train/r_0.5")), stem_of(PurePosixPath("0001.png"))
    ('r_0.5', '0001')
    """
    return path.stem if path.suffix.lower() in PICTURES else path.name


def _is_copy(folder: PurePosixPath, folders: Container[PurePosixPath]) -> bool:
    """Return True for a folder beside that of the same pictures at full size, or with the lens's distortion removed."""
    better = {DOWNSAMPLED.sub(r"\1", folder.name), f"corrected_{folder.name}"} - {folder.name}
    return any(folder.with_name(name) in folders for name in better)


def stem_of_mask(path: PurePosixPath) -> str:
    """Return the stem of the photo whose mask a file is: of 0001.jpg.png and 0001_mask.png it is 0001."""
    return stem_of(PurePosixPath(re.sub("(?i)[_.-]mask$", "", path.stem)))


def _is_mask(place: PurePosixPath, stems: set[str]) -> bool:
    """Return True for an image in a folder of masks, and for one that is called as the mask of another."""
    stem = stem_of_mask(place)
    return any(map(MASK_FOLDER.search, place.parent.parts)) or (stem in stems and stem != stem_of(place))


def _namesakes(
    ones: Mapping[PurePosixPath, str], others: Mapping[PurePosixPath, str]
) -> list[tuple[PurePosixPath, PurePosixPath]]:
    """Return the pairs of paths of the same stem of which neither shares more folders with another path.

    Args:
        ones: stems by path
        others: stems by path
    """
    by_stem: dict[str, tuple[list, list]] = {}
    for side, paths in enumerate((ones, others)):
        for path, stem in paths.items():
            by_stem.setdefault(stem, ([], []))[side].append(path)
    return [
        (one, other)
        for left, right in by_stem.values()
        for one in left
        for other in nearest_paths(one, right)
        if one in nearest_paths(other, left)
    ]


def _pair(
    photos: Mapping[PurePosixPath, str], masks: Mapping[PurePosixPath, str], folder: Path
) -> dict[PurePosixPath, PurePosixPath]:
    """Return the mask of each photo that has one, from stems by path; InputError where several are possible."""
    pairs = _namesakes(photos, masks)
    times = Counter(path for pair in pairs for path in pair)
    for photo, mask in pairs:
        if times[photo] > 1 or times[mask] > 1:
            raise InputError(
                f"it is not clear whether it is the mask of {photo}: there are others of this name",
                file=folder / mask,
                key="PHOTOS",
                cure="put masks into subfolders as the photos are, masks/<folder>/<photo>.png, one for each photo",
            )
    return dict(pairs)


def _beside(file: Path, path: str) -> PurePosixPath:
    """Return a path that a file names relative to itself."""
    return plain_path(os.path.normpath(file.parent / plain_path(path)))


def _cameras(folder: Path, files: list[Path]) -> tuple[Cameras | None, dict[PurePosixPath, PurePosixPath | None]]:
    """Return the cameras in a folder, and the names of images in them, each with the place of its mask or None.

    Both are relative to the folder.  The source is the transforms.json nearest to the top, else the largest model.
    """
    if transforms := sorted((path for path in files if path.name in TRANSFORMS), key=lambda path: len(path.parts)):
        with reading("transforms.json", transforms[0], "PHOTOS"):
            frames = msgspec.json.decode(read_bytes(transforms[0], "JSON", most_bytes=MOST_BYTES))["frames"]
            masks = {str(frame["file_path"]): frame.get("mask_path") for frame in frames}
        file = transforms[0].relative_to(folder)
        names = {_beside(file, name): mask and _beside(file, mask) for name, mask in masks.items()}
        return Cameras({"transforms": f"cameras/{file.as_posix()}"}, folder, transforms[:1]), names
    pairs = ([path.with_name(camera), path] for camera, image in MODELS for path in files if path.name == image)
    if not (models := [pair for pair in pairs if pair[0] in files]):
        return None, {}
    model = max(models, key=lambda pair: pair[1].stat().st_size)
    at = model[0].parent.relative_to(folder).as_posix()
    images = read_colmap(at, Refusal(model[1], folder))
    return Cameras({"colmap": f"cameras/{at}"}, folder, model), {plain_path(f"{at}/{i.name}"): None for i in images}
