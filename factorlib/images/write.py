"""Image files by OpenImageIO, whole or not at all.

OpenImageIO leaves an EXR incomplete until its output object is deleted, and neither `close` nor the deletion say whether
the last bytes found room: so it writes to memory, and the bytes go to disk by a writer that does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from factorlib.wholefile import bytes_of, write_bytes


def write_image(path: str | Path, spec: oiio.ImageSpec, pixels: np.ndarray) -> None:
    """Write `pixels` [h, w, c] in the format that the suffix of `path` names; raises OSError where that fails."""
    write_bytes(path, encoded(path, spec, pixels))


def encoded(name: str | Path, spec: oiio.ImageSpec, pixels: np.ndarray) -> bytes:
    """The bytes of an image file of `pixels` [h, w, c], in the format of the suffix of `name`; raises OSError where that fails."""
    return bytes_of(lambda memory: _encode(Path(name), memory, spec, np.ascontiguousarray(pixels)))


def _encode(path: Path, memory: str, spec: oiio.ImageSpec, pixels: np.ndarray) -> None:
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise OSError(f"{path}: cannot be written: {oiio.geterror()}")
    written = output.open(memory, spec) and output.write_image(pixels)
    error = output.geterror()
    closed = output.close()
    error = error or output.geterror()
    del output
    if not (written and closed):
        raise OSError(f"{path}: cannot be written: {error}")
