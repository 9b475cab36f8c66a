"""Readers of mesh files of one part: PLY, STL (binary and text) and OFF; and a deterministic writer of binary PLY.

PLY is read here, because its lists may differ in length, which trimesh refuses. A row of a text file is a line; numbers
behind those of the header, which MeshLab writes, are ignored. Nothing is allocated that the file has no room for.
"""

import re
from pathlib import Path

import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.mesh import Mesh
from factorlib.meshes.triangle_soup import (
    Limits,
    TriangleSoup,
    floats,
    parse_numbers,
    quoted,
    single_part_soup,
    strip_triangles,
    text_lines,
    triangulate,
)
from factorlib.wholefile import write_bytes

TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    **{f"{kind}{8 * size}": f"{kind[0]}{size}" for kind in ("int", "uint", "float") for size in (1, 2, 4, 8)},
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST = 1 << 20  # greatest size of a header, bytes
END = re.compile(rb"^end_header[ \t]*(\r\n|\n|\r)", re.MULTILINE)
COUNT = re.compile(r"[0-9]{1,18}")
CORNERS = ("vertex_indices", "vertex_index")


Properties = dict[str, tuple[str, str | None]]  # NumPy types of the numbers, and of the length before a list of them
Elements = dict[str, tuple[int, Properties]]  # number of rows and their properties
Columns = dict[str, tuple[np.ndarray, np.ndarray]]  # numbers of all rows, concatenated, and the count of each row
STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
VERTEX = re.compile(rb"^[ \t]*vertex\b([^\r\n]*)", re.MULTILINE | re.IGNORECASE)
END_FACET = re.compile(rb"^[ \t]*end[ \t]*facet\b", re.MULTILINE | re.IGNORECASE)
COUNTS = re.compile(r"(?:(?:ST)?C?N?OFF)?\s*([0-9]+)\s+([0-9]+)[^\n]*")  # OFF itself is optional
CURE = "the file may be incomplete, or of another format than its suffix: copy or export it again"


def read_ply(path: Path, content: bytes, limits: Limits) -> TriangleSoup:
    """Read vertices, polygons, strips and, if all of nx, ny, nz are present, normals of a PLY; textures are ignored.

    Args:
        path: File, to be named in errors.
        content: Content of the file.
        limits: Limits on its size.

    Returns:
        The triangles, in one part.

    Raises:
        InputError: If the file is malformed or too large.
    """
    order, elements, start = _header(path, content)
    counts = {name: count for name, (count, _) in elements.items()}
    limits.check(counts.get("vertex", 0), counts.get("face", 0), path)
    columns = {} if order else _text_columns(content[start:], elements)
    for name, (count, properties) in elements.items() if order else ():
        columns[name], start = _columns(content, start, order, count, properties)
    values, sizes = _corners(columns.get("face", {}))
    if "tristrips" in columns:
        strip_values, lengths = _corners(columns["tristrips"])
        strips = strip_triangles(np.insert(floats(strip_values), np.cumsum(lengths), -1))
        values = np.append(values, strips)
        sizes = np.append(sizes, np.full(len(strips), 3))
    numbers = {name: floats(column) for name, (column, each) in columns.get("vertex", {}).items() if (each == 1).all()}
    points, normals = (
        np.stack([numbers[name] for name in names], axis=1) if numbers.keys() >= {*names} else np.empty((0, 3))
        for names in (("x", "y", "z"), ("nx", "ny", "nz"))
    )
    if not numbers.keys() >= {"x", "y", "z"}:
        raise InputError("its vertices have no x, y, z", file=path, cure=CURE)
    return _polygon_soup(points, values, sizes, path, limits, normals)


