"""PLY files: read in text and both byte orders, written in binary little-endian, the same mesh as the same bytes.

The numbers of a text file are read as rows of float64, so that one reader does for text and binary.  Rows are read at once where
their lists are as long as those of the first row, else one by one (trimesh refuses these).  Nothing is made that the file has no
room for.
"""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.limits import Limits
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.soup import Soup, fans, floats, lines_of, numbers_in, of_one_part, quoted
from factorlib.wholefile import write_bytes

TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
         "double": "f8", **{f"{kind}{8 * size}": f"{kind[0]}{size}" for kind in ("int", "uint", "float")
                            for size in (1, 2, 4, 8)}}  # fmt: skip
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

    count: int
    properties: dict[str, Property]


class Column(msgspec.Struct, frozen=True):
    """values: one a row, or those of all lists in a row; counts: [rows] how many of them each row has."""

    values: np.ndarray
    counts: np.ndarray


def read_ply(path: Path, content: bytes, limits: Limits) -> Soup:
    """Vertices, polygons and, where there are all three of nx, ny, nz, normals; textures that it names are left alone."""
    order, elements, start = _header(path, content)
    counts = {name: element.count for name, element in elements.items()}
    limits.check(counts.get("vertex", 0), counts.get("face", 0), path)
    rows = _Rows(content, start, order) if order else _Rows(numbers_in(content[start:]).tobytes(), 0, "")
    columns = {name: rows.columns(element) for name, element in elements.items()}
    faces = columns.get("face", {})  # the list of that name, or the only one
    name = next((name for name in CORNERS if name in faces), next(iter(faces)) if len(faces) == 1 else None)
    polygons = faces[name] if name else Column(np.empty(0), np.zeros(0, np.int64))
    limits.check(0, int(np.maximum(polygons.counts - 2, 0).sum()), path)
    if polygons.values.dtype.kind == "f" and not (np.abs(polygons.values) < 2**53).all():
        raise InputError("a corner of a face is no whole number", file=path, cure=CURE)
    corners = polygons.values.astype(np.int64)
    if (corners != polygons.values).any():
        raise InputError("a corner of a face is no whole number", file=path, cure=CURE)
    points, normals = (_vectors(columns.get("vertex", {}), names) for names in ("xyz", ("nx", "ny", "nz")))
    if points is None:
        raise InputError("its vertices have no x, y, z", file=path, cure=CURE)
    return of_one_part(points, fans(polygons.counts, corners), path.stem, normals)


def _vectors(columns: dict[str, Column], names: tuple[str, ...] | str) -> np.ndarray | None:
    """Three properties as vectors; None where one is missing, or a list."""
    if not all(name in columns and (columns[name].counts == 1).all() for name in names):
        return None
    return np.stack([floats(columns[name].values) for name in names], axis=1)


def _header(path: Path, content: bytes) -> tuple[str, dict[str, Element], int]:
    """The byte order ("": text), the elements, and where rows begin; InputError for counts that the file has no room for."""
    end = END.search(content, 0, LONGEST)
    if not content.startswith(b"ply") or end is None:
        raise InputError("has no header of a PLY", file=path, cure=CURE)
    data_begins = end.group(1) == b"\r\n" and b"\r\n" not in content[:5]  # with a \n, where no other line ends so
    order, elements, start, properties = None, {}, end.end() - data_begins, None
    for line in lines_of(content[3 : end.start()]):
        try:
            match line.split():
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", word, *_]:
                    order = ORDERS[word]
                case ["element", name, count] if COUNT.fullmatch(count) and name not in elements:
                    properties = {}
                    elements[name] = Element(int(count), properties)
                case ["property", "list", length, kind, name] if (
                    TYPES.get(length, "f")[0] != "f" and name not in properties
                ):
                    properties[name] = Property(TYPES[kind], TYPES[length])
                case ["property", kind, name] if name not in properties:
                    properties[name] = Property(TYPES[kind])
                case _:
                    raise ValueError("not a line of PLY, or a second one of that name")
        except (ValueError, LookupError, TypeError) as error:
            fault = f"its header says {quoted(' '.join(line.split()))} ({quoted(str(error))[1:-1]})"
            raise InputError(fault, file=path, cure=CURE) from error
    if order is None:
        raise InputError("its header does not say its format", file=path, cure=CURE)
    # a row takes at least: every list empty; in text a digit and a space each
    sizes = [sum(np.dtype(p.length or p.type).itemsize if order else 2 for p in element.properties.values())
             for element in elements.values()]  # fmt: skip
    needed = sum(element.count * size for element, size in zip(elements.values(), sizes))
    if needed > len(content) - start + 1:  # text may end without a line's end
        counts = ", ".join(f"{element.count:,} {quoted(name)[1:-1]}" for name, element in elements.items())
        fault = f"its header says {counts}: {needed:,} bytes at least; {len(content) - start:,} follow"
        raise InputError(fault, file=path, cure=CURE)
    return order, elements, start


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
        if (columns := self._alike(element, lengths)) is not None:
            return columns
        rows = [{name: self._next(p) for name, p in element.properties.items()} for _ in range(element.count)]
        values = {name: [row[name] for row in rows] for name in element.properties}
        return {name: Column(np.concatenate(own), np.array([len(v) for v in own])) for name, own in values.items()}

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
            fields += [(f"n{number}", self._kind(p.length))] if p.length else []
            fields += [(f"v{number}", self._kind(p.type), (n,))]
        kind = np.dtype(fields)
        if self.at + element.count * kind.itemsize > len(self.content):
            return None
        rows = np.frombuffer(self.content, kind, element.count, self.at)
        if any((rows[name] != lengths[int(name[1:])]).any() for name in kind.names if name[0] == "n"):
            return None
        self.at += element.count * kind.itemsize
        columns = [Column(rows[f"v{k}"].reshape(-1), np.full(len(rows), n)) for k, n in enumerate(lengths)]
        return dict(zip(element.properties, columns))


def write_ply(path: str | Path, mesh: Mesh) -> None:
    """Write vertices (float64 as float32), normals and faces, with `label` per face: what Mitsuba and other readers read."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "property int label"]
    vertices = np.concatenate([mesh.vertices, mesh.normals], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3), ("label", "<i4")])
    faces["count"], faces["index"], faces["label"] = 3, mesh.faces, mesh.face_label
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    write_bytes(path, header + vertices.tobytes() + faces.tobytes())


def submesh(mesh: Mesh, label: int) -> Mesh:
    """The faces of one material, with only the vertices they use."""
    keep = mesh.face_label == label
    used, index = np.unique(mesh.faces[keep], return_inverse=True)
    faces = index.reshape(-1, 3).astype(np.int32)
    return Mesh(mesh.vertices[used], faces, mesh.normals[used], mesh.face_label[keep], mesh.open)
