"""The size of a mask is that of its photo."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from factorlib.errors import InputError


def check_size(found: Sequence[int], size: Sequence[int], path: str | Path, key: str) -> None:
    """Both (height, width); InputError unless they are the same, which says so if the mask lies on its side."""
    if tuple(found) == tuple(size):
        return
    cure = "save the mask with the photo's own pixels"
    if tuple(found) == tuple(size)[::-1]:
        cure = "it lies on its side: the photo's EXIF orientation is applied, so mask the photo as it is displayed"
    message = f"the mask is {found[1]} × {found[0]} pixels, the photo {size[1]} × {size[0]}"
    raise InputError(message, file=path, key=key, cure=cure)
