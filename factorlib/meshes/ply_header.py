"""The header of a PLY file: its elements, how many of each, and what each row of them holds."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np

from factorlib.errors import InputError
from factorlib.meshes.text import lines_of, shown

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST = 1 << 20  # bytes of a header
END = re.compile(rb"^end_header[ \t]*(\r\n|\n|\r)", re.MULTILINE)
COUNT = re.compile(r"[0-9]{1,18}")
CURE = "is it whole, and a PLY? export it again"


class Property(msgspec.Struct, frozen=True):
    """type: NumPy's, with its byte order; length: type of the number that comes before a list, None for a single value."""

    name: str
    type: np.dtype
    length: np.dtype | None = None


class Element(msgspec.Struct, frozen=True):
    """A table of the file (`vertex`, `face` …): `count` rows of `properties`, in this order."""

    name: str
    count: int
    properties: list[Property]

    def least_bytes(self, text: bool) -> int:
        """What a row takes at least: every list empty; in text a digit and a space each."""
        return sum(2 if text else (p.length or p.type).itemsize for p in self.properties)


class Header(msgspec.Struct, frozen=True):
    """text: numbers are written as text; start: where the rows begin."""

    text: bool
    elements: list[Element]
    start: int

    def element(self, name: str) -> Element | None:
        """The element of that name, None where there is none."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(path: Path, content: bytes) -> Header:
    """InputError for what is no PLY, and for counts that the file has no room for."""
    end = END.search(content, 0, LONGEST)
    if not content.startswith(b"ply") or end is None:
        raise InputError("has no header of a PLY", file=path, cure=CURE)
    start = end.end() if end.group(1) != b"\r\n" or b"\r\n" in content[:5] else end.end() - 1  # a \n may be data already
    lines = [line.split() for line in lines_of(content[3 : end.start()])]
    order, elements = None, []
    for words in lines:
        try:
            order = _take(words, order, elements)
        except (ValueError, LookupError) as error:
            raise InputError(f"its header says {shown(' '.join(words))} ({shown(str(error))[1:-1]})", file=path, cure=CURE) from error
    if order is None:
        raise InputError("its header does not say its format", file=path, cure=CURE)
    header = Header(order == "", elements, start)
    _check_room(header, len(content), path)
    return header


def _take(words: list[str], order: str | None, elements: list[Element]) -> str | None:
    """One line of the header; the byte order, once known."""
    if not words or words[0] in ("comment", "obj_info"):
        return order
    if words[0] == "format":
        return ORDERS[words[1]]
    if words[0] == "element":
        if not COUNT.fullmatch(words[2]) or any(element.name == words[1] for element in elements):
            raise ValueError("a new name and a count were expected")
        elements.append(Element(words[1], int(words[2]), []))
    elif words[0] == "property":
        elements[-1].properties.append(_property(words[1:], order or ""))
        if len({p.name for p in elements[-1].properties}) < len(elements[-1].properties):
            raise ValueError("named twice")
    else:
        raise ValueError("not a word of PLY")
    return order


def _property(words: list[str], order: str) -> Property:
    if words[0] != "list":
        return Property(words[1], np.dtype(order + TYPES[words[0]]))
    length = np.dtype(order + TYPES[words[1]])
    if length.kind == "f":
        raise ValueError("a list's length is a whole number")
    return Property(words[3], np.dtype(order + TYPES[words[2]]), length)


def _check_room(header: Header, size: int, path: Path) -> None:
    needed = sum(element.count * element.least_bytes(header.text) for element in header.elements)
    if needed > size - header.start + 1:  # text may end without a line's end
        counts = ", ".join(f"{element.count:,} {shown(element.name)[1:-1]}" for element in header.elements)
        found = f"its header says {counts}: {needed:,} bytes at least; {size - header.start:,} follow"
        raise InputError(found, file=path, cure=CURE)
