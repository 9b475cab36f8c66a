"""The rows of a PLY's elements as columns; text and both byte orders alike.

A row of fixed length is read at once.  Lists may have another length in every row (triangles beside quads): where they
have not, they too are read at once, else row by row.  Nothing is made that the file has no room for.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import numpy as np

from factorlib.meshes.ply_header import Element, Header, Property
from factorlib.meshes.text import numbers_in


class Column(msgspec.Struct, frozen=True):
    """values: one a row, or those of all lists in a row; counts: [rows] how many of them each row has."""

    values: np.ndarray
    counts: np.ndarray


Columns = dict[str, Column]


def columns_of(header: Header, content: bytes) -> dict[str, Columns]:
    """Columns by element and property; ValueError where the rows end early or are no numbers."""
    rows = _Text(content[header.start :]) if header.text else _Binary(content, header.start)
    return {element.name: rows.columns(element) for element in header.elements}


class _Rows:
    """Where the next row begins; the two kinds of file say what is there."""

    at = 0

    def columns(self, element: Element) -> Columns:
        """All rows of an element as columns, by property; `at` moves behind them."""
        if not element.count or not element.properties:
            return {p.name: Column(np.empty(0), np.zeros(0, np.int64)) for p in element.properties}
        lengths = list(self._lengths(element.properties, self.at))
        return self.alike(element, lengths) or self._one_by_one(element)

    def alike(self, element: Element, lengths: list[int]) -> Columns | None:
        """All rows with lists of `lengths`; None where there is no room for them, or one has others."""
        raise NotImplementedError

    def number(self, kind: np.dtype, at: int) -> tuple[float, int]:
        """The number at a place, and the place after it."""
        raise NotImplementedError

    def numbers(self, kind: np.dtype, count: int, at: int) -> tuple[np.ndarray, int]:
        """`count` numbers from position `at`, and the position after them; ValueError where the file ends before."""
        raise NotImplementedError

    def _lengths(self, properties: list[Property], at: int) -> Iterator[int]:
        """Length of each property of the row at `at`; 1 for what is no list."""
        for p in properties:
            length, after = self._length(p, at)
            yield length
            at = self.numbers(p.type, length, after)[1]

    def _length(self, p: Property, at: int) -> tuple[int, int]:
        if p.length is None:
            return 1, at
        length, after = self.number(p.length, at)
        if length < 0 or length != int(length):
            raise ValueError(f"a list of {length} numbers")
        return int(length), after

    def _one_by_one(self, element: Element) -> Columns:
        values: dict[str, list[np.ndarray]] = {p.name: [] for p in element.properties}
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties}
        for _ in range(element.count):
            for p in element.properties:
                length, after = self._length(p, self.at)
                found, self.at = self.numbers(p.type, length, after)
                values[p.name].append(found)
                counts[p.name].append(length)
        return {name: Column(np.concatenate(values[name]), np.array(counts[name])) for name in values}


class _Binary(_Rows):
    def __init__(self, content: bytes, start: int):
        self.content, self.at = content, start

    def number(self, kind: np.dtype, at: int) -> tuple[float, int]:
        """As of `_Rows`; `at` in bytes."""
        found, after = self.numbers(kind, 1, at)
        return found[0].item(), after

    def numbers(self, kind: np.dtype, count: int, at: int) -> tuple[np.ndarray, int]:
        """As of `_Rows`; `at` in bytes."""
        after = at + count * kind.itemsize
        if after > len(self.content):
            raise ValueError("its rows end early")
        return np.frombuffer(self.content, kind, count, at), after

    def alike(self, element: Element, lengths: list[int]) -> Columns | None:
        """As of `_Rows`: the rows are read as one structured array."""
        size = sum((p.length.itemsize if p.length else 0) + n * p.type.itemsize for p, n in zip(element.properties, lengths))
        if self.at + element.count * size > len(self.content):
            return None
        fields = []
        for number, (p, n) in enumerate(zip(element.properties, lengths)):
            fields += [(f"n{number}", p.length)] if p.length else []
            fields += [(f"v{number}", p.type, (n,))]
        rows = np.frombuffer(self.content, np.dtype(fields), element.count, self.at)
        if any((rows[f"n{k}"] != lengths[k]).any() for k, p in enumerate(element.properties) if p.length):
            return None
        self.at += element.count * size
        return {p.name: _even(rows[f"v{k}"], lengths[k]) for k, p in enumerate(element.properties)}


class _Text(_Rows):
    def __init__(self, content: bytes):
        self.table = numbers_in(content)

    def number(self, kind: np.dtype, at: int) -> tuple[float, int]:
        """As of `_Rows`; `at` in numbers from the first."""
        found, after = self.numbers(kind, 1, at)
        return found[0].item(), after

    def numbers(self, kind: np.dtype, count: int, at: int) -> tuple[np.ndarray, int]:
        """As of `_Rows`; `at` in numbers from the first."""
        if at + count > len(self.table):
            raise ValueError("its rows end early")
        return self.table[at : at + int(count)], at + int(count)

    def alike(self, element: Element, lengths: list[int]) -> Columns | None:
        """As of `_Rows`: the rows are one table."""
        ends = np.cumsum([n + (p.length is not None) for p, n in zip(element.properties, lengths)]).tolist()
        if self.at + element.count * ends[-1] > len(self.table):
            return None
        rows = self.table[self.at : self.at + element.count * ends[-1]].reshape(element.count, -1)
        if any((rows[:, end - n - 1] != n).any() for p, n, end in zip(element.properties, lengths, ends) if p.length):
            return None
        self.at += element.count * ends[-1]
        return {p.name: _even(rows[:, end - n : end], n) for p, n, end in zip(element.properties, lengths, ends)}


def _even(rows: np.ndarray, length: int) -> Column:
    return Column(rows.reshape(-1), np.full(len(rows), length))
