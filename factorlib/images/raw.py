"""Reader of raw photos (DNG and cameras' formats), developed by LibRaw.

The result is linear, with the camera's white balance, Rec. 709, without automatic brightness.

Red, green and blue of the result are mixed from those of the sensor, each of which is interpolated from the pixels
around. If one of these has reached the sensor's white level, all three channels of the result are clipped.

The picture is cropped as the file specifies (DNG's DefaultCrop), as other programs show it. It is developed at once:
about 800 MB for 48 megapixels.
"""

from functools import cache
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter

from factorlib.dataset.schema import RAW
from factorlib.errors import InputError
from factorlib.images.exif import read_exif
from factorlib.images.scanlines import CLIPPED, OpenPhoto

ORIENTATION = {0: 1, 3: 3, 5: 8, 6: 6}  # EXIF's orientation for LibRaw's `flip`
AROUND = 5  # side of the square from which demosaicing interpolates a pixel
WHITE = 2**16 - 1
TAGS = ("ExposureTime", "FNumber", "Exif:PhotographicSensitivity", "Exif:FocalLength")


def is_raw(path: str | Path) -> bool:
    """Return whether the suffix is that of a raw file, or the file is a DNG, whose first picture is only a preview."""
    return Path(path).suffix.lower() in RAW or "DNG" in read_exif(path)


def open_raw(path: str | Path, key: str | None) -> OpenPhoto:
    """Open a raw photo.

    Raises:
        InputError: If LibRaw cannot read the file.
    """

    def refused(fault: str, error: Exception) -> InputError:
        """Return an InputError for this file."""
        text = error.args[0] if error.args else error
        words = text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)
        cure = f"develop it: darktable-cli {Path(path).name} {Path(path).stem}.tif"
        return InputError(f"{fault} ({words})", file=path, key=key, cure=cure)

    try:
        import rawpy
    except ImportError as error:
        raise refused("raw photos are read by rawpy, which cannot be imported", error) from None
    try:
        sensor = rawpy.imread(str(path))
        sizes = sensor.sizes
        other = sensor.other
    except rawpy.LibRawError as error:
        raise refused("not readable as a raw photo", error) from None
    # crop that the file specifies, in developed pixels; the whole picture if it specifies none
    top, left = sizes.crop_top_margin - sizes.top_margin, sizes.crop_left_margin - sizes.left_margin
    height, width = sizes.crop_height, sizes.crop_width
    inside = top + height <= sizes.iheight and left + width <= sizes.iwidth
    if not (min(top, left) >= 0 < min(height, width) and inside):
        top, left, height, width = 0, 0, sizes.iheight, sizes.iwidth
    inner = slice(top, top + height), slice(left, left + width)
    camera = other.shutter_speed, other.aperture, other.iso_speed, other.focal_length  # for files other than TIFF

    @cache
    def developed() -> tuple[np.ndarray, np.ndarray]:
        """Return 16-bit linear codes, not rotated, and a mask of saturated pixels.

        The sensor's white level is the top code of its least amplified channel.
        """
        with sensor:
            try:
                pixels = sensor.postprocess(
                    output_bps=16,
                    gamma=(1, 1),
                    no_auto_bright=True,
                    use_camera_wb=True,
                    output_color=rawpy.ColorSpace.sRGB,
                    adjust_maximum_thr=0.0,
                    user_flip=0,
                )
            except rawpy.LibRawError as error:
                raise refused("cannot be developed", error) from None
            # developed pixels for which some contributing sensor pixel has reached the white level
            levels = [level for level in (sensor.camera_white_level_per_channel or []) if level > 0]
            full = sensor.raw_image_visible >= CLIPPED * min([sensor.white_level, *levels])
            full = np.logical_or.reduce(full, axis=2) if full.ndim == 3 else maximum_filter(full, size=AROUND)
            return pixels[inner], full[inner]

    return OpenPhoto(
        width=width,
        height=height,
        orientation=ORIENTATION.get(sizes.flip, 1),
        exif={**dict(zip(TAGS, camera)), **read_exif(path)},
        white=WHITE,
        encoding="linear",
        rows=lambda begin, end: developed()[0][begin:end],
        saturated=lambda begin, end: np.repeat(developed()[1][begin:end, :, None], 3, axis=2),
    )
