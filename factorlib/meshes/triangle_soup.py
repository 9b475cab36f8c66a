"""Mesh as its file has it, before it is made usable: triangles, normals of their corners, names of their parts.

Limits on its size are far above what a rough mesh needs, but within the memory of a usual machine. Text in mesh files
is UTF-8, UTF-16 with its mark, or else Latin-1, in which old programs write names and comments.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NoReturn

import msgspec
import numpy as np
from jaxtyping import Float, Int

from factorlib.errors import InputError
from factorlib.meshes.mesh import area_vectors

VERTICES_A_TRIANGLE = 3
MOST_PARTS = 100_000  # greatest number of parts of one file
LARGEST = 1e15  # greatest coordinate: its cube, and its ratio to any plausible length, are finite
LEAST_EXTENT = 1e-12  # least extent
LEAST_SHARE = 1e-9  # least extent over distance from the origin: below, too few digits are left for the shape
QUOTED = 80  # number of characters of a line in a message
FLAT = 1e-9  # least turn of a fan's triangle against its polygon, in areas of the polygon
MOST_CORNERS = 1000  # greatest number of corners of a concave polygon; clipping the ears of a spiral takes seconds
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
    vertices: np.ndarray, faces: np.ndarray, name: str, normals: np.ndarray = np.empty((0, 3))
) -> TriangleSoup:
    """Build a soup whose faces are all one part.

    Args:
        vertices: Vertices, [V, 3].
        faces: Triangles, [F, 3].
        name: Name of the part.
        normals: Normals by vertex, [V, 3], or none.

    Returns:
        The soup.
    """
    faces = np.asarray(faces, np.int64).reshape(-1, 3)
    return TriangleSoup(
        vertices=floats(vertices).reshape(-1, 3),
        faces=faces,
        part=np.zeros(len(faces), np.int64),
        parts=[(name,)],
        normals=normals_at_corners(normals, faces),
    )


def normals_at_corners(normals: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3 3"]:
    """Convert normals by vertex to normals by corner, NaN where a face's index is out of range."""
    exists = (faces >= 0) & (faces < len(normals))
    return np.concatenate([floats(normals), np.full((1, 3), np.nan)])[np.where(exists, faces, len(normals))]


def triangulate(
    vertices: Float[np.ndarray, "v 3"], sizes: Int[np.ndarray, " n"], corners: Int[np.ndarray, " c"]
) -> Int[np.ndarray, "f 3"]:
    """Triangulate polygons: each as a fan about its first corner or, if that leaves the polygon, by clipping ears.

    Polygons of fewer than three corners give no triangle.

    Args:
        vertices: Vertices; an index out of range may be in `corners`, and is reported later.
        sizes: Numbers of corners of the polygons.
        corners: Indices of the vertices of all polygons in a row.

    Returns:
        Triangles, as positions in `corners`.

    Raises:
        ValueError: If a polygon that needs its ears clipped has more than MOST_CORNERS corners.

    >>> square = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 0]])
    >>> triangulate(square, np.array([3, 2, 4]), np.array([2, 3, 4, 1, 2, 0, 1, 2, 3])).tolist()
    [[0, 1, 2], [5, 6, 7], [5, 7, 8]]
    """
    counts = np.maximum(sizes - 2, 0)
    ends = np.cumsum(counts)
    polygon = np.repeat(np.arange(len(sizes)), counts)
    first = (np.cumsum(sizes) - sizes)[polygon]
    second = first + np.arange(len(polygon)) - (ends - counts)[polygon] + 1
    triangles = np.stack([first, second, second + 1], axis=1).astype(np.int64)
    if len(vertices) == 0 or (counts < 2).all():
        return triangles
    with np.errstate(all="ignore"):  # vertices that are not finite are refused later
        points = vertices[np.clip(corners, 0, len(vertices) - 1).astype(np.int64)]
        area = area_vectors(points, triangles)
        # normal of a polygon: the sum of its fan's area vectors (Newell); a concave one has a triangle against it
        normal = np.stack([np.bincount(polygon, axis, len(sizes)) for axis in area.T], axis=1)
        against = (area * normal[polygon]).sum(axis=1) < -FLAT * np.square(normal).sum(axis=1)[polygon]
    for concave in np.unique(polygon[against]).tolist():
        if sizes[concave] > MOST_CORNERS:
            raise ValueError(f"a concave polygon has {sizes[concave]:,} corners; at most {MOST_CORNERS:,} are read")
        rows = slice(ends[concave] - counts[concave], ends[concave])
        start = triangles[rows.start, 0]
        triangles[rows] = start + _clip_ears(points[start : start + sizes[concave]], normal[concave])
    return triangles


def strip_triangles(corners: Int[np.ndarray, " c"]) -> Int[np.ndarray, "t 3"]:
    """Return the triangles of strips that −1 separates: every other one of a strip is turned to agree with its first.

    >>> strip_triangles(np.array([0, 1, 2, 3, -1, 4, 5, 6])).tolist()
    [[0, 1, 2], [3, 2, 1], [4, 5, 6]]
    """
    place = np.arange(len(corners))
    since = place - np.maximum.accumulate(np.where(corners == -1, place + 1, 0))  # number in its strip
    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    return np.where(since[:-2, None] % 2 == 1, triangles[:, ::-1], triangles)[(triangles != -1).all(axis=1)]


def _clip_ears(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, " 3"]) -> Int[np.ndarray, "t 3"]:
    """Triangulate a simple polygon about a normal: cut off triangles of neighbours that hold no corner."""
    left = np.arange(len(points))
    least = FLAT * normal @ normal
    triangles = []
    ear = 0
    while len(left) > 3:
        ears = np.stack([np.roll(left, 1), left, np.roll(left, -1)])
        area = area_vectors(points, ears.T) @ normal
        order = (np.arange(len(left)) + ear + 1) % len(left)  # not beside the last ear, which would make a thin one
        reflex = left[area <= least]
        for ear in order[area[order] > least]:
            # a corner lies in the triangle if it is outside no edge, and none of its corners
            inside = ~(points[reflex, None] == points[ears[:, ear]]).all(axis=2).any(axis=1)
            for edge in zip(ears[:, ear], np.roll(ears[:, ear], -1)):
                inside &= area_vectors(points, np.stack(np.broadcast_arrays(*edge, reflex), 1)) @ normal > -least
            if not inside.any():
                break
        else:
            ear = order[0]  # the polygon crosses itself, or is flat
        triangles.append(ears[:, ear])
        left = np.delete(left, ear)
    return np.stack([*triangles, left])


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
        encoding = "utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "latin-1"
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
    try:
        return np.fromstring(text, dtype=float, sep=" ") if text.strip() else np.empty(0)
    except ValueError:
        raise ValueError("a word in it is not a number") from None


def quoted(line: str) -> str:
    """Quote a line for a message, cut to QUOTED characters."""
    line = line.strip()
    return repr(line if len(line) <= QUOTED else line[: QUOTED - 1] + "…")
