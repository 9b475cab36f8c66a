"""A small DNG, byte by byte: a preview first, as cameras write it, and the sensor's pixels in a sub-picture."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import numpy as np

BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL = 1, 2, 3, 4, 5, 10
FORM = {BYTE: "B", ASCII: "B", SHORT: "H", LONG: "I", RATIONAL: "II", SRATIONAL: "ii"}
XYZ_TO_SRGB = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)  # fmt: skip  # a sensor that sees Rec. 709
WHITE, BLACK = 4000, 64


def write_dng(path: Path, sensor: np.ndarray, *, orientation=1, neutral=(1.0, 1.0, 1.0), exif=None) -> Path:
    """sensor: [h, w] codes under red, green / green, blue; neutral: as the camera's white balance sees grey;
    exif: tag -> (type, values).  The preview is bright magenta."""
    height, width = sensor.shape
    preview = np.tile(np.array([255, 0, 255], np.uint8), (8, 12, 1)).tobytes()
    raw = [
        (254, LONG, [0]), (256, LONG, [width]), (257, LONG, [height]), (258, SHORT, [16]), (259, SHORT, [1]), (262, SHORT, [32803]),
        (277, SHORT, [1]), (278, LONG, [height]), (284, SHORT, [1]), (33421, SHORT, [2, 2]), (33422, BYTE, [0, 1, 1, 2]),
        (50714, SHORT, [BLACK]), (50717, LONG, [WHITE]),
    ]  # fmt: skip
    first = [
        (254, LONG, [1]), (256, LONG, [12]), (257, LONG, [8]), (258, SHORT, [8, 8, 8]), (259, SHORT, [1]), (262, SHORT, [2]),
        (271, ASCII, b"Made\0"), (272, ASCII, b"By hand\0"), (274, SHORT, [orientation]), (277, SHORT, [3]), (278, LONG, [8]),
        (284, SHORT, [1]), (50706, BYTE, [1, 4, 0, 0]), (50708, ASCII, b"Made by hand\0"), (50721, SRATIONAL, XYZ_TO_SRGB),
        (50728, RATIONAL, neutral), (50778, SHORT, [21]),
    ]  # fmt: skip
    blob, place = b"", 8
    pictures = {}
    for name, data in (("preview", preview), ("raw", np.ascontiguousarray(sensor, "<u2").tobytes())):
        pictures[name] = (place + len(blob), len(data))
        blob += data
    raw += [(273, LONG, [pictures["raw"][0]]), (279, LONG, [pictures["raw"][1]])]
    first += [(273, LONG, [pictures["preview"][0]]), (279, LONG, [pictures["preview"][1]])]
    for tag, entries in ((330, raw), (34665, [(t, *v) for t, v in (exif or {}).items()])):
        if entries:
            at = place + len(blob)
            blob += _directory(entries, at)
            first.append((tag, LONG, [at]))
    at = place + len(blob)
    path.write_bytes(struct.pack("<2sHI", b"II", 42, at) + blob + _directory(first, at))
    return path


def _directory(entries: list, at: int) -> bytes:
    """A TIFF directory at the file's byte `at`, values that are longer than four bytes behind it."""
    entries, head, tail = sorted(entries), b"", b""
    behind = at + 2 + 12 * len(entries) + 4
    for tag, kind, values in entries:
        data = _packed(kind, values)
        if len(data) > 4:
            where, tail = struct.pack("<I", behind + len(tail)), tail + data + b"\0" * (len(data) % 2)
        else:
            where = data.ljust(4, b"\0")
        head += struct.pack("<HHI", tag, kind, len(values)) + where
    return struct.pack("<H", len(entries)) + head + struct.pack("<I", 0) + tail


def _packed(kind: int, values) -> bytes:
    if kind in (RATIONAL, SRATIONAL):
        values = [part for v in values for part in Fraction(v).limit_denominator(10**6).as_integer_ratio()]
    return struct.pack(f"<{len(values)}{FORM[kind][0]}", *values)
