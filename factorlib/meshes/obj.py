"""A small reader of Wavefront OBJ that keeps what general readers drop: `g` and `o` names, and `usemtl` without a .mtl.

Reads v, vn, f (polygons as fans, negative indices, `v/vt/vn` in all its forms), g, o, usemtl, and continued lines.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.soup import Soup, check


def read_obj(path: str | Path) -> Soup:
    """Triangles of an OBJ file, parts named by (usemtl, groups…, object); InputError names the line that is wrong."""
    reader = _Reader()
    text = Path(path).read_text(encoding="utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split() if "#" in line else line.split()
        if not words:
            continue
        try:
            reader.take(words[0], words[1:])
        except (ValueError, IndexError) as error:
            raise InputError(f"line {number}: {line.strip()!r} cannot be read ({error})", file=path, cure="is it a text OBJ?") from error
    return check(reader.soup(), path)


class _Reader:
    """The state of an OBJ file while it is read line by line."""

    def __init__(self):
        self.vertices: list[list[float]] = []
        self.vertex_normals: list[list[float]] = []
        self.faces: list[tuple[int, int, int]] = []
        self.face_normals: list[tuple[int, int, int]] = []  # indices into vertex_normals, −1 for none
        self.part: list[int] = []
        self.parts: dict[tuple[str, ...], int] = {}
        self.material, self.groups, self.object = "", (), ""

    def take(self, key: str, words: list[str]) -> None:
        if key == "v":
            self.vertices.append([float(w) for w in words[:3]])
            if len(self.vertices[-1]) != 3:
                raise ValueError("three coordinates expected")
        elif key == "vn":
            self.vertex_normals.append([float(w) for w in words[:3]])
        elif key == "f":
            self.face(words)
        elif key == "usemtl":
            self.material = " ".join(words)
        elif key == "g":
            self.groups = tuple(words)
        elif key == "o":
            self.object = " ".join(words)

    def face(self, words: list[str]) -> None:
        corners = [self.corner(word) for word in words]
        if len(corners) < 3:
            raise ValueError("a face has three corners at least")
        names = tuple(dict.fromkeys(name for name in (self.material, *self.groups, self.object) if name))
        part = self.parts.setdefault(names, len(self.parts))
        for second, third in zip(corners[1:], corners[2:]):
            triangle = (corners[0], second, third)
            self.faces.append(tuple(v for v, _ in triangle))
            self.face_normals.append(tuple(n for _, n in triangle))
            self.part.append(part)

    def corner(self, word: str) -> tuple[int, int]:
        fields = word.split("/")
        vertex = _index(fields[0], len(self.vertices))
        return vertex, _index(fields[2], len(self.vertex_normals)) if len(fields) > 2 and fields[2] else -1

    def soup(self) -> Soup:
        normal_table = np.array([*self.vertex_normals, [np.nan] * 3], dtype=float).reshape(-1, 3)
        faces = np.array(self.faces, dtype=np.int64).reshape(-1, 3)
        index = np.array(self.face_normals, dtype=np.int64).reshape(-1, 3)
        index[(index < 0) | (index >= len(normal_table))] = len(normal_table) - 1
        vertices = np.array(self.vertices, dtype=float).reshape(-1, 3)
        return Soup(vertices, faces, np.array(self.part, dtype=np.int64), list(self.parts), normal_table[index])


def _index(word: str, count: int) -> int:
    """OBJ counts from 1, and backwards from −1; 0 does not exist."""
    index = int(word)
    if index == 0:
        raise ValueError("index 0: OBJ counts from 1")
    return index - 1 if index > 0 else count + index
