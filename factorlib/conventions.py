"""Frames, directions and units: every convention of the project, defined once.

Camera frame  OpenCV: x right, y down, z forward; pixel centres at 0.5 as in COLMAP.  The viewer stands at −z,
              so the paper's "front" is (0, 0, −1).
Light frame   The camera frame turned y-up: x right, y up, z toward the viewer (`YUP_FROM_CAMERA`).  Lat-long map
OpenEXR's "LatLong Environment", shared by Mitsuba's `envmap`: top row +y, the image's centre +z,
              +x a quarter of the width from the left edge; texel (i, j) has its centre at ((i+½)/H, (j+½)/W).
Transforms    Named for their frames: `cam_from_object` takes object coordinates to camera coordinates.
Lobe          The paper's w · exp(−σ|ω−z|²) is a spherical Gaussian w · exp(λ(ω·z − 1)) of sharpness λ = 2σ.
Roughness     α = roughness².
"""

import numpy as np
from jaxtyping import Float

Vectors = Float[np.ndarray, "*n 3"]
FRONT = np.array([0.0, 0.0, -1.0])  # direction from the scene to the viewer, camera frame
YUP_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])  # a rotation by π about x, its own inverse


def lat_long_directions(height: int, width: int) -> Float[np.ndarray, "height width 3"]:
    """Return unit directions of the texel centres of a lat-long map, in the light (y-up) frame.

    >>> lat_long_directions(2, 4)[0].round(3).tolist()[0]
    [0.5, 0.707, -0.5]
    """
    theta = (np.arange(height) + 0.5) / height * np.pi  # from +y, down
    phi = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi  # about +y, from +z toward +x
    sin = np.sin(theta)[:, None]
    return np.stack(np.broadcast_arrays(sin * np.sin(phi), np.cos(theta)[:, None], sin * np.cos(phi)), axis=-1)


def lat_long_of_direction(direction: Float[np.ndarray, "*batch 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column of unit directions in the light frame, as fractions of height and width in [0, 1].

    >>> [float(t) for t in lat_long_of_direction(np.array([1.0, 0.0, 0.0]))]
    [0.5, 0.25]
    """
    x, y, z = np.moveaxis(np.asarray(direction, dtype=float), -1, 0)
    row = np.arctan2(np.hypot(x, z), y) / np.pi
    column = 0.5 - np.arctan2(x, z) / (2 * np.pi)
    return row, column


def lat_long_solid_angles(height: int, width: int) -> Float[np.ndarray, " height"]:
    """Return the exact solid angle of one texel of each row, steradians; height × width texels sum to 4π.

    >>> round(float(lat_long_solid_angles(8, 16).sum() * 16 / (4 * np.pi)), 12)
    1.0
    """
    edges = np.cos(np.arange(height + 1) / height * np.pi)
    return (edges[:-1] - edges[1:]) * 2 * np.pi / width


def half_of_normal_and_view(normal: Vectors, view: Vectors) -> Vectors:
    """Return the URM's `half` = (2(n·o)n − o + (0,0,−1)) / 2, as in the paper (not of unit length).

    >>> half_of_normal_and_view(FRONT, FRONT).tolist()
    [0.0, 0.0, -1.0]
    """
    cosine = np.sum(normal * view, axis=-1, keepdims=True)
    return (2 * cosine * normal - view + FRONT) / 2
