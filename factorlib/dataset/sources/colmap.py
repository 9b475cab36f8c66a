"""Reading of a COLMAP model, text or binary.  COLMAP's frames and pixels are this project's, so nothing is converted.

Only cameras and images are read, by the layout that COLMAP documents.  A model's points and tracks are gigabytes that
are not needed here.  pycolmap reads all of it and trusts every count in a binary file.  A damaged one keeps it busy for
ever or fills memory.
"""

import math
import mmap
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pycolmap

from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import LARGEST
from factorlib.dataset.sources.source_image import DAMAGED, SourceImage, colmap_camera
from factorlib.reading import one_line, reading

KEY = "cameras.colmap"
CURE = "name the folder of cameras and images (.bin or .txt), such as sparse/0"
MODELS = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
POINTS = re.compile(r"(\s*[-+.\deE]+\s+[-+.\deE]+\s+-?\d+(?=\s|\Z))++\s*")  # x, y and the point's number, repeated
MOST_NAME = 4096  # longest name of an image, bytes

CameraLine = tuple[int, str, int, int, tuple[float, ...]]  # id, model, width, height, parameters
# name, camera id, cam_from_world as quaternion w x y z and translation
ImageLine = tuple[str, int, tuple[float, ...]]
Line = TypeVar("Line", CameraLine, ImageLine)


def read_colmap(path: str, refuse: Refusal) -> list[SourceImage]:
    """Read the registered images of the model in the dataset's folder `path`, sorted by name."""
    refuse.check_subfolder(KEY, path)
    pairs = [
        (refuse.file_in(KEY, path, f"cameras{suffix}"), refuse.file_in(KEY, path, f"images{suffix}"))
        for suffix in (".bin", ".txt")
    ]
    camera_file, image_file = next((pair for pair in pairs if None not in pair), (None, None))
    if camera_file is None or image_file is None:
        refuse(KEY, f"{path!r} is not readable as a COLMAP model (it has no cameras and images, .bin or .txt)", CURE)
    is_text = camera_file.suffix == ".txt"
    with reading("a COLMAP model", camera_file, KEY, CURE):
        lines = _text_cameras(camera_file) if is_text else _records(camera_file, _binary_camera)
        cameras = {line[0]: line for line in lines}
        for _, model, _, _, params in cameras.values():
            if len(params) != _parameter_count(model):
                raise ValueError(f"a {model} camera has {_parameter_count(model)} parameters, not {len(params)}")
    with reading("a COLMAP model", image_file, KEY, CURE):
        image_lines = _text_images(image_file) if is_text else _records(image_file, _binary_image)
        registered = sorted(image_lines, key=lambda line: line[0])
        for name, camera_id, _ in registered:
            if camera_id not in cameras:
                raise ValueError(f"image {name!r} has camera {camera_id}, which {camera_file.name} lacks")
    colmap_cameras = {
        number: colmap_camera(f"{KEY}: camera {number}", model, width, height, params, refuse)
        for number, model, width, height, params in cameras.values()
    }
    images = []
    for name, camera_id, (*quaternion, x, y, z) in registered:
        key = f"{KEY}: {one_line(name)}"
        camera = colmap_cameras[camera_id]
        length = math.hypot(*quaternion)
        refuse.refuse_if(
            not (0 < length <= LARGEST and max(abs(x), abs(y), abs(z)) <= LARGEST and not math.isnan(x + y + z)),
            key,
            "is not a pose: its numbers are zero, not finite or too large",
            DAMAGED,
        )
        turn = pycolmap.Rotation3d([value / length for value in (*quaternion[1:], quaternion[0])])
        motion = pycolmap.Rigid3d(turn, [x, y, z])
        images.append(SourceImage(name, camera, (camera.width, camera.height), key, cam_from_world=motion))
    return images


def _parameter_count(model: str) -> int:
    """Return the number of parameters of a camera model."""
    if model not in MODELS.values():
        raise ValueError(f"{one_line(model)!r} is not a camera model")
    return len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)


def _records(file: Path, record: Callable[[mmap.mmap, int], tuple[Line, int]]) -> Iterator[Line]:
    """Yield the records of a binary file.

    `record` decodes one at an offset, and returns it with the offset of its end.
    """
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        (count,) = struct.unpack_from("<Q", content)
        offset = 8
        for _ in range(count):
            entry, offset = record(content, offset)
            yield entry


def _binary_camera(content: mmap.mmap, offset: int) -> tuple[CameraLine, int]:
    number, model, width, height = struct.unpack_from("<IiQQ", content, offset)
    if model not in MODELS:
        raise ValueError(f"{model} is not the number of a camera model")
    count = _parameter_count(MODELS[model])
    params = struct.unpack_from(f"<{count}d", content, offset + 24)
    return (number, MODELS[model], width, height, params), offset + 24 + 8 * count


def _binary_image(content: mmap.mmap, offset: int) -> tuple[ImageLine, int]:
    """Decode a pose and a zero-terminated name, and skip the points."""
    _, *pose, camera_id = struct.unpack_from("<I7dI", content, offset)
    end = content.find(b"\0", offset + 64, offset + 64 + MOST_NAME)
    if end < 0:
        raise ValueError("the name of an image does not end with a zero byte")
    (points,) = struct.unpack_from("<Q", content, end + 1)
    next_offset = end + 9 + points * struct.calcsize("<2dQ")
    if next_offset > len(content):
        raise ValueError("it ends in the middle of an image")
    return (content[offset + 64 : end].decode("utf-8"), camera_id, tuple(pose)), next_offset


def _text_cameras(file: Path) -> Iterator[CameraLine]:
    with file.open(encoding="utf-8") as lines:
        for line in filter(_has_content, lines):
            number, model, width, height, *params = line.split()
            yield int(number), model, int(width), int(height), tuple(map(float, params))


def _text_images(file: Path) -> Iterator[ImageLine]:
    """Yield images; the line of points after each may be empty, or missing, as programs without points write it."""
    has_points = False
    with file.open(encoding="utf-8") as lines:
        for number, line in enumerate(lines, 1):
            if not _has_content(line) or (has_points and POINTS.fullmatch(line)):
                has_points = has_points and line.lstrip().startswith("#")
                continue
            words = line.strip().split(maxsplit=9)
            if len(words) != 10:
                raise ValueError(f"line {number}: {one_line(line)!r} has {len(words)} words; that of an image has 10")
            has_points = True
            yield words[9], int(words[8]), tuple(map(float, words[1:8]))


def _has_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")
