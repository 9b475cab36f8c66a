"""Pictures of predictions, for people: 8-bit sRGB, the truth's exposure, white where there is no body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from factorlib.evaluate.picture import white_of
from factorlib.images.picture import picture
from studies.core.baselines.body import Seen
from studies.core.baselines.scene import Radiance
from studies.core.baselines.score import Shot

INK = (27, 29, 33)
LEFT, TOP, GAP, LETTERS, LEAST = 150, 44, 6, 13, 96  # pixels; the last: across a picture, smaller ones are enlarged

Pixels = UInt8[np.ndarray, "h w 3"]


def shown(shot: Shot) -> tuple[Pixels, Pixels]:
    """The truth and the prediction."""
    return tuple(_of(shot.seen, radiance, shot.white) for radiance in (shot.truth, shot.predicted))


def photo(seen: Seen, radiance: Radiance) -> Pixels:
    """A photo, exposed for itself."""
    return _of(seen, radiance, white_of(seen.picture(radiance), seen.inside))


def _of(seen: Seen, radiance: Radiance, white: float) -> Pixels:
    pixels = picture(seen.picture(np.maximum(radiance, 0)), 1 / white)
    pixels[~seen.inside] = 255
    return pixels


def sheet(rows: Sequence[tuple[str, Sequence[Pixels | None]]], columns: Sequence[str]) -> Pixels:
    """Rows of equally large pictures under the columns' names (two lines at most); None: nothing is there."""
    across = next(len(cell) for _, cells in rows for cell in cells if cell is not None)
    size = across * max(1, LEAST // across)
    step = size + GAP
    canvas = Image.new("RGB", (LEFT + step * len(columns), TOP + step * len(rows)), (255, 255, 255))
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(LETTERS)
    for k, name in enumerate(columns):
        draw.multiline_text((LEFT + k * step + size / 2, TOP - 4), name, INK, font, anchor="md", align="center")
    for r, (label, cells) in enumerate(rows):
        draw.text((LEFT - 10, TOP + r * step + size / 2), label, INK, font, anchor="rm")
        for k, cell in enumerate(cells):
            at = (LEFT + k * step, TOP + r * step)
            if cell is None:
                draw.text((at[0] + size / 2, at[1] + size / 2), "none", INK, font, anchor="mm")
            else:
                canvas.paste(Image.fromarray(np.asarray(cell)).resize((size, size), Image.Resampling.NEAREST), at)
    return np.asarray(canvas)
