"""PLY files: read in text and both byte orders, written in binary little-endian, the same mesh as the same bytes.

The numbers of a text file are read as rows of float64, so that one reader does for text and binary.  Rows are read at once where
their lists are as long as those of the first row, else one by one.  Nothing is made that the file has no room for.
"""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.soup import Soup, fans, floats, of_one_part
from factorlib.meshes.text import lines_of, numbers_in, shown
from factorlib.wholefile import write_bytes

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST = 1 << 20  # bytes of a header
END = re.compile(rb"^end_header[ \t]*(\r\n|\n|\r)", re.MULTILINE)
COUNT = re.compile(r"[0-9]{1,18}")
CORNERS = ("vertex_indices", "vertex_index")
CURE = "is it whole, and a PLY? export it again"


class Property(msgspec.Struct, frozen=True):
    """The type of a number, and of the length that comes before a list of them (None: a single number), as NumPy writes them."""

    type: str
    length: str | None = None


class Element(msgspec.Struct, frozen=True):
    """A table of the file (`vertex`, `face` …): `count` rows of `properties`, in this order."""

    name: str
    count: int
    properties: dict[str, Property]


class Column(msgspec.Struct, frozen=True):
    """values: one a row, or those of all lists in a row; counts: [rows] how many of them each row has."""

    values: np.ndarray
    counts: np.ndarray


def read_ply(path: Path, content: bytes, limits: Limits) -> Soup:
    """Vertices, polygons and, where there are all three of nx, ny, nz, normals; textures that it names are left alone."""
    order, elements, start = _header(path, content)
    counts = {element.name: element.count for element in elements}
    limits.check(counts.get("vertex", 0), counts.get("face", 0), path)
    rows = _Rows(content, start, order) if order else _Rows(numbers_in(content[start:]).tobytes(), 0, "")
    columns = {element.name: rows.columns(element) for element in elements}
    polygons = _polygons(columns.get("face", {}), path)
    limits.check(0, int(np.maximum(polygons.counts - 2, 0).sum()), path)
    points = _vectors(columns.get("vertex", {}), ("x", "y", "z"))
    if points is None:
        raise InputError("its vertices have no x, y, z", file=path, cure=CURE)
    normals = _vectors(columns["vertex"], ("nx", "ny", "nz"))
    return of_one_part(points, fans(polygons.counts, polygons.values), path.stem, normals)


def _polygons(face: dict[str, Column], path: Path) -> Column:
    """The corners of each face, whole numbers: the list of that name, or the only one."""
    name = next((name for name in CORNERS if name in face), next(iter(face)) if len(face) == 1 else None)
    if name is None:
        return Column(np.empty(0, np.int64), np.zeros(0, np.int64))
    values = face[name].values
    whole = values.astype(np.int64) if values.dtype.kind != "f" or (np.abs(values) < 2**53).all() else None
    if whole is None or (whole != values).any():
        raise InputError("a corner of a face is no whole number", file=path, cure=CURE)
    return Column(whole, face[name].counts)


def _vectors(columns: dict[str, Column], names: tuple[str, ...]) -> np.ndarray | None:
    """Three properties as vectors; None where one is missing, or a list."""
    if not all(name in columns and (columns[name].counts == 1).all() for name in names):
        return None
    return np.stack([floats(columns[name].values) for name in names], axis=1)


# ── header ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def _header(path: Path, content: bytes) -> tuple[str, list[Element], int]:
    """The byte order ("": text), the elements, and where rows begin; InputError for counts that the file has no room for."""
    end = END.search(content, 0, LONGEST)
    if not content.startswith(b"ply") or end is None:
        raise InputError("has no header of a PLY", file=path, cure=CURE)
    data_begins = end.group(1) == b"\r\n" and b"\r\n" not in content[:5]  # with a \n, where no other line ends so
    order, elements, start = None, [], end.end() - data_begins
    for line in lines_of(content[3 : end.start()]):
        try:
            order = _take(line.split(), order, elements)
        except (ValueError, LookupError) as error:
            found = f"its header says {shown(' '.join(line.split()))} ({shown(str(error))[1:-1]})"
            raise InputError(found, file=path, cure=CURE) from error
    if order is None:
        raise InputError("its header does not say its format", file=path, cure=CURE)
    needed = sum(element.count * _least_bytes(element, order) for element in elements)
    if needed > len(content) - start + 1:  # text may end without a line's end
        counts = ", ".join(f"{element.count:,} {shown(element.name)[1:-1]}" for element in elements)
        found = f"its header says {counts}: {needed:,} bytes at least; {len(content) - start:,} follow"
        raise InputError(found, file=path, cure=CURE)
    return order, elements, start


