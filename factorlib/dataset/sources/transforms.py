"""A NeRF-style transforms.json, as nerfstudio and instant-ngp write it and as NeRF's own scenes have it.

Its cameras are OpenGL's (x right, y up, z backward) and its matrices lead from camera to world.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import pycolmap

from factorlib.dataset.numbers import SIDE_PX, check_centre, check_focal, check_numbers, check_rotation
from factorlib.dataset.paths import Refusal
from factorlib.dataset.schema import Vec3
from factorlib.dataset.sources.shot import Shot, colmap_camera, rigid
from factorlib.reading import one_line, read_text, reading
from factorlib.yamlfile import convert

FISHEYE, PERSPECTIVE = "OPENCV_FISHEYE", ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
ANY_WIDTH = 1000.0
MOST_BYTES = 256_000_000  # a scene of BOP has some 10 MB
Row4 = tuple[float, float, float, float]


class Lens(msgspec.Struct, frozen=True):
    """Of all frames, or of one; pixels, centres at 0.5."""

    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_angle_x: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: float | None = None
    h: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None


class Frame(Lens, frozen=True, kw_only=True):
    """transform_matrix: world_from_camera, OpenGL, 3 or 4 rows."""

    file_path: str
    transform_matrix: list[Row4]


class TransformsFile(Lens, frozen=True, kw_only=True):
    """A whole transforms.json: what its frames share, and the frames."""

    frames: list[Frame]


def transforms_shots(path: str, refuse: Refusal) -> list[Shot]:
    """The frames of the dataset's file `path`, in its order."""
    content = read_source(refuse.folder / path, TransformsFile)
    said = Refusal(refuse.folder / path, refuse.folder)
    return [
        _shot(f"frames[{index}]", frame, lens_of(frame, content), said) for index, frame in enumerate(content.frames)
    ]


def read_source(file: Path, type_: type, key: str | None = None) -> Any:
    """A json as a value of `type_`.  Raises InputError that names file and key."""
    text = read_text(file, "a JSON file", key, MOST_BYTES)
    with reading("JSON", file, key):
        value = convert(json.loads(text), type_, file)
    check_numbers(value, Refusal(file, file.parent))
    return value


def lens_of(frame: Frame, content: TransformsFile) -> Lens:
    """What the frame itself says, and the file's own for the rest."""
    own = {name: getattr(frame, name) for name in Lens.__struct_fields__}
    return Lens(**{name: getattr(content, name) if value is None else value for name, value in own.items()})


def _shot(key: str, frame: Frame, lens: Lens, refuse: Refusal) -> Shot:
    camera, size = _camera(key, lens, refuse)
    return Shot(
        image=frame.file_path,
        camera=camera,
        size=size,
        centred=lens.cx is None or lens.cy is None,
        cam_from_world=_cam_from_world(f"{key}.transform_matrix", frame.transform_matrix, refuse),
        key=f"{Path(refuse.file).name}: {key}",
    )


def _cam_from_world(key: str, rows: list[Row4], refuse: Refusal) -> pycolmap.Rigid3d:
    if len(rows) not in (3, 4) or (len(rows) == 4 and tuple(rows[3]) != (0, 0, 0, 1)):
        refuse(key, "is not a rigid matrix", "give the rows [R | t], and [0, 0, 0, 1] below them or nothing")
    check_rotation(key, tuple(row[:3] for row in rows[:3]), refuse)
    opencv = tuple((x, -y, -z) for x, y, z, _ in rows[:3])  # the camera's y and z axes, turned over
    centre: Vec3 = tuple(row[3] for row in rows[:3])
    return rigid(opencv, centre).inverse()


def _camera(key: str, lens: Lens, refuse: Refusal) -> tuple[pycolmap.Camera, tuple[float, float | None] | None]:
    """With the size of its image; without `w`, a field of view is a focal length of an image of any width, here ANY_WIDTH."""
    _check_lens(key, lens, refuse)
    if lens.fl_x is None and lens.w is None:
        camera = colmap_camera(
            key, "SIMPLE_PINHOLE", ANY_WIDTH, 1, [_focal(lens, ANY_WIDTH), ANY_WIDTH / 2, 0.5], refuse
        )
        return camera, (ANY_WIDTH, None)
    focal = lens.fl_x if lens.fl_x is not None else _focal(lens, lens.w)
    check_focal(f"{key}.{'fl_x' if lens.fl_x is not None else 'camera_angle_x'}", focal, refuse)
    if lens.w is None or lens.h is None:
        size, (width, height) = None, (2 * max(lens.cx or focal, 1.0), 2 * max(lens.cy or focal, 1.0))
    else:
        size = (width, height) = lens.w, lens.h
    fy = lens.fl_y if lens.fl_y is not None else focal
    cx, cy = lens.cx if lens.cx is not None else width / 2, lens.cy if lens.cy is not None else height / 2
    model, params = _model(key, lens, [focal, fy, cx, cy], refuse)
    return colmap_camera(key, model, min(width, SIDE_PX), min(height, SIDE_PX), params, refuse), size


def _check_lens(key: str, lens: Lens, refuse: Refusal) -> None:
    """Something to take the focal length from, and nothing that no camera has."""
    if lens.fl_x is None and lens.camera_angle_x is None:
        fault = "neither fl_x nor camera_angle_x is given"
        refuse(f"{key}.fl_x", fault, "give the focal length fl_x in pixels, with w and h")
    if lens.fl_x is None and not 0 < lens.camera_angle_x < math.pi:
        found = f"an angle of {lens.camera_angle_x:g} is no field of view"
        refuse(f"{key}.camera_angle_x", found, "give it in radians, more than 0 and less than π")
    for name in ("w", "h"):
        if (side := getattr(lens, name)) is not None and not 1 <= side <= SIDE_PX:
            refuse(f"{key}.{name}", f"an image of {side:g} pixels", f"give 1 to {SIDE_PX:g}")
    if lens.fl_y is not None:
        check_focal(f"{key}.fl_y", lens.fl_y, refuse)
    check_centre(f"{key}.cx", (lens.cx or 0.0, lens.cy or 0.0), refuse)


def _focal(lens: Lens, width: float) -> float:
    """Pixels, of the field of view across an image of `width`."""
    return 0.5 * width / math.tan(lens.camera_angle_x / 2)


def _model(key: str, lens: Lens, pinhole: list[float], refuse: Refusal) -> tuple[str, list[float]]:
    """COLMAP's model and its parameters."""
    k1, k2, k3, k4, p1, p2 = (value or 0.0 for value in (lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2))
    if not any((k1, k2, k3, k4, p1, p2)) and not lens.is_fisheye and lens.camera_model in (None, *PERSPECTIVE):
        return "PINHOLE", pinhole
    if lens.is_fisheye or lens.camera_model == FISHEYE:
        return FISHEYE, [*pinhole, k1, k2, k3, k4]
    if lens.camera_model in (None, *PERSPECTIVE) and k4 == 0:
        return "FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, 0, 0, 0]
    refuse(
        f"{key}.camera_model", f"the camera model {one_line(repr(lens.camera_model))} with k4 = {k4} is not read here",
        f"undistort the photos, or give {', '.join((*PERSPECTIVE, FISHEYE))}",
    )  # fmt: skip
