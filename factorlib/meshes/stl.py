"""Readers of STL files, binary and text, and of OFF files, text: triangles of one part.

Normals, colours and other contents are ignored. trimesh would read these files too, but takes a truncated file for a
smaller mesh.
"""

import re
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.soup import Soup, fans, lines_of, numbers_in, of_one_part, quoted

HEADER = 84  # size in bytes: 80 for any text, 4 for the number of triangles
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
VERTEX = re.compile(rb"^[ \t]*vertex\b([^\r\n]*)", re.MULTILINE | re.IGNORECASE)
SOLID = re.compile(rb"\s*solid\b", re.IGNORECASE)
# first line of an OFF file: the word is optional, and so is the space after it
OFF = re.compile(r"(ST)?C?N?OFF\b(?!\s*BINARY)|(?=[0-9])|OFF(?=[0-9])")
CURE = "is it whole? export it again"


def read_stl(path: Path, content: bytes, limits: Limits) -> Soup:
    """Read an STL file: binary if its size matches its count of triangles, else text.

    Some binary headers begin with `solid` too.

    Args:
        path: File, to be named in errors.
        content: Content of the file.
        limits: Limits on its size.

    Returns:
        The triangles, in one part.

    Raises:
        InputError: If the file is malformed or too large.
    """
    count = int.from_bytes(content[80:HEADER], "little") if len(content) >= HEADER else -1
    size = HEADER + count * FACET.itemsize
    if len(content) == size:
        limits.check(3 * count, count, path)
        corners = np.frombuffer(content, FACET, count, HEADER)["corners"].reshape(-1, 3)
    elif SOLID.match(content):
        lines = VERTEX.findall(content)
        limits.check(len(lines), len(lines) // 3, path)
        if len(lines) % 3:
            raise InputError(f"has {len(lines)} corners, which makes no triangles", file=path, cure=CURE)
        for number, line in enumerate(lines, start=1):
            if len(line.split(None, 3)) != 3:
                raise InputError(f"vertex {number} has not three coordinates", file=path, cure=CURE)
        corners = numbers_in(b"\n".join(lines)).reshape(-1, 3)
    else:
        as_binary = f"; as binary STL of {count} triangles it would have {size}" if count >= 0 else ""
        raise InputError(f"has {len(content)} bytes{as_binary}", file=path, cure=CURE)
    return of_one_part(corners, np.arange(len(corners)), path.stem)


def read_off(path: Path, content: bytes, limits: Limits) -> Soup:
    """Read an OFF file; polygons become fans of triangles.

    Args:
        path: File, to be named in errors.
        content: Content of the file.
        limits: Limits on its size.

    Returns:
        The triangles, in one part.

    Raises:
        InputError: If the file is malformed or too large.
    """
    lines = [line for line in (line.split("#", 1)[0].strip() for line in lines_of(content)) if line]
    keyword = OFF.match(lines[0]) if lines else None
    if keyword is None:
        raise InputError("does not begin with OFF", file=path, cure="save it as text OFF of three dimensions")
    lines[0] = lines[0][keyword.end() :]
    lines = lines if lines[0].strip() else lines[1:]
    vertices, faces = _numbers(lines[0], 2, int, path) if lines else (0, 0)
    limits.check(vertices, faces, path)
    if min(vertices, faces) < 0 or vertices + faces > len(lines) - 1:
        fault = f"says {vertices} vertices and {faces} faces, and has {len(lines) - 1} lines of them"
        raise InputError(fault, file=path, cure=CURE)
    points = np.array([_numbers(line, 3, float, path) for line in lines[1 : vertices + 1]]).reshape(-1, 3)
    polygons = []
    # a line of a face: its number of corners, the corners, and perhaps a colour
    for line in lines[vertices + 1 : vertices + faces + 1]:
        (count,) = _numbers(line, 1, int, path)
        if not 0 <= count < len(line.split()):
            raise InputError(f"{quoted(line)} is no face: its first number counts its corners", file=path, cure=CURE)
        polygons.append(_numbers(line, 1 + count, int, path)[1:])
    counts = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    limits.check(vertices, int(counts.sum()) - 2 * len(counts), path)
    corners = np.array([corner for polygon in polygons for corner in polygon], dtype=np.int64)
    return of_one_part(points, fans(counts, corners), path.stem)


def _numbers(line: str, count: int, kind: type, path: Path) -> list:
    """Parse the first `count` numbers of a line; InputError if there are fewer."""
    words = line.split()[:count]
    try:
        if len(words) < count:
            raise ValueError("too few")
        return [kind(word) for word in words]
    except ValueError as error:
        raise InputError(f"{quoted(line)} does not begin with {count} numbers", file=path, cure=CURE) from error
