"""Reader of photos: linear radiance, clipped channels, finite pixels, and EXIF data.

Orientation   as displayed: the EXIF orientation is applied.
Colours       those of the file's profile; without one, integers are sRGB-encoded, float and raw files linear, and
              primaries are Rec. 709's. `encoding` replaces the curve, not the primaries.
Channels      one channel is grey; alpha is read by itself.
Clipped       integer codes from `scanlines.CLIPPED` of the range (254 of 255) on, and channels that the primaries mix
              such a code into; for a raw file, saturated sensor pixels. A float file has no top code; values that are
              not finite are invalid pixels.
Size          a photo can be downsampled by a whole factor f while it is read, so that only some rows of it are in
              memory at a time: radiance by its linear mean; clipped if any part is; finite if any part is. Every pixel
              of the smaller picture is a box of f × f pixels. A whole factor is exact: each pixel belongs to one box,
              so a box has one mean, and its pixels have whole votes. Boxes count from the upper left corner of the
              displayed picture. The remainder at the right and at the bottom, fewer than f pixels, is dropped. So all
              boxes are whole, and a point (x, y) of the photo is exactly (x/f, y/f) of the smaller picture.
"""

from collections.abc import Callable, Iterator
from math import isqrt
from pathlib import Path

import msgspec
import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Float, Shaped, UInt16

from factorlib.errors import InputError
from factorlib.images.camera_files import is_heif, is_raw, open_heif, open_raw
from factorlib.images.colour_space import ColourSpace
from factorlib.images.exif import exif_exposure, exif_focal_px
from factorlib.images.scanlines import OpenPhoto, open_scanlines
from factorlib.images.tone import DECODERS
from factorlib.reading import reading

READ_AT_ONCE = 1 << 21  # number of pixels that are in memory as floats
OPAQUE = 65535  # alpha of an opaque pixel
VOTED_AT_ONCE = 1 << 21  # number of pixels of a strip


class Photo(msgspec.Struct, frozen=True):
    """Photo as linear radiance.

    radiance   linear Rec. 709, scene-referred up to exposure, 0 where not finite
    clipped    True at the top code or above
    finite     True if all three channels are numbers
    focal_px   focal length from EXIF, in pixels of `radiance` as displayed
    width      width of `radiance`
    height     height of `radiance`
    encoding   curve of the file, as given or stated: "srgb", "linear", "gamma2.2", or "profile" for others
    factor     a pixel of `radiance` stands for factor² pixels of the file
    exposure   t·S/N² from EXIF
    """

    radiance: Float[np.ndarray, "h w 3"]
    clipped: Bool[np.ndarray, "h w 3"]
    finite: Bool[np.ndarray, "h w"]
    focal_px: float | None
    width: int
    height: int
    encoding: str
    factor: int = 1
    exposure: float | None = None


def open_photo(path: str | Path, key: str | None = None) -> OpenPhoto:
    """Open a photo (JPEG, PNG, TIFF, EXR, HDR, HEIC, DNG or raw) and read its header, not its pixels.

    The format is determined by the contents: a DNG is a TIFF whose first picture is a small preview.

    Args:
        path: File.
        key: Key to name in errors.

    Returns:
        The open photo.

    Raises:
        InputError: If the file is unreadable, or has neither grey nor RGB.
    """
    with reading("an image", path, key):
        if is_heif(path):
            return open_heif(path, key)
        return open_raw(path, key) if is_raw(path) else open_scanlines(path, key)


def read_photo(path: str | Path, encoding: str | None = None, key: str | None = None) -> Photo:
    """Read a photo as displayed, at full resolution.

    Args:
        path: File.
        encoding: "srgb", "linear" or "gamma2.2"; None takes what the file states.
        key: Key to name in errors.

    Returns:
        The photo.

    Raises:
        InputError: As `open_photo` does, and if the file is truncated.
    """
    return decode_photo(open_photo(path, key), encoding, 1, path)


