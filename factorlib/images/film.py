"""Animations: GIF, and H.264 where PyAV is installed; white where frames are transparent, for neither has half-transparent pixels."""

import io
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from factorlib.wholefile import write_bytes


def write_gif(path: str | Path, frames: Sequence[UInt8[np.ndarray, "h w 4"]], seconds: float) -> None:
    """Write an animation of so many seconds that goes round for ever; white where frames are transparent."""
    solid, memory = [Image.fromarray(_on_white(frame)) for frame in frames], io.BytesIO()
    each = max(20, round(1000 * seconds / len(frames)))  # browsers show shorter ones slowly
    solid[0].save(memory, "GIF", save_all=True, append_images=solid[1:], duration=each, loop=0, disposal=2)
    write_bytes(path, memory.getvalue())


def write_mp4(path: str | Path, frames: Sequence[UInt8[np.ndarray, "h w 4"]], seconds: float) -> None:
    """Write the same animation, once round, as H.264 (BT.709), where PyAV is installed (the extra `video`); an odd last row or column is cut."""
    try:
        import av
    except ImportError:
        return
    memory, bt709 = io.BytesIO(), 1
    with av.open(memory, "w", format="mp4") as file:
        stream = file.add_stream("libx264", rate=Fraction(len(frames) / seconds).limit_denominator(1000))
        height, width = (n // 2 * 2 for n in frames[0].shape[:2])
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "16", "threads": "1"}  # one thread: the same bytes each time
        stream.codec_context.colorspace = stream.codec_context.color_primaries = stream.codec_context.color_trc = bt709
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(_on_white(frame)[:height, :width]), "rgb24")
            file.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))
        file.mux(stream.encode(None))
    write_bytes(path, memory.getvalue())


def _on_white(frame: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 3"]:
    alpha = frame[..., 3:].astype(float) / 255
    return np.rint(frame[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