def _take(words: list[str], order: str | None, elements: list[Element]) -> str | None:
    """One line of the header; the byte order, once known."""
    match words[:1]:
        case [] | ["comment"] | ["obj_info"]:
            pass
        case ["format"]:
            return ORDERS[words[1]]
        case ["element"]:
            if not COUNT.fullmatch(words[2]) or any(element.name == words[1] for element in elements):
                raise ValueError("a new name and a count were expected")
            elements.append(Element(words[1], int(words[2]), {}))
        case ["property"]:
            is_list, named = words[1] == "list", elements[-1].properties
            name, kind = (
                (words[4], Property(TYPES[words[3]], TYPES[words[2]]))
                if is_list
                else (words[2], Property(TYPES[words[1]]))
            )
            if is_list and kind.length.startswith("f"):
                raise ValueError("a list's length is a whole number")
            if name in named:
                raise ValueError("named twice")
            named[name] = kind
        case _:
            raise ValueError("not a word of PLY")
    return order


def _least_bytes(element: Element, order: str) -> int:
    """What a row takes at least: every list empty; in text a digit and a space each."""
    return sum(np.dtype(p.length or p.type).itemsize if order else 2 for p in element.properties.values())


# ── rows ─────────────────────────────────────────────────────────────────────────────────────────────────────────────


class _Rows:
    """The rows of a file's elements, from byte `at` on; byte order "": every number is a float64."""

    def __init__(self, content: bytes, at: int, order: str):
        self.content, self.at, self.order = content, at, order

    def columns(self, element: Element) -> dict[str, Column]:
        """All rows of an element, by property; `at` moves behind them.  ValueError where they end early."""
        if not element.count or not element.properties:
            return {name: Column(np.empty(0), np.zeros(0, np.int64)) for name in element.properties}
        begin, lengths = self.at, [len(self._next(p)) for p in element.properties.values()]
        self.at = begin
        return self._alike(element, lengths) or self._one_by_one(element)

    def _kind(self, name: str) -> np.dtype:
        return np.dtype(self.order + name if self.order else "f8")

    def _numbers(self, kind: np.dtype, count: int) -> np.ndarray:
        if self.at + count * kind.itemsize > len(self.content):
            raise ValueError("its rows end early")
        self.at += count * kind.itemsize
        return np.frombuffer(self.content, kind, count, self.at - count * kind.itemsize)

    def _next(self, p: Property) -> np.ndarray:
        """The next number, or those of the next list."""
        length = 1 if p.length is None else self._numbers(self._kind(p.length), 1)[0].item()
        if length < 0 or length != int(length):
            raise ValueError(f"a list of {length} numbers")
        return self._numbers(self._kind(p.type), int(length))

    def _alike(self, element: Element, lengths: list[int]) -> dict[str, Column] | None:
        """All rows with lists of `lengths`, as one structured array; None where there is no room for them, or one has others."""
        fields = []
        for number, (p, n) in enumerate(zip(element.properties.values(), lengths)):
            fields += [(f"n{number}", self._kind(p.length), (1,))] if p.length else []
            fields += [(f"v{number}", self._kind(p.type), (n,))]
        size = sum(kind.itemsize * shape[0] for _, kind, shape in fields)
        if self.at + element.count * size > len(self.content):
            return None
        rows = np.frombuffer(self.content, np.dtype(fields), element.count, self.at)
        if any((rows[name] != lengths[int(name[1:])]).any() for name, *_ in fields if name[0] == "n"):
            return None
        self.at += element.count * size
        return {
            name: Column(rows[f"v{k}"].reshape(-1), np.full(len(rows), lengths[k]))
            for k, name in enumerate(element.properties)
        }

    def _one_by_one(self, element: Element) -> dict[str, Column]:
        parts = [{name: self._next(p) for name, p in element.properties.items()} for _ in range(element.count)]
        return {
            name: Column(np.concatenate([row[name] for row in parts]), np.array([len(row[name]) for row in parts]))
            for name in element.properties
        }


# ── writing ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def write_ply(path: str | Path, mesh: Mesh) -> None:
    """Write vertices (float64 as float32), normals and faces, with `label` per face: what Mitsuba and other readers read."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "property int label",
        "end_header",
        "",
    ]
    vertices = np.concatenate([mesh.vertices, mesh.normals], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3), ("label", "<i4")])
    faces["count"], faces["index"], faces["label"] = 3, mesh.faces, mesh.face_label
    write_bytes(path, "\n".join(lines).encode("ascii") + vertices.tobytes() + faces.tobytes())


def submesh(mesh: Mesh, label: int) -> Mesh:
    """The faces of one material, with only the vertices they use."""
    keep = mesh.face_label == label
    used, index = np.unique(mesh.faces[keep], return_inverse=True)
    faces = index.reshape(-1, 3).astype(np.int32)
    return Mesh(mesh.vertices[used], faces, mesh.normals[used], mesh.face_label[keep], mesh.open)