def _corners(columns: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of all polygons or strips, and their number in each: the list of a known name, or the only."""
    name = next((name for name in CORNERS if name in columns), next(iter(columns)) if len(columns) == 1 else None)
    return columns[name] if name else (np.empty(0), np.zeros(0, np.int64))


def _polygon_soup(
    points: np.ndarray,
    values: np.ndarray,
    sizes: np.ndarray,
    path: Path,
    limits: Limits,
    normals: np.ndarray = np.empty((0, 3)),
) -> TriangleSoup:
    """Return the triangles of polygons with vertex indices `values`, all in a row; InputError for a bad index."""
    limits.check(0, int(np.maximum(sizes - 2, 0).sum()), path)
    whole = values.dtype.kind != "f" or (np.abs(values) < 2**53).all()
    if not whole or ((corners := values.astype(np.int64)) != values).any():
        raise InputError("a face has a vertex index that is not a whole number", file=path, cure=CURE)
    return single_part_soup(points, corners[triangulate(points, sizes, corners)], path.stem, normals)


def _header(path: Path, content: bytes) -> tuple[str, dict[str, tuple[int, Properties]], int]:
    """Parse the header.

    The result is the byte order ("" for text), rows and properties of each element, and the offset of the rows.
    InputError is raised for counts that the file has no room for.
    """
    end = END.search(content, 0, LONGEST)
    if not content.startswith(b"ply") or end is None:
        raise InputError("does not begin with the header of a PLY", file=path, cure=CURE)
    # if only the last line ends in \r\n, the \n is the first byte of the data
    data_begins = end.group(1) == b"\r\n" and b"\r\n" not in content[:5]
    order = None
    elements: dict[str, tuple[int, Properties]] = {}
    start = end.end() - data_begins
    properties: Properties | None = None  # of the last element
    for line in text_lines(content[3 : end.start()]):
        try:
            match line.split():
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", word, *_]:
                    order = ORDERS[word]
                case ["element", name, count] if COUNT.fullmatch(count) and name not in elements:
                    properties = {}
                    elements[name] = int(count), properties
                case ["property", "list", length, kind, name] if (
                    TYPES.get(length, "f")[0] != "f" and properties is not None and name not in properties
                ):
                    properties[name] = TYPES[kind], TYPES[length]
                case ["property", kind, name] if properties is not None and name not in properties:
                    properties[name] = TYPES[kind], None
                case _:
                    raise ValueError(line)
        except (ValueError, LookupError, TypeError) as error:
            raise InputError(
                f"its header has {quoted(' '.join(line.split()))}, which no PLY header has, or has it twice",
                file=path,
                cure=CURE,
            ) from error
    if order is None:
        raise InputError("its header has no line `format`", file=path, cure=CURE)
    _check_room(elements, order, len(content) - start, path)
    return order, elements, start


def _check_room(elements: dict[str, tuple[int, Properties]], order: str, room: int, path: Path) -> None:
    """Raise InputError if the header announces more rows than fit into the `room` bytes that follow it."""
    # least size of a row: every list is empty; in text, each number is a digit and a space
    sizes = [
        sum(np.dtype(length or kind).itemsize if order else 2 for kind, length in properties.values())
        for _, properties in elements.values()
    ]
    needed = sum(count * size for (count, _), size in zip(elements.values(), sizes))
    if needed > room + 1:  # text may end without a line end
        counts = ", ".join(f"{count:,} {quoted(name)[1:-1]}" for name, (count, _) in elements.items())
        raise InputError(
            f"its header announces {counts}, which take {needed:,} bytes at least, but {room:,} bytes follow",
            file=path,
            cure=CURE,
        )


def _text_columns(text: bytes, elements: Elements) -> dict[str, Columns]:
    """Return the columns of each element of a text file; ValueError for a row that ends early, or a bad length."""
    numbers = np.append(parse_numbers(text), 0)  # the last stands behind all rows
    lengths = np.array([words for line in text_lines(text) if (words := len(line.split()))], np.int64)
    starts = np.append(0, np.cumsum(lengths))
    columns: dict[str, Columns] = {}
    for name, (count, properties) in elements.items():
        place = starts[:count]
        ends = starts[1 : count + 1]
        if len(ends) < count:
            raise ValueError("the file ends in the middle of its rows")
        columns[name] = {}
        for each, (_, length) in properties.items():
            sizes = np.ones(count, np.int64)
            if length:
                sizes = numbers[place].astype(np.int64)
                if (sizes < 0).any() or (sizes != numbers[place]).any():
                    raise ValueError("the length of a list is not a whole number of at least 0")
                place = place + 1
            if (sizes > ends - place).any():
                raise ValueError("a row has fewer numbers than the header says")
            first = np.repeat(place - np.cumsum(sizes) + sizes, sizes)
            columns[name][each] = numbers[first + np.arange(len(first))], sizes
            place = place + sizes
        starts = starts[count:]
    return columns


def _columns(content: bytes, offset: int, order: str, count: int, properties: Properties) -> tuple[Columns, int]:
    """Return the columns of an element's rows, and the offset of their end.

    Consecutive rows with lists of equal lengths are read together. `order` is the byte order. ValueError is raised if
    the file ends early or a list has no valid length.
    """
    kinds = [
        (np.dtype(order + kind), np.dtype(order + length) if length else None) for kind, length in properties.values()
    ]
    pieces = [([np.empty(0)], [np.zeros(0, np.int64)]) for _ in kinds]
    row = 0
    ahead = 64
    while kinds and row < count:
        # layout of the next row, whose lists have their lengths in the file
        lengths = []
        fields: list[tuple[str, np.dtype, tuple[int, ...]]] = []
        place = offset
        for number, (kind, counter) in enumerate(kinds):
            length = 1
            if counter:
                fields.append((f"n{number}", counter, ()))
                number_bytes = content[place : place + counter.itemsize].ljust(counter.itemsize, b"\0")
                length = np.frombuffer(number_bytes, counter)[0].item()
                place += counter.itemsize
            lengths.append(length)
            fields.append((f"v{number}", kind, (length,)))
            place += length * kind.itemsize
            if length < 0 or place > len(content):
                raise ValueError("a list has a length below 0, or the file ends in the middle of its rows")
        # read ahead as many rows as have lists of the same lengths
        layout = np.dtype(fields)
        rows = np.frombuffer(
            content, layout, min(ahead, count - row, (len(content) - offset) // layout.itemsize), offset
        )
        differences = [rows[name] != lengths[int(name[1:])] for name in layout.names or () if name[0] == "n"]
        differs = np.logical_or.reduce(differences) if differences else np.zeros(len(rows), bool)
        rows, ahead = (rows[: np.argmax(differs)], 64) if differs.any() else (rows, 2 * ahead)
        for number, (values, sizes) in enumerate(pieces):
            values.append(rows[f"v{number}"].reshape(-1))
            sizes.append(np.full(len(rows), lengths[number]))
        row = row + len(rows)
        offset = offset + len(rows) * layout.itemsize
    joined = ((np.concatenate(values[1:] or values), np.concatenate(sizes)) for values, sizes in pieces)
    return dict(zip(properties, joined)), offset


def write_ply(path: str | Path, mesh: Mesh, colours: np.ndarray | None = None) -> None:
    """Write vertices (float64 as float32), normals and faces, with `label` per face, in the form that Mitsuba reads.

    Args:
        path: File to write.
        mesh: The mesh; its detail is three further properties per vertex, its texture coordinates are two (s, t).
        colours: Linear colours [v, 3] of the vertices (red, green, blue), in place of the detail.
    """
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    further = {"red green blue": colours} if colours is not None else {"detail_r detail_g detail_b": mesh.detail}
    further |= {"s t": mesh.uv}
    further = {name: values.reshape(len(values), -1) for name, values in further.items() if values is not None}
    columns = [mesh.vertices, mesh.normals, *further.values()]
    lines += [f"property float {name}" for name in " ".join(["x y z nx ny nz", *further]).split()]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "property int label"]
    vertices = np.concatenate(columns, axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3), ("label", "<i4")])
    faces["count"] = 3
    faces["index"] = mesh.faces
    faces["label"] = mesh.face_label
    header = "\n".join([*lines, "end_header", ""]).encode("ascii")
    write_bytes(path, header + vertices.tobytes() + faces.tobytes())


def submesh(mesh: Mesh, label: int) -> Mesh:
    """Return the faces of one material, with only the vertices that they use, and detail unless it is 1 everywhere."""
    keep = mesh.face_label == label
    used, index = np.unique(mesh.faces[keep], return_inverse=True)
    faces = index.reshape(-1, 3).astype(np.int32)
    detail = None if mesh.detail is None or (mesh.detail[used] == 1).all() else mesh.detail[used]
    uv = None if mesh.uv is None else mesh.uv[used]
    return Mesh(mesh.vertices[used], faces, mesh.normals[used], mesh.face_label[keep], mesh.open, detail, uv)


def read_stl(path: Path, content: bytes, limits: Limits) -> TriangleSoup:
    """Read an STL file: binary if its size matches its count of triangles, else text.

    Raises:
        InputError: If the file is malformed or too large.
    """
    binary_size = 84 + 50 * int.from_bytes(content[80:84], "little")
    if len(content) == binary_size:
        corners = np.frombuffer(content, STL_ROW, offset=84)["corners"]
    else:
        corners = parse_numbers(b" ".join(VERTEX.findall(content)))
        facets = len(END_FACET.findall(content))
        if not 0 < len(corners) == 9 * facets:
            raise InputError(
                f"is neither a whole text STL ({len(corners) // 3} corners of {facets} facets) "
                f"nor a whole binary STL ({len(content)} of {binary_size} bytes)",
                file=path,
                cure=CURE,
            )
    limits.check(corners.size // 3, corners.size // 9, path)
    return single_part_soup(corners, np.arange(corners.size // 3), path.stem)


def read_off(path: Path, content: bytes, limits: Limits) -> TriangleSoup:
    """Read an OFF file; polygons are triangulated.

    Raises:
        InputError: If the file is malformed or too large.
    """
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
    limits.check(vertices, faces, path)
    rows = "\n".join(lines[counts[0].count("\n") + 1 :]).encode()
    polygon: Properties = {"corners": ("f8", "f8")}
    columns = _text_columns(rows, {"vertex": (vertices, dict.fromkeys("xyz", ("f8", None))), "face": (faces, polygon)})
    points = np.stack([columns["vertex"][axis][0] for axis in "xyz"], axis=1)
    return _polygon_soup(points, *columns["face"]["corners"], path, limits)
