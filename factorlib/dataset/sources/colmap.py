"""A COLMAP model, text or binary: COLMAP's frames and pixels are this project's, so nothing is converted.

Only cameras and images are read, by the layout that COLMAP documents: a model's points and tracks are gigabytes that nothing
here needs, and pycolmap, which reads all of it, takes every count in a binary file at its word (a damaged one keeps it busy
for ever, or fills memory).  Its cameras are what the rest of the sources work with.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pycolmap

from factorlib.dataset.paths import Refusal, check_folder, file_of
from factorlib.dataset.sources.shot import Shot, colmap_camera, turned
from factorlib.reading import one_line, reading

KEY = "cameras.colmap"
CURE = "name the folder of cameras and images (.bin or .txt), such as sparse/0"
MODELS = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
MOST_NAME = 4096  # bytes


class Line(msgspec.Struct, frozen=True):
    """An image as a model lists it; quaternion: w x y z, of cam_from_world."""

    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str


def colmap_shots(path: str, refuse: Refusal) -> list[Shot]:
    """The registered images of the model in the dataset's folder `path`, by name."""
    check_folder(KEY, path, refuse)
    (camera_file, read_cameras), (image_file, read_images) = _files(path, refuse)
    with reading("a COLMAP model", camera_file, KEY, CURE):
        listed = {number: _checked(*entry) for number, *entry in read_cameras(camera_file)}
    with reading("a COLMAP model", image_file, KEY, CURE):
        lines = sorted(read_images(image_file), key=lambda line: line.name)
        missing = next((line for line in lines if line.camera_id not in listed), None)
        if missing is not None:
            raise ValueError(f"image {missing.name!r} has camera {missing.camera_id}, which {camera_file.name} lacks")
    cameras = {number: colmap_camera(f"{KEY}: camera {number}", *entry, refuse) for number, entry in listed.items()}
    return [_shot(line, cameras[line.camera_id], refuse) for line in lines]


def _files(path: str, refuse: Refusal) -> list[tuple[Path, Callable]]:
    """Cameras and images of the model, each with its reader."""
    for suffix, readers in ((".bin", (_binary_cameras, _binary_images)), (".txt", (_text_cameras, _text_images))):
        files = [file_of(KEY, path, f"{name}{suffix}", refuse) for name in ("cameras", "images")]
        if all(files):
            return list(zip(files, readers))
    refuse(KEY, f"{path!r} is not readable as a COLMAP model (it has no cameras and images, .bin or .txt)", CURE)


def _shot(line: Line, camera: pycolmap.Camera, refuse: Refusal) -> Shot:
    key = f"{KEY}: {one_line(line.name)}"
    w, x, y, z = line.quaternion
    rotation = turned(key, (x, y, z, w), line.translation, refuse)
    return Shot(image=line.name, camera=camera, size=(camera.width, camera.height), key=key, cam_from_world=rotation)


def _checked(model: str, width: int, height: int, params: tuple[float, ...]) -> tuple[str, int, int, tuple[float, ...]]:
    if len(params) != count_of(model):
        raise ValueError(f"a {model} camera has {count_of(model)} parameters, not {len(params)}")
    return model, width, height, params


def count_of(model: str) -> int:
    """How many parameters a camera model has.

    >>> count_of("PINHOLE")
    4
    """
    if model not in MODELS.values():
        raise ValueError(f"{one_line(model)!r} is no camera model")
    return len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)


# ── binary ───────────────────────────────────────────────────────────────────────────────────────────────────────────


class Records:
    """The bytes of a file, taken one record after the other; ValueError or struct.error where they end too early."""

    def __init__(self, content: mmap.mmap):
        self.content, self.place = content, 0

    def take(self, layout: str) -> tuple:
        """The next values of a `struct` layout, little-endian."""
        values = struct.unpack_from(f"<{layout}", self.content, self.place)
        self.place += struct.calcsize(f"<{layout}")
        return values

    def word(self) -> str:
        """The next UTF-8 text, which a zero byte ends."""
        end = self.content.find(b"\0", self.place, self.place + MOST_NAME)
        if end < 0:
            raise ValueError("the name of an image does not end")
        text = self.content[self.place : end].decode("utf-8")
        self.place = end + 1
        return text

    def skip(self, count: int) -> None:
        """Pass over `count` bytes."""
        self.place += count
        if self.place > len(self.content):
            raise ValueError("it ends in the middle of an image")


def _records(file: Path) -> Iterator[Records]:
    """One for each of the records that the file announces."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        records = Records(content)
        (count,) = records.take("Q")
        for _ in range(count):
            yield records


def _binary_cameras(file: Path) -> Iterator[tuple]:
    for records in _records(file):
        number, model, width, height = records.take("IiQQ")
        if model not in MODELS:
            raise ValueError(f"{model} is no camera model")
        yield number, MODELS[model], width, height, records.take(f"{count_of(MODELS[model])}d")


def _binary_images(file: Path) -> Iterator[Line]:
    for records in _records(file):
        _, *numbers, camera_id = records.take("I7dI")
        name = records.word()
        (points,) = records.take("Q")
        records.skip(points * struct.calcsize("<2dQ"))
        yield Line(tuple(numbers[:4]), tuple(numbers[4:]), camera_id, name)


# ── text ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _text_cameras(file: Path) -> Iterator[tuple]:
    with file.open(encoding="utf-8") as lines:
        for line in filter(_says_something, lines):
            number, model, width, height, *params = line.split()
            yield int(number), model, int(width), int(height), tuple(map(float, params))


def _text_images(file: Path) -> Iterator[Line]:
    """Two lines each; the second, of points, may be empty."""
    with file.open(encoding="utf-8") as lines:
        for line in filter(_says_something, lines):
            words = line.strip().split(maxsplit=9)
            if len(words) != 10:
                raise ValueError(f"{one_line(line)!r} is no line of an image: it has {len(words)} words of 10")
            _, *numbers, camera_id, name = words
            next(lines, None)
            yield Line(tuple(map(float, numbers[:4])), tuple(map(float, numbers[4:])), int(camera_id), name)


def _says_something(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")
