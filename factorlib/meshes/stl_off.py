"""Readers of STL files, binary and text, and of OFF files, text, by trimesh: triangles of one part.

trimesh reads a truncated text file as a smaller mesh, so the numbers of corners and faces are compared with the file's.
It is imported on first use, which takes a third of a second.
"""

import io
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.triangle_soup import TriangleSoup, floats, single_part_soup, text_lines

VERTEX = re.compile(rb"^[ \t]*vertex\b", re.MULTILINE | re.IGNORECASE)
COUNTS = re.compile(r"(?:(?:ST)?C?N?OFF)?\s*([0-9]+)\s+([0-9]+)[^\n]*")  # OFF itself is optional
CURE = "copy or export the file again"


def read_stl(path: Path, content: bytes, limits: Limits) -> TriangleSoup:
    """Read an STL file: binary if its size matches its count of triangles, else text.

    Raises:
        InputError: If the file is malformed or too large.
    """
    from trimesh.exchange.stl import load_stl

    binary_size = 84 + 50 * int.from_bytes(content[80:84], "little")
    is_binary = len(content) == binary_size
    mesh = _loaded(load_stl, content if is_binary else content.decode("ascii", "replace").encode())
    solids = list(mesh["geometry"].values()) if "geometry" in mesh else [mesh]
    corners = np.concatenate([np.empty((0, 3)), *(floats(solid["vertices"]) for solid in solids)])
    limits.check(len(corners), len(corners) // 3, path)
    expected = len(VERTEX.findall(content))
    if not is_binary and not 0 < len(corners) == expected:
        raise InputError(
            (
                f"is neither a whole text STL ({len(corners)} of {expected} corners can be read) "
                f"nor a whole binary STL ({len(content)} of {binary_size} bytes)"
            ),
            file=path,
            cure=CURE,
        )
    return single_part_soup(corners, np.arange(len(corners)), path.stem)


def read_off(path: Path, content: bytes, limits: Limits) -> TriangleSoup:
    """Read an OFF file; polygons become fans of triangles.

    Raises:
        InputError: If the file is malformed or too large.
    """
    from trimesh.exchange.off import load_off

    lines = [line for line in (line.split("#", 1)[0].strip() for line in text_lines(content)) if line]
    counts = COUNTS.match("\n".join(lines[:2]))
    if counts is None:
        raise InputError(
            "does not begin with OFF and the numbers of its vertices and faces",
            file=path,
            cure="save it as OFF: text, of three dimensions",
        )
    vertices = int(counts[1])
    faces = int(counts[2])
    rows = lines[counts[0].count("\n") + 1 :]
    polygons = rows[vertices : vertices + faces]
    triangles = sum(int(polygon.split()[0]) - 2 for polygon in polygons)
    limits.check(vertices, triangles, path)
    mesh = _loaded(load_off, "\n".join([f"OFF\n{vertices} {faces} 0", *rows]).encode())
    if len(polygons) != faces or len(mesh["faces"]) != triangles:
        raise InputError(
            f"announces {vertices} vertices and {faces} faces, but has fewer or incomplete ones", file=path, cure=CURE
        )
    return single_part_soup(mesh["vertices"], mesh["faces"], path.stem)


def _loaded(load: Callable[[io.BytesIO], dict], content: bytes) -> dict:
    """Call a reader of trimesh; ValueError for text that is no number, of which NumPy only warns."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return load(io.BytesIO(content))
        except DeprecationWarning:
            raise ValueError("something in it is no number") from None
