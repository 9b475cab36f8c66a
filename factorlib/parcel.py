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
from typing import Any

import cloudpickle
import numpy as np

from factorlib.wholefile import write_bytes

LEAST = 16_384  # bytes of an array that is worth a place on the shelf
FORGOTTEN = 20  # maps in which an array was not used, after which its file is deleted


class Shelf:
    """A folder of arrays, each content once.  written: bytes of all of them so far"""

    def __init__(self, folder: Path):
        self.folder, self.maps, self.written = folder, 0, 0
        self._used: dict[Path, int] = {}

    def pack(self, values: list[Any]) -> list[bytes]:
        """Each value as bytes for `unpack`, what is large among them on the shelf when this returns."""
        self.maps += 1
        packed = [pack(value, self._put) for value in values]
        for file in [file for file, last in self._used.items() if self.maps - last >= FORGOTTEN]:
            del self._used[file]
            file.unlink(missing_ok=True)
        return packed

    def _put(self, body: memoryview) -> Path:
        file = self.folder / hashlib.blake2b(body, digest_size=20).hexdigest()
        if file not in self._used:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_bytes(file, body)
            self.written += body.nbytes
        self._used[file] = self.maps
        return file


def pack(value: Any, put: Callable[[memoryview], Path] | None = None) -> bytes:
    """A value as bytes for `unpack`; put: where an array of LEAST bytes or more is laid, else it is part of them."""
    places: list[tuple[Path, int]] = []

    def inside(buffer: pickle.PickleBuffer) -> bool:
        """Whether pickle keeps the array's bytes itself."""
        if put is None or (body := buffer.raw()).nbytes < LEAST:
            return True
        places.append((put(body), body.nbytes))
        return False

    stream = io.BytesIO()
    _Pickler(stream, protocol=5, buffer_callback=inside).dump(value)
    return pickle.dumps((places, stream.getvalue()))


def unpack(data: bytes) -> Any:
    """The value again.  Raises OSError where its shelf cannot be read."""
    places, body = pickle.loads(data)
    return pickle.loads(body, buffers=[_read(*place) for place in places])


def _read(file: Path, size: int) -> bytearray:
    data = bytearray(file.read_bytes())
    if len(data) != size:
        raise OSError(f"{file}: cut at {len(data)} bytes")
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
