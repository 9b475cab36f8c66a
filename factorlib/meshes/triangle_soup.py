"""Mesh as its file has it, before it is made usable: triangles, normals of their corners, names of their parts.

Limits on its size are far above what a rough mesh needs, but within the memory of a usual machine. Text in mesh files
is UTF-8, or else Latin-1, in which old programs write names and comments.
"""

import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NoReturn

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.errors import InputError

VERTICES_A_TRIANGLE = 3
MOST_PARTS = 100_000  # greatest number of parts of one file
LARGEST = 1e15  # greatest coordinate: its cube, and its ratio to any plausible length, are finite
LEAST_EXTENT = 1e-12  # least extent
LEAST_SHARE = 1e-9  # least extent over distance from the origin: below, too few digits are left for the shape
QUOTED = 80  # number of characters of a line in a message
LONGEST = 2_000_000  # number of characters of a line; each of its words becomes an object


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits that are checked before a mesh is read; a mesh of a million triangles takes about 1 GB and 20 s."""

    megabytes: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 500.0
    """Greatest size of a mesh's file, and of all its buffers together, megabytes."""
    triangles: Annotated[int, msgspec.Meta(ge=1, le=10**9)] = 5_000_000
    """Greatest number of triangles of a mesh."""

    @property
    def bytes(self) -> int:
        """Greatest size of a file, bytes."""
        return int(self.megabytes * 1e6)

    def check(self, vertices: int, triangles: int, file: str | Path) -> None:
        """Check the numbers of vertices and triangles of a file against the limits.

        Args:
            vertices: Number of vertices.
            triangles: Number of triangles.
            file: File to name in the error.

        Raises:
            InputError: If there are too many triangles, or more vertices than the most triangles can use.
        """
        most_vertices = VERTICES_A_TRIANGLE * self.triangles
        for count, most, element in ((triangles, self.triangles, "triangles"), (vertices, most_vertices, "vertices")):
            if count > most:
                raise InputError(
                    f"has {count:,} {element}",
                    file=file,
                    cure=f'simplify it; at most {most:,} {element} are read (SET="align.limits.triangles=…")',
                )

    @staticmethod
    def check_parts(parts: int, file: str | Path) -> None:
        """Raise InputError for more than MOST_PARTS parts in one file."""
        if parts > MOST_PARTS:
            raise InputError(
                f"has {parts:,} parts",
                file=file,
                cure=f"join parts that have the same material: at most {MOST_PARTS:,} parts are read",
            )


NO_LIMITS = Limits(megabytes=1e6, triangles=10**9)  # for meshes that an earlier stage has checked


class TriangleSoup(msgspec.Struct, frozen=True):
    """Triangles as read from a file.

    vertices  [V, 3] float64
    faces     [F, 3] int64
    part      [F] int: index into `parts`
    parts     one tuple of names per part, all that the file gives it (OBJ: usemtl, groups, object; glTF: primitive,
              node, material); a dataset may use any of them
    normals   [F, 3, 3] float64 per corner, NaN where the file has none
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    part: Int[np.ndarray, " f"]
    parts: list[tuple[str, ...]]
    normals: Float[np.ndarray, "f 3 3"]


def floats(values: np.ndarray) -> Float[np.ndarray, "..."]:
    """Convert to float64, without a warning for NaN of any kind."""
    with np.errstate(invalid="ignore"):
        return np.asarray(values, dtype=float)


def single_part_soup(
    vertices: np.ndarray, faces: np.ndarray, name: str, normals: np.ndarray | None = None
) -> TriangleSoup:
    """Build a soup whose faces are all one part.

    Args:
        vertices: Vertices, [V, 3].
        faces: Triangles, [F, 3].
        name: Name of the part.
        normals: Normals by vertex, [V, 3].

    Returns:
        The soup.
    """
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    corner_normals = no_normals(len(faces)) if normals is None else normals_at_corners(normals, faces)
    return TriangleSoup(
        floats(vertices).reshape(-1, 3), faces, np.zeros(len(faces), np.int64), [(name,)], corner_normals
    )


def no_normals(faces: int) -> Float[np.ndarray, "f 3 3"]:
    """Return the corner normals of a file without normals: NaN."""
    return np.full((faces, 3, 3), np.nan)


def normals_at_corners(normals: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3 3"]:
    """Convert normals by vertex to normals by corner, NaN where a face's index is out of range."""
    exists = (faces >= 0) & (faces < len(normals))
    return np.concatenate([floats(normals), np.full((1, 3), np.nan)])[np.where(exists, faces, len(normals))]


