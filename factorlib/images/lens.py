"""Correction of a lens's radial distortion: every later stage works on the picture of a pinhole camera.

A ray of slopes (a, b) = (x, y)/z projects to centre + focal · (1 + k₁r² + k₂r⁴) (a, b), with r² = a² + b². This is
COLMAP's RADIAL model, and OpenCV's with two coefficients. The picture keeps its size, focal length and principal point.
"""

from pathlib import Path

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import map_coordinates

from factorlib.dataset.schema import Intrinsics
from factorlib.errors import InputError
from factorlib.images.photo import Photo


class RadialLens(msgspec.Struct, frozen=True):
    """Lens of one focal length, in pixels whose centres are at 0.5; coefficients are k₁ and k₂."""

    focal: float
    centre: tuple[float, float]
    coefficients: tuple[float, float]

    @property
    def colmap(self) -> pycolmap.Camera:
        """The lens as a camera of pycolmap."""
        width, height = (max(1, round(2 * c)) for c in self.centre)
        params = [self.focal, *self.centre, *self.coefficients]
        return pycolmap.Camera(model="RADIAL", width=width, height=height, params=params)

    def distort(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Map points of the pinhole picture to points of the photo."""
        slopes = (points - np.array(self.centre)) / self.focal
        return self.colmap.img_from_cam(np.column_stack([slopes, np.ones(len(slopes))]))

    def undistort(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Map points of the photo to points of the pinhole picture."""
        return self.focal * self.colmap.cam_from_img(points) + np.array(self.centre)

    def check(self, width: int, height: int, file: str | Path, key: str) -> None:
        """Check that the distortion is invertible within the picture.

        Args:
            width: Width of the picture.
            height: Height of the picture.
            file: File to name in the error.
            key: Key to name in the error.

        Raises:
            InputError: If two rays within the picture project to one point of the photo.
        """
        corners = np.array([[x, y] for x in (0, width) for y in (0, height)])
        r2 = np.square((corners - self.centre) / self.focal).sum(1).max() * np.linspace(0, 1, 100)
        k1, k2 = self.coefficients
        if (1 + 3 * k1 * r2 + 5 * k2 * r2**2 <= 0).any():
            raise InputError(
                f"k1 = {k1:g}, k2 = {k2:g} map two rays within the picture to one point of the photo",
                file=file,
                key=key,
                cure="give the coefficients of COLMAP's RADIAL or OpenCV's model for this focal length",
            )


def radial_lens(camera: Intrinsics | None, factor: int, width: int, height: int) -> RadialLens | None:
    """Return the lens of a photo that was downsampled; None if dataset.yaml gives no distortion.

    Args:
        camera: Intrinsics of the photo in dataset.yaml.
        factor: Factor of the downsampling.
        width: Width of the downsampled photo.
        height: Height of the downsampled photo.

    Returns:
        The lens, in pixels of the downsampled photo.
    """
    if camera is None or camera.distortion is None:
        return None
    assert camera.focal_px is not None  # the reader refuses distortion without it
    centre = camera.principal_point or (factor * width / 2, factor * height / 2)
    return RadialLens(camera.focal_px / factor, (centre[0] / factor, centre[1] / factor), camera.distortion)


class Undistortion:
    """Resampling of a photo to the picture of a pinhole camera, height × width pixels each.

    The attribute `inside` is the mask of pixels that the photo shows.
    """

    def __init__(self, lens: RadialLens, height: int, width: int):
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        place = lens.distort(np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(height, width, 2) - 0.5
        self.rows = place[..., 1]
        self.columns = place[..., 0]
        ends = ((self.rows, height), (self.columns, width))
        self.inside: Bool[np.ndarray, "h w"] = np.logical_and.reduce(
            [(places >= 0) & (places <= n - 1) for places, n in ends]
        )

    def resample_nearest(self, picture: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
        """Resample by the nearest pixels, 0 outside the photo."""
        y, x = (
            np.clip(np.rint(places), 0, n - 1).astype(int)
            for places, n in zip((self.rows, self.columns), picture.shape)
        )
        return np.where(self.inside, picture[y, x], np.zeros((), picture.dtype))

    def interpolate(self, picture: Shaped[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Resample by bilinear interpolation, 0 outside the photo."""
        return map_coordinates(picture.astype(np.float32), (self.rows, self.columns), order=1, cval=0.0)

    def photo(self, photo: Photo) -> Photo:
        """Resample a photo; a pixel is clipped if any of its four source pixels is, and finite if all are."""
        channels = range(3)
        radiance = np.stack([self.interpolate(photo.radiance[..., c]) for c in channels], axis=-1)
        clipped = np.stack([self.interpolate(photo.clipped[..., c]) > 1e-6 for c in channels], axis=-1)
        finite = self.inside & (self.interpolate(~photo.finite) < 1e-6)
        return msgspec.structs.replace(photo, radiance=radiance, clipped=clipped & finite[..., None], finite=finite)
