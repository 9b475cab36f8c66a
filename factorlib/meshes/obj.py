"""Small reader of Wavefront OBJ that keeps names which general readers drop: `g`, `o`, and `usemtl` without a .mtl.

It reads v, vn, f (polygons as fans, negative indices, `v/vt/vn` in all its forms), g, o, usemtl, and continued lines.
It never opens the .mtl: a part's name is in the OBJ itself.
"""

import re
from array import array
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.triangle_soup import TriangleSoup, quoted, text_lines

MOST = 2**31  # greatest index in any file
COUNTED_EVERY = 4096  # number of lines between two checks of the number of triangles
CONTINUED = re.compile(rb"\\(\r\n|\r|\n|\Z)")  # line that continues in the next


def read_obj(path: Path, content: bytes, limits: Limits) -> TriangleSoup:
    """Read the triangles of an OBJ file, with parts named by (usemtl, groups…, object).

    Args:
        path: File, to be named in errors.
        content: Content of the file.
        limits: Limits on its size.

    Returns:
        The triangles.

    Raises:
        InputError: If a line cannot be read or the mesh is too large.
    """
    table = {"v": array("d"), "vn": array("d")}
    faces = array("q")  # indices from 0; −1 for no normal
    face_normals = array("q")
    part = array("q")
    parts: dict[tuple[str, ...], int] = {}
    names: dict[str, tuple[str, ...]] = {"usemtl": (), "g": (), "o": ()}  # names of the faces that follow
    current: int | None = None  # part of these faces; None until the first of them
    number = counted = 0
    for line in text_lines(CONTINUED.sub(b"\v", content) if b"\\" in content else content):
        number += 1 + line.count("\v")
        key, *words = line.split("#", 1)[0].split() or [""]
        try:
            if key in table:
                if len(words) < 3:
                    raise ValueError("three numbers expected")
                table[key].extend([float(word) for word in words[:3]])
            elif key == "f":
                corners = []
                for vertex, _, normal in ((word.split("/") + ["", ""])[:3] for word in words):
                    of_normal = _index(normal, len(table["vn"]) // 3) if normal else -1
                    corners.append((_index(vertex, len(table["v"]) // 3), of_normal))
                if len(corners) < 3:
                    raise ValueError("a face has three corners at least")
                if current is None:
                    own = tuple(dict.fromkeys(name for kind in names.values() for name in kind if name))
                    current = parts.setdefault(own, len(parts))
                for second, third in zip(corners[1:], corners[2:]):
                    faces.extend((corners[0][0], second[0], third[0]))
                    face_normals.extend((corners[0][1], second[1], third[1]))
                    part.append(current)
            elif key in names:
                names[key] = tuple(words) if key == "g" else (" ".join(words),)
                current = None
        except (ValueError, IndexError, OverflowError) as error:
            fault = f"line {number}: {quoted(line)} cannot be read ({quoted(str(error))[1:-1]})"
            raise InputError(fault, file=path, cure="is it a text OBJ?") from error
        if number - counted >= COUNTED_EVERY:
            counted = number
            limits.check(len(table["v"]) // 3, len(part), path)
    limits.check(len(table["v"]) // 3, len(part), path)
    normals = np.concatenate([np.array(table["vn"]), np.full(3, np.nan)]).reshape(-1, 3)
    index = np.array(face_normals, dtype=np.int64).reshape(-1, 3)
    index[(index < 0) | (index >= len(normals))] = len(normals) - 1
    vertices = np.array(table["v"], dtype=float).reshape(-1, 3)
    triangles = np.array(faces, dtype=np.int64).reshape(-1, 3)
    return TriangleSoup(vertices, triangles, np.array(part, dtype=np.int64), list(parts), normals[index])


def _index(word: str, count: int) -> int:
    """Convert an OBJ index to one from 0; OBJ counts from 1, and backwards from −1."""
    index = int(word)
    if index == 0:
        raise ValueError("index 0: OBJ counts from 1")
    if abs(index) > MOST:
        raise ValueError("an index beyond any vertex")
    return index - 1 if index > 0 else count + index
