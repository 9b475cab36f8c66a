"""OFF files (text): vertices and polygons, all of one part; normals, colours and what else stands on a line are left alone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.soup import Soup, fans, of_one_part
from factorlib.meshes.text import lines_of, shown

KEYWORD = re.compile(r"(ST)?C?N?OFF\b(?!\s*BINARY)|(?=[0-9])|OFF(?=[0-9])")  # it may be left out, and some leave out the space
CURE = "is it whole? export it again"


def read_off(path: Path, content: bytes, limits: Limits) -> Soup:
    """Read an OFF file; polygons become fans of triangles.  InputError for a malformed or too large one."""
    lines = [line for line in (line.split("#", 1)[0].strip() for line in lines_of(content)) if line]
    keyword = KEYWORD.match(lines[0]) if lines else None
    if keyword is None:
        raise InputError("does not begin with OFF", file=path, cure="save it as text OFF of three dimensions")
    lines[0] = lines[0][keyword.end() :]
    lines = lines if lines[0].strip() else lines[1:]
    vertices, faces = _counts(lines, path)
    limits.check(vertices, faces, path)
    if vertices + faces > len(lines) - 1:
        raise InputError(f"says {vertices} vertices and {faces} faces, and has {len(lines) - 1} lines of them", file=path, cure=CURE)
    points = np.array([_numbers(line, 3, float, path) for line in lines[1 : vertices + 1]]).reshape(-1, 3)
    polygons = [_polygon(line, path) for line in lines[vertices + 1 : vertices + faces + 1]]
    counts = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    limits.check(vertices, int(counts.sum()) - 2 * len(counts), path)
    return of_one_part(points, fans(counts, np.array([c for polygon in polygons for c in polygon], dtype=np.int64)), path.stem)


def _counts(lines: list[str], path: Path) -> tuple[int, int]:
    vertices, faces = _numbers(lines[0], 2, int, path) if lines else (0, 0)
    if min(vertices, faces) < 0:
        raise InputError(f"says {vertices} vertices and {faces} faces", file=path, cure=CURE)
    return vertices, faces


def _polygon(line: str, path: Path) -> list[int]:
    """The corners of a face: their number, themselves, and perhaps a colour."""
    words = line.split()
    (count,) = _numbers(line, 1, int, path)
    if not 0 <= count < len(words):
        raise InputError(f"{shown(line)} is no face: its first number counts its corners", file=path, cure=CURE)
    return _numbers(line, 1 + count, int, path)[1:]


def _numbers(line: str, count: int, kind: type, path: Path) -> list:
    words = line.split()[:count]
    try:
        if len(words) < count:
            raise ValueError("too few")
        return [kind(word) for word in words]
    except ValueError as error:
        raise InputError(f"{shown(line)} does not begin with {count} numbers", file=path, cure=CURE) from error
