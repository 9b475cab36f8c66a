"""Small reader of Wavefront OBJ that keeps names which general readers drop: `g`, `o`, and `usemtl` without a .mtl.

It reads v, vn, f (polygons, negative indices, `v/vt/vn` in all its forms), g, o, usemtl, and continued lines.
It never opens the .mtl: a part's name is in the OBJ itself. Free-form surfaces and included files are refused.
"""

import re
from array import array
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.triangle_soup import Limits, TriangleSoup, normals_at_corners, quoted, text_lines, triangulate

MOST = 2**31  # greatest index in any file
COUNTED_EVERY = 4096  # number of lines between two checks of the number of triangles
NAMED = re.compile(r"\s*(usemtl|g|o)\s")
CONTINUED = re.compile(rb"(#[^\r\n]*)|\\(\r\n|\r|\n|\Z)")  # line that continues in the next; no comment does


class _Tables:
    """Contents of an OBJ file that have been read so far."""

    def __init__(self) -> None:
        self.coordinates = {"v": array("d"), "vn": array("d")}
        self.corners = array("q")  # vertices of all faces, and their normals; indices from 0, −1 for no normal
        self.corner_normals = array("q")
        self.sizes = array("q")  # numbers of corners of the faces
        self.part = array("q")
        self.parts: dict[tuple[str, ...], int] = {}
        self.names: dict[str, tuple[str, ...]] = {"usemtl": (), "g": (), "o": ()}  # names of the faces that follow

    def read_line(self, key: str, words: list[str]) -> None:
        """Add a line; ValueError for one that is not OBJ."""
        if key in self.coordinates:
            if len(words) < 3:
                raise ValueError("three numbers are expected")
            self.coordinates[key].extend([float(word) for word in words[:3]])
        elif key in self.names:
            self.names[key] = tuple(words) if key == "g" else (" ".join(words),)
        elif key in ("surf", "bzp", "bsp", "call"):  # free-form surface, Bézier and B-spline patches, other file
            raise ValueError(
                "free-form surfaces and included files are not read: convert them to polygons of this file"
            )
        if key not in ("f", "fo"):
            return
        vertices = len(self.coordinates["v"]) // 3
        normals = len(self.coordinates["vn"]) // 3
        corners = [
            (_index(vertex, vertices), _index(normal, normals) if normal else -1)
            for vertex, _, normal in ((word.split("/") + ["", ""])[:3] for word in words)
        ]
        if len(corners) < 3:
            raise ValueError("a face needs at least three corners")
        names = tuple(dict.fromkeys(name for kind in self.names.values() for name in kind if name))
        self.part.append(self.parts.setdefault(names, len(self.parts)))
        self.sizes.append(len(corners))
        self.corners.extend([vertex for vertex, _ in corners])
        self.corner_normals.extend([normal for _, normal in corners])

    def check(self, limits: Limits, path: Path) -> None:
        """Check the numbers of vertices and triangles."""
        limits.check(len(self.coordinates["v"]) // 3, len(self.corners) - 2 * len(self.sizes), path)

    def soup(self, name: str) -> TriangleSoup:
        """Return the triangles of the whole file; `name` is that of a part without one."""
        normals = np.array(self.coordinates["vn"]).reshape(-1, 3)
        vertices = np.array(self.coordinates["v"], dtype=float).reshape(-1, 3)
        corners = np.array(self.corners, dtype=np.int64)
        sizes = np.array(self.sizes, dtype=np.int64)
        triangles = triangulate(vertices, sizes, corners)
        part = np.repeat(np.array(self.part, dtype=np.int64), sizes - 2)
        corner_normals = normals_at_corners(normals, np.array(self.corner_normals, dtype=np.int64)[triangles])
        return TriangleSoup(
            vertices, corners[triangles], part, [each or (name,) for each in self.parts], corner_normals
        )


def read_obj(path: Path, content: bytes, limits: Limits) -> TriangleSoup:
    """Read the triangles of an OBJ file, with parts named by (usemtl, groups…, object), else as the file.

    Args:
        path: File, to be named in errors.
        content: Content of the file.
        limits: Limits on its size.

    Raises:
        InputError: If a line cannot be read or the mesh is too large.
    """
    tables = _Tables()
    number = 0
    for count, line in enumerate(
        text_lines(CONTINUED.sub(lambda match: match[1] or b"\v", content) if b"\\" in content else content)
    ):
        number += 1 + line.count("\v")
        comment = r"\s#(?!\S)" if NAMED.match(line) else "#"  # `usemtl Material #1` is a name
        key, *words = re.split(comment, line, maxsplit=1)[0].split() or [""]
        try:
            tables.read_line(key, words)
        except (ValueError, IndexError, OverflowError) as error:
            raise InputError(
                f"line {number}: {quoted(line)} cannot be read ({quoted(str(error))[1:-1]})",
                file=path,
                cure="correct the line, or export the mesh again, as OBJ",
            ) from error
        if count % COUNTED_EVERY == 0:
            tables.check(limits, path)
    tables.check(limits, path)
    return tables.soup(path.stem)


def _index(word: str, count: int) -> int:
    """Convert an OBJ index to one from 0; OBJ counts from 1, and backwards from −1."""
    index = int(word)
    if index == 0:
        raise ValueError("index 0: OBJ counts from 1")
    if abs(index) > MOST:
        raise ValueError(f"index {index} is larger than {MOST:,}")
    return index - 1 if index > 0 else count + index