def fans(counts: Int[np.ndarray, " n"], corners: Int[np.ndarray, " c"]) -> Int[np.ndarray, "f 3"]:
    """Triangulate polygons, each as a fan about its first corner; polygons of fewer than three corners give none.

    `counts` are the numbers of corners of the polygons, `corners` those of all polygons in a row.

    >>> fans(np.array([3, 2, 4]), np.array([7, 8, 9, 1, 2, 3, 4, 5, 6])).tolist()
    [[7, 8, 9], [3, 4, 5], [3, 5, 6]]
    """
    triangles = np.maximum(counts - 2, 0)
    first = np.repeat(np.cumsum(counts) - counts, triangles)
    within = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[first], corners[first + within + 1], corners[first + within + 2]], axis=1).astype(np.int64)


def check_soup(soup: TriangleSoup, file: str | Path) -> TriangleSoup:
    """Check that triangles read from a file make a usable shape, and return them.

    Raises:
        InputError: If it has no faces, an index out of range, a vertex that is not finite, or a size or position that
            leaves no digits for the shape.
    """

    def refuse(fault: str, cure: str) -> NoReturn:
        """Raise an InputError for this file."""
        raise InputError(fault, file=file, cure=cure)

    if len(soup.faces) == 0:
        refuse("the mesh has no faces", "export triangles, not only points or lines")
    low = int(soup.faces.min())
    high = int(soup.faces.max())
    if low < 0 or high >= len(soup.vertices):
        refuse(
            f"a face uses vertex {(low if low < 0 else high) + 1}, but there are {len(soup.vertices)} vertices",
            "the file is damaged: copy or export it again",
        )
    bad = ~np.isfinite(soup.vertices).all(axis=1)
    if bad.any():
        refuse(
            f"{int(bad.sum())} vertices are not finite; the first is number {int(np.argmax(bad)) + 1}",
            "remove them in a mesh editor, or export the mesh again",
        )
    corners = soup.vertices[soup.faces.reshape(-1)]
    cure = "move the mesh to its origin, or export it in another unit"
    largest = float(np.abs(corners).max())
    extent = float(np.ptp(corners, axis=0).max())
    if largest > LARGEST:
        refuse(f"a coordinate is {largest:.3g}, more than {LARGEST:.0e}", cure)
    if 0 < extent < LEAST_EXTENT:
        refuse(f"is {extent:.3g} across, less than {LEAST_EXTENT:.0e}", cure)
    if 0 < extent < LEAST_SHARE * largest:
        refuse(f"is {extent:.3g} across but {largest:.3g} from its origin: too few digits are left for its shape", cure)
    return soup


def text_lines(content: bytes) -> Iterator[str]:
    r"""Yield the lines of a text with any of the three line ends.

    Other characters that Python treats as line ends do not count.
    ValueError is raised for a line of more than LONGEST characters.

    >>> list(text_lines("Stühle\r\nb\rc\x0cd\n".encode("utf-8-sig"))), list(text_lines("Stühle".encode("latin-1")))
    (['Stühle', 'b', 'c\x0cd'], ['Stühle'])
    """
    try:
        content.decode("utf-8-sig")
        encoding = "utf-8-sig"
    except UnicodeDecodeError:
        encoding = "latin-1"
    with io.TextIOWrapper(io.BytesIO(content), encoding) as text:  # line by line, since a list takes far more memory
        for line in text:
            if len(line) > LONGEST:
                raise ValueError(f"it has a line of more than {LONGEST:,} characters")
            yield line.rstrip("\n")


def parse_numbers(text: str | bytes) -> Float[np.ndarray, " n"]:
    r"""Parse all numbers of a text, separated by white space; ValueError for anything else in it.

    >>> parse_numbers("1 2.5\n-3e2").tolist()
    [1.0, 2.5, -300.0]
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy only warns of text that is not a number
        try:
            return np.fromstring(text, dtype=float, sep=" ") if text.strip() else np.empty(0)
        except DeprecationWarning:
            raise ValueError("a word in it is not a number") from None


def quoted(line: str) -> str:
    """Quote a line for a message, cut to QUOTED characters."""
    line = line.strip()
    return repr(line if len(line) <= QUOTED else line[: QUOTED - 1] + "…")
