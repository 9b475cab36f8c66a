"""A small reader of Wavefront OBJ that keeps what general readers drop: `g` and `o` names, and `usemtl` without a .mtl.

Reads v, vn, f (polygons as fans, negative indices, `v/vt/vn` in all its forms), g, o, usemtl, and continued lines.
The .mtl is never opened: a part's name is in the OBJ itself.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.soup import Soup
from factorlib.meshes.text import check_length, lines_of, shown

MOST = 2**31  # vertices that any file numbers
COUNTED_EVERY = 4096  # lines between two looks at how many triangles there are


def read_obj(path: Path, content: bytes, limits: Limits) -> Soup:
    """Triangles of an OBJ file, parts named by (usemtl, groups…, object); InputError names the line that is wrong."""
    reader = _Reader()
    for number, line in _statements(content):
        words = line.split("#", 1)[0].split() if "#" in line else line.split()
        if not words:
            continue
        try:
            reader.take(words[0], words[1:])
        except (ValueError, IndexError, OverflowError) as error:
            found = f"line {number}: {shown(line)} cannot be read ({shown(str(error))[1:-1]})"
            raise InputError(found, file=path, cure="is it a text OBJ?") from error
        if number % COUNTED_EVERY == 0:
            reader.check(limits, path)
    reader.check(limits, path)
    return reader.soup()


def _statements(content: bytes) -> Iterator[tuple[int, str]]:
    """Lines by the number they end at; a line that ends in a backslash goes on in the next."""
    begun: list[str] = []
    number = letters = 0
    for number, line in enumerate(lines_of(content), start=1):
        if line.endswith("\\"):
            begun.append(line[:-1])
            letters += len(line)
            check_length(letters)
            continue
        yield number, " ".join([*begun, line]) if begun else line
        begun.clear()
        letters = 0
    if begun:
        yield number, " ".join(begun)


class _Reader:
    """The state of an OBJ file while it is read line by line; numbers of vertices, faces and normals in flat arrays."""

    def __init__(self) -> None:
        self.vertices, self.vertex_normals = array("d"), array("d")
        self.faces, self.face_normals = array("q"), array("q")  # indices from 0; of vertex_normals, −1 for none
        self.part = array("q")
        self.parts: dict[tuple[str, ...], int] = {}
        self.material, self.groups, self.object = "", (), ""
        self.current: int | None = None  # the part that faces belong to now; None until one asks

    def take(self, key: str, words: list[str]) -> None:
        """Take in one line: its first word `key` and the words after it.  ValueError where they are malformed."""
        if key == "v":
            self.vertices.extend(_three(words, "coordinates"))
        elif key == "vn":
            self.vertex_normals.extend(_three(words, "numbers"))
        elif key == "f":
            self.face(words)
        elif key in ("usemtl", "g", "o"):
            self.name(key, words)

    def name(self, key: str, words: list[str]) -> None:
        """Faces that follow are of another material, group or object."""
        self.current = None
        if key == "usemtl":
            self.material = " ".join(words)
        elif key == "g":
            self.groups = tuple(words)
        else:
            self.object = " ".join(words)

    def face(self, words: list[str]) -> None:
        """Add a polygon as a fan of triangles; a corner of it is `v`, `v/vt`, `v//vn` or `v/vt/vn`."""
        corners = [self.corner(word) for word in words]
        if len(corners) < 3:
            raise ValueError("a face has three corners at least")
        if self.current is None:
            names = tuple(dict.fromkeys(name for name in (self.material, *self.groups, self.object) if name))
            self.current = self.parts.setdefault(names, len(self.parts))
        for second, third in zip(corners[1:], corners[2:]):
            self.faces.extend((corners[0][0], second[0], third[0]))
            self.face_normals.extend((corners[0][1], second[1], third[1]))
            self.part.append(self.current)

    def corner(self, word: str) -> tuple[int, int]:
        """Index of a corner's vertex and of its normal, from 0; −1 where it has no normal."""
        fields = word.split("/")
        vertex = _index(fields[0], len(self.vertices) // 3)
        return vertex, _index(fields[2], len(self.vertex_normals) // 3) if len(fields) > 2 and fields[2] else -1

    def check(self, limits: Limits, path: Path) -> None:
        """Raise InputError where more has been read than the limits allow."""
        limits.check(len(self.vertices) // 3, len(self.part), path)

    def soup(self) -> Soup:
        """All that was read, as arrays; corners without a normal have NaN."""
        normal_table = np.concatenate([np.array(self.vertex_normals), np.full(3, np.nan)]).reshape(-1, 3)
        index = np.array(self.face_normals, dtype=np.int64).reshape(-1, 3)
        index[(index < 0) | (index >= len(normal_table))] = len(normal_table) - 1
        vertices = np.array(self.vertices, dtype=float).reshape(-1, 3)
        faces = np.array(self.faces, dtype=np.int64).reshape(-1, 3)
        return Soup(vertices, faces, np.array(self.part, dtype=np.int64), list(self.parts), normal_table[index])


def _three(words: list[str], what: str) -> list[float]:
    if len(words) < 3:
        raise ValueError(f"three {what} expected")
    return [float(word) for word in words[:3]]


def _index(word: str, count: int) -> int:
    """OBJ counts from 1, and backwards from −1; 0 does not exist."""
    index = int(word)
    if index == 0:
        raise ValueError("index 0: OBJ counts from 1")
    if abs(index) > MOST:
        raise ValueError("an index beyond any vertex")
    return index - 1 if index > 0 else count + index
