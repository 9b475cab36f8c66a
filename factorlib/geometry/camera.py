"""The pinhole camera of a photo and rigid poses: OpenCV axes, pixel centres at 0.5, as in COLMAP."""

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.spatial.transform import Rotation

ROTATION_ERROR = 1e-3  # of RᵀR from the identity


class Camera(msgspec.Struct, frozen=True):
    """COLMAP's SIMPLE_PINHOLE, all in pixels of the photo as displayed."""

    width: int
    height: int
    focal: float
    centre: tuple[float, float]  # principal point

    def colmap(self) -> pycolmap.Camera:
        """The same camera as pycolmap's."""
        parameters = [self.focal, *self.centre]
        return pycolmap.Camera(model="SIMPLE_PINHOLE", width=self.width, height=self.height, params=parameters)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels of points in the camera frame, z > 0."""
        return self.focal * points[..., :2] / points[..., 2:] + np.array(self.centre)

    def window(self, left: float, top: float, pixel: float, width: int, height: int) -> "Camera":
        """The camera of a width × height image whose corner lies at (left, top) and whose pixels are `pixel` wide here."""
        centre = ((self.centre[0] - left) / pixel, (self.centre[1] - top) / pixel)
        return Camera(width, height, self.focal / pixel, centre)

    def rays(self, rows: slice = slice(None), columns: slice = slice(None)) -> Float[np.ndarray, "h w 3"]:
        """Directions through the pixel centres, z = 1, camera frame; of some rows and columns alone, where they are given."""
        x, y = np.meshgrid(np.arange(self.width)[columns] + 0.5, np.arange(self.height)[rows] + 0.5)
        return self.rays_through(np.stack([x, y], axis=-1))

    def rays_through(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Directions, z = 1, through image points (x, y)."""
        rays = np.ones((*pixels.shape[:-1], 3))
        rays[..., :2] = (pixels - np.array(self.centre)) / self.focal
        return rays


class Pose(msgspec.Struct, frozen=True):
    """cam_from_object: x_cam = rotation · x_object + translation, in the mesh's units."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points of the object frame in camera coordinates."""
        return points @ self.rotation.T + self.translation


def rotation_of_vector(vector: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Turn about `vector` by its length in radians."""
    return Rotation.from_rotvec(vector).as_matrix()


def angle_between(first: Float[np.ndarray, "3 3"], second: Float[np.ndarray, "3 3"]) -> float:
    """Angle in degrees of the turn between two rotations.

    >>> round(angle_between(np.eye(3), rotation_of_vector(np.array([0.0, 0.5, 0.0]))), 6)
    28.64789
    """
    return float(np.rad2deg(2 * np.arcsin(min(np.linalg.norm(first - second) / 8**0.5, 1.0))))


def is_pose(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> bool:
    """Finite, and a rotation to within rounding.

    >>> is_pose(np.diag([1.0, 1.0, -1.0]), np.ones(3))
    False
    """
    finite = np.isfinite(rotation).all() and np.isfinite(translation).all()
    return bool(
        finite and np.abs(rotation.T @ rotation - np.eye(3)).max() < ROTATION_ERROR and np.linalg.det(rotation) > 0
    )
