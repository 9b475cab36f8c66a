"""A path-traced picture with coverage, its display and its files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from factorlib.images.exr import write_exr
from factorlib.images.picture import exposure_of, picture, write_png

Radiance = Float[np.ndarray, "h w 3"]
Tone = Callable[[Radiance], Radiance]


def as_it_is(radiance: Radiance) -> Radiance:
    """Return the radiance unchanged: the tone curve of a photo that has none."""
    return radiance


class TracedPicture(msgspec.Struct, frozen=True):
    """A path-traced picture.

    Attributes:
        pixels: linear Rec. 709 radiance times coverage, and coverage, the share of a pixel that is filled
        tone: tone curve of the photo
    """

    pixels: Float[np.ndarray, "h w 4"]
    tone: Tone = as_it_is

    @property
    def coverage(self) -> Float[np.ndarray, "h w 1"]:
        """The share of each pixel that is covered, in [0, 1]."""
        return np.clip(self.pixels[..., 3:], 0, 1)

    @property
    def toned(self) -> Radiance:
        """The radiance after the tone curve, with coverage divided out."""
        share = self.pixels[..., 3:]
        return self.tone(self.pixels[..., :3] / np.where(share > 0, share, 1))

    @property
    def exposure(self) -> float:
        """The display exposure for the covered pixels."""
        return exposure_of(self.toned, self.pixels[..., 3] > 0.5)

    def exposed(self) -> TracedPicture:
        """Return the picture times its own exposure, without a tone curve."""
        return TracedPicture(self.pixels * np.array([self.exposure] * 3 + [1.0]))

    def over(self, photo: Radiance) -> Radiance:
        """Composite the picture, after its tone curve, over a photo."""
        return (1 - self.coverage) * photo + self.coverage * self.toned

    def rgba(self, exposure: float = 1.0) -> UInt8[np.ndarray, "h w 4"]:
        """Return 8-bit sRGB with coverage as alpha."""
        return np.concatenate([picture(self.toned, exposure), np.rint(255 * self.coverage).astype(np.uint8)], axis=-1)

    def to_exr(self, path: str | Path) -> None:
        """Write linear radiance times coverage, and coverage as channel A."""
        write_exr(path, {channel: self.pixels[..., k] for k, channel in enumerate("RGBA")})

    def to_png(self, path: str | Path, exposure: float = 1.0) -> None:
        """Write `rgba` as a PNG; exposure 1 is the photo's."""
        write_png(path, self.rgba(exposure))
