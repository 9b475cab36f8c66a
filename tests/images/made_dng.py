"""A small DNG: a preview first, as cameras write it, and the sensor's pixels in a sub-picture."""

import struct
from pathlib import Path

import numpy as np
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from PIL.TiffTags import ASCII, BYTE, LONG, RATIONAL, SHORT, SIGNED_RATIONAL

XYZ_TO_SRGB = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)  # fmt: skip  # a sensor that sees Rec. 709
WHITE, BLACK = 4000, 64


def write_dng(path: Path, sensor: np.ndarray, *, neutral=(1.0, 1.0, 1.0), exif=None) -> Path:
    """sensor: [h, w] codes under red, green / green, blue; neutral: as the camera's white balance sees grey;
    exif: tag -> (type, values).  The preview is bright magenta.  Pixels stand behind their directory."""
    height, width = sensor.shape
    raw = {
        254: (LONG, 0), 256: (LONG, width), 257: (LONG, height), 258: (SHORT, 16), 259: (SHORT, 1), 262: (SHORT, 32803),
        273: (LONG, 0), 277: (SHORT, 1), 278: (LONG, height), 279: (LONG, 2 * sensor.size), 284: (SHORT, 1),
        33421: (SHORT, [2, 2]), 33422: (BYTE, bytes([0, 1, 1, 2])), 50714: (SHORT, BLACK), 50717: (LONG, WHITE),
    }  # fmt: skip
    first = {
        254: (LONG, 1), 256: (LONG, 12), 257: (LONG, 8), 258: (SHORT, [8, 8, 8]), 259: (SHORT, 1), 262: (SHORT, 2),
        271: (ASCII, "Made"), 272: (ASCII, "By hand"), 273: (LONG, 0), 274: (SHORT, 1), 277: (SHORT, 3), 278: (LONG, 8),
        279: (LONG, 3 * 8 * 12), 284: (SHORT, 1), 50706: (BYTE, bytes([1, 4, 0, 0])), 50708: (ASCII, "Made by hand"),
        50721: (SIGNED_RATIONAL, XYZ_TO_SRGB), 50728: (RATIONAL, neutral), 50778: (SHORT, 21),
    }  # fmt: skip
    content = b""
    for tag, entries, pixels in ((330, raw, sensor.astype("<u2").tobytes()), (34665, exif, b"")):
        if entries:
            first[tag] = LONG, 8 + len(content)
            content += _directory(entries, 8 + len(content)) + pixels
    head = struct.pack("<2sHI", b"II", 42, 8 + len(content))
    path.write_bytes(head + content + _directory(first, 8 + len(content)) + bytes([255, 0, 255]) * 8 * 12)
    return path


def _directory(entries: dict, at: int) -> bytes:
    """A TIFF directory at the file's byte `at`; Pillow counts the place of its pixels from its end."""
    directory = ImageFileDirectory_v2()
    for tag, (kind, value) in entries.items():
        directory.tagtype[tag] = kind
        directory[tag] = value
    return directory.tobytes(at)
