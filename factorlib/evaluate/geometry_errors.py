"""Errors of normals and poses.

Normals  Angle between estimated and true normal over the pixels where both are known; null: every normal faces the
         camera.
Poses    Geodesic angle of rotation_estimateᵀ · rotation_truth, and the distance of the translations relative to the
         true distance from the camera.  The null is a random rotation, with a mean error of 126.5° (90° + 114.6° / π).
         A symmetric shape can have a large rotation error and yet match every pixel; the normals show it.
"""

import numpy as np
from jaxtyping import Bool, Float

from factorlib.conventions import FRONT
from factorlib.dataset.schema import RigidTransform
from factorlib.images.photo import box_sum
from factorlib.results.metrics import AngleError, NormalError, PoseError
from factorlib.results.poses import PoseEntry

RANDOM_ROTATION_DEG = float(np.degrees(np.pi / 2 + 2 / np.pi))


def normal_error(
    estimate: Float[np.ndarray, "h w 3"], truth: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> NormalError | None:
    """Return the errors over the pixels of `mask` where both normals are known (not zero); None if there are none.

    Args:
        estimate: estimated unit normals, zero where unknown
        truth: true unit normals, zero where unknown
        mask: pixels to compare
    """
    known = mask & (np.linalg.norm(estimate, axis=-1) > 0.5) & (np.linalg.norm(truth, axis=-1) > 0.5)
    if not known.any():
        return None
    facing = np.broadcast_to(FRONT, truth[known].shape)
    return NormalError(int(known.sum()), _summary(estimate[known], truth[known]), _summary(facing, truth[known]))


def averaged_normals(normal: Float[np.ndarray, "h w 3"], factor: int) -> Float[np.ndarray, "i j 3"]:
    """Return unit mean normals of boxes of factor × factor pixels; zero where under half of a box is known."""
    if factor == 1:
        return normal
    known = np.linalg.norm(normal, axis=-1) > 0.5
    mean = box_sum(np.where(known[..., None], normal, 0), factor)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    enough = (2 * box_sum(known, factor, np.int64) >= factor**2)[..., None] & (length > 0)
    return np.where(enough, mean / np.where(enough, length, 1), 0)


def angles_deg(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the angles between vectors of any length, in degrees, accurate for small angles too.

    >>> angles_deg(np.array([[1.0, 0, 0]]), np.array([[0, 2.0, 0]])).tolist()
    [90.0]
    """
    a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (a, b))
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def pose_error(estimate: PoseEntry | RigidTransform, truth: RigidTransform) -> PoseError:
    """Return the difference of two cam_from_object; the translations are in one unit."""
    moved = np.linalg.norm(np.subtract(estimate.translation, truth.translation))
    distance = float(np.linalg.norm(truth.translation)) or 1.0
    chord = np.linalg.norm(np.subtract(estimate.rotation, truth.rotation))  # 2√2 sin(angle / 2)
    turned = np.degrees(2 * np.arcsin(min(1.0, chord / (2 * np.sqrt(2)))))
    return PoseError(float(turned), float(moved) / distance, RANDOM_ROTATION_DEG)


def _summary(a: np.ndarray, b: np.ndarray) -> AngleError:
    angles = angles_deg(a.astype(float), b.astype(float))
    return AngleError(*(round(float(np.percentile(angles, q)), 6) for q in (50, 90)))
