"""STL files, binary and text: triangles without shared vertices, all of one part."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.soup import Soup, of_one_part
from factorlib.meshes.text import numbers_in

HEADER = 84  # bytes: 80 for any text, 4 for the number of triangles
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
VERTEX = re.compile(rb"^[ \t]*vertex\b([^\r\n]*)", re.MULTILINE | re.IGNORECASE)
SOLID = re.compile(rb"\s*solid\b", re.IGNORECASE)


def read_stl(path: Path, content: bytes, limits: Limits) -> Soup:
    """Binary where the size is the one that its count of triangles implies, else text; some binary headers say `solid` too."""
    count = int.from_bytes(content[80:HEADER], "little") if len(content) >= HEADER else -1
    if len(content) == HEADER + count * FACET.itemsize:
        limits.check(3 * count, count, path)
        corners = np.frombuffer(content, FACET, count, HEADER)["corners"].reshape(-1, 3)
    elif SOLID.match(content):
        corners = _text_corners(path, content, limits)
    else:
        found = f"has {len(content)} bytes; as binary STL of {count} triangles it would have {HEADER + count * FACET.itemsize}"
        raise InputError(found if count >= 0 else f"has {len(content)} bytes", file=path, cure="is it whole? export it again")
    return of_one_part(corners, np.arange(len(corners)), path.stem)


def _text_corners(path: Path, content: bytes, limits: Limits) -> np.ndarray:
    """Of the lines `vertex x y z`, three to a facet."""
    lines = VERTEX.findall(content)
    if len(lines) % 3:
        raise InputError(f"has {len(lines)} corners, which makes no triangles", file=path, cure="is it whole? export it again")
    limits.check(len(lines), len(lines) // 3, path)
    for number, line in enumerate(lines, start=1):
        if len(line.split(None, 3)) != 3:
            raise InputError(f"vertex {number} has not three coordinates", file=path, cure="is it whole? export it again")
    return numbers_in(b"\n".join(lines)).reshape(-1, 3)
