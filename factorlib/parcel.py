"""Work and its results as bytes, such that another process computes the same bits with them.

Strides  How a sum is ordered may depend on an array's strides, and pickling makes every view contiguous.  Here a view
         arrives with the strides that it was sent with.
Shelf    Observations are sent once: an array of LEAST bytes or more is written to a file that all processes see, and what
         is sent is where it lies, by the hash of its content.  Each map over the same observations then sends a few kB.
"""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
import numpy as np

from factorlib.wholefile import write_bytes

LEAST = 16_384  # bytes of an array that is worth a place on the shelf
FORGOTTEN = 20  # maps in which nothing of a file was used, after which it is deleted


class Place(NamedTuple):
    """Where an array's bytes lie."""

    file: Path
    offset: int
    size: int


class Shelf:
    """Arrays in files of a folder, each content once.  written: bytes of all of them so far"""

    def __init__(self, folder: Path):
        self.folder, self.maps, self.written = folder, 0, 0
        self._places: dict[bytes, Place] = {}
        self._used: dict[Path, int] = {}
        self._new: list[bytes] = []

    def pack(self, values: list[Any]) -> list[bytes]:
        """Each value as bytes for `unpack`, what is large among them on the shelf when this returns."""
        self.maps += 1
        file = self.folder / f"{self.maps}.arrays"
        packed = [pack(value, lambda body: self._put(body, file)) for value in values]
        if self._new:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_bytes(file, data := b"".join(self._new))
            self.written += len(data)
            self._new = []
        for old in [file for file, last in self._used.items() if self.maps - last >= FORGOTTEN]:
            del self._used[old]
            self._places = {content: place for content, place in self._places.items() if place.file != old}
            old.unlink(missing_ok=True)
        return packed

    def _put(self, body: memoryview, file: Path) -> Place:
        content = hashlib.blake2b(body, digest_size=20).digest()
        if content not in self._places:
            self._places[content] = Place(file, sum(map(len, self._new)), len(body))
            self._new.append(bytes(body))
        place = self._places[content]
        self._used[place.file] = self.maps
        return place


def pack(value: Any, put: Callable[[memoryview], Place] | None = None) -> bytes:
    """A value as bytes for `unpack`; put: where an array of LEAST bytes or more is laid, else it is part of them."""
    places: list[Place] = []

    def inside(buffer: pickle.PickleBuffer) -> bool:
        """Whether pickle keeps the array's bytes itself."""
        if put is None or (body := buffer.raw()).nbytes < LEAST:
            return True
        places.append(put(body))
        return False

    stream = io.BytesIO()
    _Pickler(stream, protocol=5, buffer_callback=inside).dump(value)
    return pickle.dumps((places, stream.getvalue()))


def unpack(data: bytes) -> Any:
    """The value again.  Raises OSError where its shelf cannot be read."""
    places, body = pickle.loads(data)
    return pickle.loads(body, buffers=map(_read, places))


def _read(place: Place) -> bytearray:
    data = bytearray(place.size)
    with open(place.file, "rb") as stream:
        stream.seek(place.offset)
        if (count := stream.readinto(data)) != place.size:
            raise OSError(f"{place.file}: cut at {place.offset + count} bytes")
    return data


class _Pickler(cloudpickle.Pickler):
    """Functions by their code where no module has them (cloudpickle); views by their elements and strides."""

    def reducer_override(self, value: Any) -> Any:
        """How pickle takes a value apart."""
        if type(value) is not np.ndarray or value.flags.forc or value.dtype.hasobject:
            return super().reducer_override(value)
        once = value[tuple(slice(0, 1) if stride == 0 else slice(None) for stride in value.strides)]  # a repeated axis
        return _strided, (np.ascontiguousarray(once), value.shape, value.strides)


def _strided(elements: np.ndarray, shape: tuple[int, ...], strides: tuple[int, ...]) -> np.ndarray:
    """The elements in memory of their own, as far apart as `strides` say; those of a repeated axis come once."""
    reach = [(size - 1) * stride for size, stride in zip(shape, strides, strict=True)]
    before, after = -sum(r for r in reach if r < 0), sum(r for r in reach if r > 0) + elements.itemsize
    value = np.ndarray(shape, elements.dtype, np.empty(before + after, np.uint8).data, before, strides)
    value[...] = elements
    return value
