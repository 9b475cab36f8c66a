"""Pinhole camera of a photo and rigid poses: OpenCV axes, pixel centres at 0.5, as in COLMAP."""

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.spatial.transform import Rotation

ROTATION_ERROR = 1e-3  # greatest difference of RᵀR from the identity


class Camera(msgspec.Struct, frozen=True):
    """Pinhole camera (COLMAP's SIMPLE_PINHOLE), in pixels of the photo as displayed."""

    width: int
    height: int
    focal: float
    centre: tuple[float, float]  # principal point (x, y)

    def colmap(self) -> pycolmap.Camera:
        """Convert to a camera of pycolmap."""
        parameters = [self.focal, *self.centre]
        return pycolmap.Camera(model="SIMPLE_PINHOLE", width=self.width, height=self.height, params=parameters)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Project points in the camera frame, z > 0, to pixels."""
        return self.focal * points[..., :2] / points[..., 2:] + np.array(self.centre)

    def window(self, left: float, top: float, pixel: float, width: int, height: int) -> "Camera":
        """Return the camera of a part of the image, resampled.

        Args:
            left: Left edge of the part, pixels.
            top: Upper edge of the part, pixels.
            pixel: Size of a pixel of the part, in pixels of this camera.
            width: Width of the part, in its own pixels.
            height: Height of the part, in its own pixels.

        Returns:
            The camera.
        """
        centre = ((self.centre[0] - left) / pixel, (self.centre[1] - top) / pixel)
        return Camera(width, height, self.focal / pixel, centre)

    def rays(self, rows: slice = slice(None), columns: slice = slice(None)) -> Float[np.ndarray, "h w 3"]:
        """Return the directions through the pixel centres of some rows and columns, z = 1, camera frame."""
        x, y = np.meshgrid(np.arange(self.width)[columns] + 0.5, np.arange(self.height)[rows] + 0.5)
        return self.rays_through(np.stack([x, y], axis=-1))

    def rays_through(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Return the directions through image points (x, y), z = 1, camera frame."""
        rays = np.ones((*pixels.shape[:-1], 3))
        rays[..., :2] = (pixels - np.array(self.centre)) / self.focal
        return rays


class Pose(msgspec.Struct, frozen=True):
    """Rigid pose cam_from_object: x_cam = rotation · x_object + translation, in the mesh's units."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Transform points of the object frame to camera coordinates."""
        return points @ self.rotation.T + self.translation


def rotation_of_vector(vector: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return the rotation about `vector` by its length in radians."""
    return Rotation.from_rotvec(vector).as_matrix()


def angle_between(first: Float[np.ndarray, "3 3"], second: Float[np.ndarray, "3 3"]) -> float:
    """Return the angle of the rotation between two orientations, in degrees.

    >>> round(angle_between(np.eye(3), rotation_of_vector(np.array([0.0, 0.5, 0.0]))), 6)
    28.64789
    """
    return float(np.rad2deg(2 * np.arcsin(min(float(np.linalg.norm(first - second)) / 8**0.5, 1.0))))


def is_pose(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> bool:
    """Return whether all numbers are finite and the matrix is a rotation to within rounding.

    >>> is_pose(np.diag([1.0, 1.0, -1.0]), np.ones(3))
    False
    """
    finite = np.isfinite(rotation).all() and np.isfinite(translation).all()
    return bool(
        finite and np.abs(rotation.T @ rotation - np.eye(3)).max() < ROTATION_ERROR and np.linalg.det(rotation) > 0
    )
