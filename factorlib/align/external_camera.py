"""The camera of an image in an external source (COLMAP, transforms.json, BOP), as the camera of the photo.

Both are the same picture, perhaps at another size.
"""

from __future__ import annotations

from factorlib.dataset.schema import ExternalCamera, Vec2
from factorlib.errors import InputError

MOST_ROUNDED_PX = 1.0  # a side of a picture made smaller is a whole number: its middle is off by half of this
INNER = 0.25, 0.75  # of a photo, in which its principal point lies


def focal_and_centre(external: ExternalCamera, width: int, height: int, photo: str) -> tuple[float, Vec2]:
    """Focal length and principal point in pixels of a photo of width × height, as displayed.

    Raises InputError where the photo is not the image at another size: it was cropped, turned or squeezed.
    """
    across, down = _scale(external, width, height, photo)
    centre = (
        (width / 2, height / 2)
        if external.principal_point is None
        else (external.principal_point[0] * across, external.principal_point[1] * down)
    )
    if external.size is None and not all(
        INNER[0] * side <= c <= INNER[1] * side for side, c in zip((width, height), centre)
    ):
        raise _refused(
            external, photo, f"its principal point ({centre[0]:.0f}, {centre[1]:.0f}) is far from the middle of the photo's {width}×{height} pixels",
            "give the photo at the size that the source was made of, or its camera in dataset.yaml (camera, and pose of its objects)",
        )  # fmt: skip
    return external.focal_px * (across if width >= height else down), centre


def _scale(external: ExternalCamera, width: int, height: int, photo: str) -> tuple[float, float]:
    """Photo pixels per image pixel, across and down: one number, but for the rounding of the photo's shorter side."""
    if external.size is None:
        return 1.0, 1.0
    if external.size[1] is None:
        return width / external.size[0], width / external.size[0]
    size = external.size
    if _is_resized(size, width, height):
        return width / size[0], height / size[1]
    found = f"the photo has {width}×{height} pixels, its image in the source {size[0]:g}×{size[1]:g}"
    if _is_resized(size[::-1], width, height):
        cure = "turn the photo's own pixels upright (ImageMagick: mogrify -auto-orient) and make the source of those"
        raise _refused(
            external, photo, f"{found}: it was made of the photo before its EXIF orientation was applied", cure
        )
    raise _refused(
        external,
        photo,
        f"{found}: it was cropped or squeezed",
        "give the image itself, or the same at another size, and masks of it",
    )


def _is_resized(size: tuple[float, float], width: int, height: int) -> bool:
    """By the longer side, to a pixel of the shorter one."""
    (long, short), (longer, shorter) = (size, (width, height)) if width >= height else (size[::-1], (height, width))
    return abs(short * longer / long - shorter) <= MOST_ROUNDED_PX


def _refused(external: ExternalCamera, photo: str, found: str, cure: str) -> InputError:
    return InputError(found, file="dataset.yaml", key=f"cameras.{external.source}: {photo}", cure=cure)
