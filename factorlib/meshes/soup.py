"""What a mesh file says, before it is made fit for use: triangles, their corners' normals, the names of their parts."""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.errors import InputError


class Soup(msgspec.Struct, frozen=True):
    """Triangles as read from a file.

    vertices  [V, 3] float64
    faces     [F, 3] int64
    part      [F] int: index into `parts`
    parts     one tuple of names per part: whatever the file calls it (OBJ: groups, object, usemtl; glTF: primitive,
              node, material); a dataset may use any of them
    normals   [F, 3, 3] float64 per corner, NaN where the file has none
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    part: Int[np.ndarray, " f"]
    parts: list[tuple[str, ...]]
    normals: Float[np.ndarray, "f 3 3"]


def no_normals(faces: int) -> Float[np.ndarray, "f 3 3"]:
    return np.full((faces, 3, 3), np.nan)


def check(soup: Soup, file) -> Soup:
    """The soup itself; raises InputError for no faces, indices out of range, and vertices that are not finite."""
    if len(soup.faces) == 0:
        raise InputError("mesh without faces", file=file, cure="export triangles, not only points or lines")
    low, high = int(soup.faces.min()), int(soup.faces.max())
    if low < 0 or high >= len(soup.vertices):
        index = low if low < 0 else high
        raise InputError(f"a face uses vertex {index + 1} of {len(soup.vertices)}", file=file, cure="is the file whole?")
    bad = ~np.isfinite(soup.vertices).all(axis=1)
    if bad.any():
        found = f"{int(bad.sum())} vertices are not finite, first is number {int(np.argmax(bad)) + 1}"
        raise InputError(found, file=file, cure="remove them in a mesh editor, or export the mesh again")
    return soup
