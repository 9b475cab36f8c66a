"""Work and its results as bytes, such that another process computes the same bits with them.

Layout   How a sum is ordered may depend on an array's strides, and pickling makes every view contiguous.  Here an array arrives
         with the strides that it was sent with.
Shelf    Observations are sent once: an array of LEAST bytes or more is written to a file that all processes see, and what is
         sent is where it lies, by the hash of its content.  Each map over the same observations then sends a few kB.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import uuid
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
import numpy as np

from factorlib.wholefile import write_bytes

LEAST = 16_384  # bytes of an array that is worth a place on the shelf
FORGOTTEN = 20  # maps in which nothing of a file was used, after which it is deleted
CACHED = 1 << 28  # bytes from shelves that a process keeps


class Place(NamedTuple):
    """Where an array's bytes lie."""

    file: Path
    offset: int
    size: int


class Shelf:
    """Arrays in files of a folder, each content once."""

    def __init__(self, folder: Path):
        self.folder, self.count, self.written = folder, 0, 0
        self._name = uuid.uuid4().hex  # readers keep what they read, by the file's name
        self._places: dict[bytes, Place] = {}
        self._used: dict[Path, int] = {}
        self._new: list[bytes] = []

    def pack(self, values: list[Any]) -> list[bytes]:
        """Each value as bytes for `unpack`, what is large among them on the shelf when this returns."""
        self.count += 1
        packed = [_packed(value, self._put) for value in values]
        if self._new:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_bytes(self._file, data := b"".join(self._new))
            self.written += len(data)
            self._new = []
        for file in [file for file, last in self._used.items() if self.count - last >= FORGOTTEN]:
            del self._used[file]
            self._places = {content: place for content, place in self._places.items() if place.file != file}
            file.unlink(missing_ok=True)
        return packed

    @property
    def _file(self) -> Path:
        return self.folder / f"{self._name}-{self.count}.arrays"

    def _put(self, data: bytes) -> Place:
        content = hashlib.blake2b(data, digest_size=20).digest()
        if content not in self._places:
            self._places[content] = Place(self._file, sum(map(len, self._new)), len(data))
            self._new.append(data)
        place = self._places[content]
        self._used[place.file] = self.count
        return place


def pack(value: Any) -> bytes:
    """A value as bytes for `unpack`, nothing of it on a shelf."""
    return _packed(value, None)


def unpack(data: bytes) -> Any:
    """The value again.  Raises OSError where its shelf cannot be read."""
    return pickle.loads(data)


def _packed(value: Any, put: Callable[[bytes], Place] | None) -> bytes:
    stream = io.BytesIO()
    _Pickler(stream, put).dump(value)
    return stream.getvalue()


# ── sending ──────────────────────────────────────────────────────────────────────────────────────────────────────────


class _Pickler(cloudpickle.Pickler):
    """Functions by their code where no module has them (cloudpickle); arrays as the module says."""

    def __init__(self, stream: io.BytesIO, put: Callable[[bytes], Place] | None):
        super().__init__(stream, protocol=5)
        self.put = put
        self.owners: set[int] = set()

    def reducer_override(self, value: Any) -> Any:
        """How pickle takes a value apart."""
        if type(value) is not np.ndarray or value.dtype.hasobject:
            return super().reducer_override(value)
        order = _order(value)
        if order is None:
            return self._view(value)
        if value.nbytes < LEAST:
            return super().reducer_override(value)
        self.owners.add(id(value))
        return _array, (value.dtype, value.shape, order, self._body(value.T if order == "F" else value))

    def _view(self, value: np.ndarray) -> tuple:
        """A part of a larger array: of that one, if it is sent too or is hardly larger; otherwise its elements, and its strides."""
        owner = _owner(value)
        if owner is not None and (id(owner) in self.owners or owner.nbytes <= 2 * value.nbytes):
            return _part, (owner, value.dtype, value.shape, _address(value) - _address(owner), value.strides)
        once = value[tuple(slice(0, 1) if stride == 0 else slice(None) for stride in value.strides)]  # a repeated axis
        return _strided, (value.dtype, value.shape, value.strides, once.shape, self._body(once))

    def _body(self, value: np.ndarray) -> Place | bytes:
        if value.nbytes < LEAST or self.put is None:
            return value.tobytes()
        return self.put(value.tobytes())


def _order(value: np.ndarray) -> str | None:
    """C or F where the strides are those that an array of that order is made with."""
    for order in "CF":
        sizes = value.shape if order == "F" else value.shape[::-1]
        strides, step = [], value.itemsize
        for size in sizes:
            strides.append(step)
            step *= size
        if value.size and value.strides == tuple(strides if order == "F" else strides[::-1]):
            return order
    return "C" if value.size == 0 else None


def _owner(value: np.ndarray) -> np.ndarray | None:
    """The array that has the memory of a view, where it is an ordinary one."""
    while isinstance(value.base, np.ndarray):
        value = value.base
    return value if type(value) is np.ndarray and value.base is None and _order(value) else None


def _address(value: np.ndarray) -> int:
    return value.__array_interface__["data"][0]


# ── receiving ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _array(dtype: np.dtype, shape: tuple[int, ...], order: str, body: Place | bytes) -> np.ndarray:
    data = _read(body) if isinstance(body, Place) else body
    return np.frombuffer(data, dtype).reshape(shape, order=order).copy(order)


def _part(
    owner: np.ndarray, dtype: np.dtype, shape: tuple[int, ...], offset: int, strides: tuple[int, ...]
) -> np.ndarray:
    return np.ndarray(shape, dtype, owner.data if owner.flags.c_contiguous else owner.T.data, offset, strides)


def _strided(
    dtype: np.dtype, shape: tuple[int, ...], strides: tuple[int, ...], once: tuple[int, ...], body: Place | bytes
) -> np.ndarray:
    """The elements in memory of their own, as far apart as `strides` say; once: their shape where a repeated axis is sent once."""
    reach = [(size - 1) * stride for size, stride in zip(shape, strides, strict=True)]
    before, after = -sum(r for r in reach if r < 0), sum(r for r in reach if r > 0) + dtype.itemsize
    value = np.ndarray(shape, dtype, np.empty(before + after, np.uint8).data, before, strides)
    value[...] = _array(dtype, once, "C", body)
    return value


_cache: OrderedDict[Place, bytes] = OrderedDict()


def _read(place: Place) -> bytes:
    """The bytes at a place, from this process's memory where they were read lately."""
    if place not in _cache:
        with open(place.file, "rb") as stream:
            stream.seek(place.offset)
            data = stream.read(place.size)
        if len(data) != place.size:
            raise OSError(f"{place.file}: cut at {place.offset + len(data)} bytes")
        _cache[place] = data
        while sum(map(len, _cache.values())) > CACHED and len(_cache) > 1:
            _cache.popitem(last=False)
    _cache.move_to_end(place)
    return _cache[place]