def read_alpha(path: Path) -> UInt16[np.ndarray, "h w"] | None:
    """Return the alpha channel of a PNG or a TIFF as displayed, 0 to `OPAQUE`; None for a file without one."""
    if path.suffix.lower() not in (".png", ".tif", ".tiff"):
        return None
    image = oiio.ImageBuf(str(path))
    channel = image.spec().alpha_channel
    if channel < 0:
        return None
    alpha = oiio.ImageBufAlgo.reorient(oiio.ImageBufAlgo.channels(image, (channel,)))
    return np.asarray(alpha.get_pixels(oiio.UINT16))[..., 0]


def check_bright(photo: Photo, mask: Bool[np.ndarray, "h w"], path: str | Path, key: str | None = None) -> None:
    """Check that some finite pixel of a region has positive radiance.

    Args:
        photo: The photo.
        mask: Mask of the region.
        path: File to name in the error.
        key: Key to name in the error.

    Raises:
        InputError: If all pixels are black or negative.
    """
    if not (photo.radiance[mask & photo.finite] > 0).any():
        raise InputError(
            "every pixel in its mask is black, or less than 0",
            file=path,
            key=key,
            cure="expose, render or develop it again (its exposure or a sign may be wrong), or remove the photo",
        )


def decode_photo(
    opened: OpenPhoto,
    encoding: str | None,
    factor: int,
    path: str | Path,
    look: Callable[[Float[np.ndarray, "r w 3"]], None] = lambda linear: None,
) -> Photo:
    """Decode an open photo as displayed, downsampled by `factor`.

    Args:
        opened: The open photo.
        encoding: Encoding of its values; None takes what the file states.
        factor: Factor of the downsampling.
        path: File to name in warnings.
        look: Called with the linear values of the file, some rows at a time, before they are averaged.
    """
    space = opened.space if encoding is None else ColourSpace((DECODERS[encoding],) * 3, opened.space.to_rec709)
    height, width = (n // factor for n in (opened.height, opened.width))
    radiance = np.empty((height, width, 3), np.float32)
    clipped = np.empty((height, width, 3), bool)
    finite = np.empty((height, width), bool)
    for rows, codes, cut in _strips(opened, factor, path):
        linear = space.linear(codes, opened.white)
        look(linear)
        numbers = np.logical_and.reduce(np.isfinite(linear), -1)
        linear[~numbers] = 0
        radiance[rows], finite[rows] = box_mean(linear, numbers, factor) if factor > 1 else (linear, numbers)
        clipped[rows] = box_any(space.clipped(cut), factor)
    radiance, clipped, finite = (_orient(pixels, opened.orientation) for pixels in (radiance, clipped, finite))
    focal_px = exif_focal_px(opened.exif, opened.width, opened.height, path)
    return Photo(
        radiance,
        clipped,
        finite,
        focal_px and focal_px / factor,
        finite.shape[1],
        finite.shape[0],
        space.encoding,
        factor,
        exif_exposure(opened.exif),
    )


def _orient(pixels: Shaped[np.ndarray, "h w *c"], orientation: int) -> Shaped[np.ndarray, "i j *c"]:
    """Rotate and mirror stored pixels as their EXIF orientation demands."""
    rows, columns = (-1 if flip else 1 for flip in _reversed_axes(orientation))
    return np.ascontiguousarray((pixels.swapaxes(0, 1) if orientation >= 5 else pixels)[::rows, ::columns])


def _strips(
    opened: OpenPhoto, factor: int, path: str | Path
) -> Iterator[tuple[slice, Shaped[np.ndarray, "r w 3"], Bool[np.ndarray, "r w 3"]]]:
    """Yield whole rows of boxes, some at a time: indices of the rows, the codes in them, and their clipped values.

    Boxes count from the displayed corner, so the remainder is at the other end of an axis that display reverses.
    """
    flips = _reversed_axes(opened.orientation)
    turned = flips[::-1] if opened.orientation >= 5 else flips
    top, left = (n % factor if reversed_axis else 0 for n, reversed_axis in zip((opened.height, opened.width), turned))
    columns = slice(left, left + opened.width // factor * factor)
    height = opened.height // factor
    step = max(1, READ_AT_ONCE // (factor * opened.width))
    with reading("an image", path):
        for first in range(0, height, step):
            last = min(first + step, height)
            begin = top + first * factor
            end = top + last * factor
            codes = opened.rows(begin, end)
            yield slice(first, last), codes[:, columns], opened.clipped(begin, end, codes)[:, columns]
        if end < opened.height:
            opened.rows(end, opened.height)  # a file that is truncated in the remainder must raise too


def _reversed_axes(orientation: int) -> tuple[bool, bool]:
    """Return whether display reverses the rows, and the columns, after orientations 5 to 8 have swapped them."""
    return orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)


def least_factor(pixels: int, most: int) -> int:
    """Return the least f with pixels / f² ≤ most; 1 for no pixels.

    >>> [least_factor(pixels, 100) for pixels in (0, 100, 101, 400, 401)]
    [1, 1, 2, 2, 3]
    """
    return isqrt(max(-(-pixels // most) - 1, 0)) + 1


def whole_boxes(picture: Shaped[np.ndarray, "h w *c"], factor: int) -> Shaped[np.ndarray, "i f j f *c"]:
    """Return a view of the picture by rows of boxes, rows of a box, columns of boxes and columns of a box.

    The remainder is dropped.
    """
    rows, columns = (n // factor for n in picture.shape[:2])
    inner = picture[: rows * factor, : columns * factor]
    return inner.reshape(rows, factor, columns, factor, *picture.shape[2:])


def box_sum(
    picture: Shaped[np.ndarray, "h w *c"], factor: int, kind: type = np.float64
) -> Shaped[np.ndarray, "i j *c"]:
    """Sum a picture over boxes of factor × factor pixels.

    Args:
        picture: Picture.
        factor: Side of a box.
        kind: Type of the sums.

    Returns:
        A picture of sums.
    """
    return whole_boxes(picture, factor).sum(1, dtype=kind).sum(2, dtype=kind)


def box_mean(
    radiance: Float[np.ndarray, "h w 3"], finite: Bool[np.ndarray, "h w"], factor: int
) -> tuple[Float[np.ndarray, "i j 3"], Bool[np.ndarray, "i j"]]:
    """Average the finite pixels of each box.

    Sums are float64: the mean of equal values is that value.

    Args:
        radiance: Radiance, 0 where it is not finite.
        finite: Mask of finite pixels.
        factor: Side of a box.

    Returns:
        Means, 0 for boxes without a finite pixel, and a mask of the boxes with one.
    """
    count = box_sum(finite, factor, np.int64)
    return (box_sum(radiance, factor) / np.maximum(count, 1)[..., None]).astype(np.float32), count > 0


def box_any(flags: Bool[np.ndarray, "h w *c"], factor: int) -> Bool[np.ndarray, "i j *c"]:
    """Return a mask of the boxes in which any pixel is set."""
    return np.logical_or.reduce(np.logical_or.reduce(whole_boxes(flags, factor), axis=1), axis=2)


def box_majority(values: Shaped[np.ndarray, "h w"], factor: int) -> Shaped[np.ndarray, "i j"]:
    """Return the most frequent value of each box.

    If two values are equally frequent, boxes alternate between the smaller and the larger one like a chessboard. So
    outlines neither grow, nor shrink, nor move.

    >>> box_majority(np.array([[0, 0, 1, 1], [0, 1, 0, 0], [2, 2, 0, 1], [0, 0, 1, 0]]), 2).tolist()
    [[0, 1], [2, 0]]
    """
    if factor == 1:
        return values
    rows, columns = (n // factor for n in values.shape)
    result = np.empty((rows, columns), values.dtype)
    step = max(1, VOTED_AT_ONCE // (factor * values.shape[1]))
    for first in range(0, rows, step):
        last = min(first + step, rows)
        strip = values[first * factor : last * factor]
        candidates = np.unique(strip)  # ascending
        smallest = np.full((last - first, columns), candidates[0])
        largest = smallest.copy()
        most = np.zeros(smallest.shape, np.int64)
        # smallest and largest of the most frequent values of each box
        for value in candidates:
            votes = box_sum(strip == value, factor, np.int64)
            smallest[votes > most] = value
            largest[votes >= most] = value
            most = np.maximum(votes, most)
        odd = np.add.outer(np.arange(first, last), np.arange(columns)) % 2
        result[first:last] = np.where(odd, largest, smallest)
    return result
