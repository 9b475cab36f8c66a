"""Animations for people: GIF, which every browser shows."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from factorlib.wholefile import write_bytes


def write_gif(path: str | Path, frames: Sequence[UInt8[np.ndarray, "h w 4"]], seconds: float) -> None:
    """Write an animation of so many seconds that goes round for ever; white where frames are transparent."""
    solid = []
    for frame in frames:
        alpha = frame[..., 3:].astype(float) / 255
        solid.append(Image.fromarray(np.rint(frame[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)))
    memory = io.BytesIO()
    each = max(20, round(1000 * seconds / len(frames)))  # browsers show shorter ones slowly
    solid[0].save(memory, "GIF", save_all=True, append_images=solid[1:], duration=each, loop=0, disposal=2)
    write_bytes(path, memory.getvalue())
