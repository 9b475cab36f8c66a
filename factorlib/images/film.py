"""Animations as GIF, and as H.264 if PyAV is installed; transparent frames are composited on white.

Neither format has half-transparent pixels.
"""

import io
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from factorlib.wholefile import write_bytes


def write_gif(path: str | Path, frames: Sequence[UInt8[np.ndarray, "h w 4"]], seconds: float) -> None:
    """Write a looping animation on a white background.

    Args:
        path: File to write.
        frames: Frames, RGBA.
        seconds: Duration of one loop.
    """
    solid = [Image.fromarray(_on_white(frame)) for frame in frames]
    memory = io.BytesIO()
    each = max(20, round(1000 * seconds / len(frames)))  # milliseconds; browsers slow down shorter frames
    solid[0].save(memory, "GIF", save_all=True, append_images=solid[1:], duration=each, loop=0, disposal=2)
    write_bytes(path, memory.getvalue())


def write_mp4(path: str | Path, frames: Sequence[UInt8[np.ndarray, "h w 4"]], seconds: float) -> None:
    """Write an animation as H.264 (BT.709) on a white background, if PyAV is installed (the extra `video`).

    An odd last row or column is cut off.

    Args:
        path: File to write.
        frames: Frames, RGBA.
        seconds: Duration.
    """
    try:
        import av
    except ImportError:
        return
    memory = io.BytesIO()
    bt709 = 1
    with av.open(memory, "w", format="mp4") as file:
        stream = file.add_stream("libx264", rate=Fraction(len(frames) / seconds).limit_denominator(1000))
        height, width = (n // 2 * 2 for n in frames[0].shape[:2])
        stream.width = width
        stream.height = height
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "16", "threads": "1"}  # one thread gives the same bytes each time
        stream.codec_context.colorspace = stream.codec_context.color_primaries = stream.codec_context.color_trc = bt709
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(_on_white(frame)[:height, :width]), "rgb24")
            file.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))
        file.mux(stream.encode(None))
    write_bytes(path, memory.getvalue())


def _on_white(frame: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 3"]:
    """Composite a frame on white."""
    alpha = frame[..., 3:].astype(float) / 255
    return np.rint(frame[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
