"""A COLMAP model, text or binary: COLMAP's frames and pixels are this project's, so nothing is converted.

Only cameras and images are read, by the layout that COLMAP documents: a model's points and tracks are gigabytes that nothing
here needs, and pycolmap, which reads all of it, takes every count in a binary file at its word (a damaged one keeps it busy
for ever, or fills memory).
"""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pycolmap

from factorlib.dataset.paths import Refusal, check_folder, file_of
from factorlib.dataset.schema import LARGEST
from factorlib.dataset.sources.shot import DAMAGED, Shot, colmap_camera
from factorlib.reading import one_line, reading

KEY = "cameras.colmap"
CURE = "name the folder of cameras and images (.bin or .txt), such as sparse/0"
MODELS = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
MOST_NAME = 4096  # bytes

CameraLine = tuple[int, str, int, int, tuple[float, ...]]  # id, model, width, height, parameters
ImageLine = tuple[
    str, int, tuple[float, ...]
]  # name, id of its camera, quaternion w x y z and translation: cam_from_world


def colmap_shots(path: str, refuse: Refusal) -> list[Shot]:
    """The registered images of the model in the dataset's folder `path`, by name."""
    check_folder(KEY, path, refuse)
    (camera_file, cameras_in), (image_file, images_in) = _files(path, refuse)
    with reading("a COLMAP model", camera_file, KEY, CURE):
        cameras = {number: entry for number, *entry in cameras_in(camera_file)}
        for model, _, _, params in cameras.values():
            if len(params) != _count_of(model):
                raise ValueError(f"a {model} camera has {_count_of(model)} parameters, not {len(params)}")
    with reading("a COLMAP model", image_file, KEY, CURE):
        images = sorted(images_in(image_file), key=lambda line: line[0])
        for name, camera_id, _ in images:
            if camera_id not in cameras:
                raise ValueError(f"image {name!r} has camera {camera_id}, which {camera_file.name} lacks")
    made = {number: colmap_camera(f"{KEY}: camera {number}", *entry, refuse) for number, entry in cameras.items()}
    shots = []
    for name, camera_id, (*quaternion, x, y, z) in images:
        key, camera, length = f"{KEY}: {one_line(name)}", made[camera_id], math.hypot(*quaternion)
        if not (0 < length <= LARGEST and max(abs(x), abs(y), abs(z)) <= LARGEST and not math.isnan(x + y + z)):
            refuse(key, "is no pose: its numbers are zero, not finite or too large", DAMAGED)
        unit = [value / length for value in (*quaternion[1:], quaternion[0])]
        motion = pycolmap.Rigid3d(pycolmap.Rotation3d(unit), [x, y, z])
        shots.append(Shot(name, camera, (camera.width, camera.height), key, cam_from_world=motion))
    return shots


def _files(path: str, refuse: Refusal) -> list[tuple[Path, Callable]]:
    """Cameras and images of the model, each with its reader."""
    for suffix, readers in ((".bin", (_binary_cameras, _binary_images)), (".txt", (_text_cameras, _text_images))):
        files = [file_of(KEY, path, f"{name}{suffix}", refuse) for name in ("cameras", "images")]
        if all(files):
            return list(zip(files, readers))
    refuse(KEY, f"{path!r} is not readable as a COLMAP model (it has no cameras and images, .bin or .txt)", CURE)


def _count_of(model: str) -> int:
    """How many parameters a camera model has."""
    if model not in MODELS.values():
        raise ValueError(f"{one_line(model)!r} is no camera model")
    return len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)


class _Records:
    """The bytes of a file, taken one record after the other; ValueError or struct.error where they end too early."""

    def __init__(self, content: mmap.mmap):
        self.content, self.place = content, 0

    def take(self, layout: str) -> tuple:
        """The next values of a `struct` layout, little-endian."""
        values = struct.unpack_from(f"<{layout}", self.content, self.place)
        self.place += struct.calcsize(f"<{layout}")
        return values

    def image(self) -> ImageLine:
        """The next image: its pose, its name, which a zero byte ends, and its points, which are passed over."""
        _, *pose, camera_id = self.take("I7dI")
        end = self.content.find(b"\0", self.place, self.place + MOST_NAME)
        if end < 0:
            raise ValueError("the name of an image does not end")
        name, self.place = self.content[self.place : end].decode("utf-8"), end + 1
        (points,) = self.take("Q")
        self.place += points * struct.calcsize("<2dQ")
        if self.place > len(self.content):
            raise ValueError("it ends in the middle of an image")
        return name, camera_id, tuple(pose)


def _records(file: Path) -> Iterator[_Records]:
    """One for each of the records that the file announces."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        records = _Records(content)
        for _ in range(records.take("Q")[0]):
            yield records


def _binary_cameras(file: Path) -> Iterator[CameraLine]:
    for records in _records(file):
        number, model, width, height = records.take("IiQQ")
        if model not in MODELS:
            raise ValueError(f"{model} is no camera model")
        yield number, MODELS[model], width, height, records.take(f"{_count_of(MODELS[model])}d")


def _binary_images(file: Path) -> Iterator[ImageLine]:
    for records in _records(file):
        yield records.image()


def _text_cameras(file: Path) -> Iterator[CameraLine]:
    with file.open(encoding="utf-8") as lines:
        for line in filter(_says_something, lines):
            number, model, width, height, *params = line.split()
            yield int(number), model, int(width), int(height), tuple(map(float, params))


def _text_images(file: Path) -> Iterator[ImageLine]:
    """Two lines each; the second, of points, may be empty."""
    with file.open(encoding="utf-8") as lines:
        for line in filter(_says_something, lines):
            words = line.strip().split(maxsplit=9)
            if len(words) != 10:
                raise ValueError(f"{one_line(line)!r} is no line of an image: it has {len(words)} words of 10")
            next(lines, None)
            yield words[9], int(words[8]), tuple(map(float, words[1:8]))


def _says_something(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")
