"""The pose from points that the user names in photo and mesh, by COLMAP's robust absolute pose (LO-RANSAC over P3P, or P4Pf
where the focal length is sought too), then refined.  Points named wrongly are outliers, as long as enough agree.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Float

from factorlib.align.refine import FocalPrior
from factorlib.align.state import State, state_of
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster

MOST_ERROR = 0.015  # of the photo's longer side, from a point named in the photo to the mesh's: more is a mistake
LEAST_AGREEING = 4  # three have up to four poses
LEAST_FOR_FOCAL = 6  # so many also tell the focal length
FOCALS = (0.4, 10.0)  # of the longer side: what else comes out is not believed


class Keypoints(msgspec.Struct, frozen=True):
    """pixel [n, 2] (x right, y down, pixel centres at 0.5) shows point [n, 3] of the mesh, in its own frame and units."""

    pixel: Float[np.ndarray, "n 2"]
    point: Float[np.ndarray, "n 3"]


def state_of_keypoints(
    keypoints: Keypoints, caster: Caster, camera: Camera, prior: FocalPrior, photo: str, name: str
) -> State:
    """The state in which most keypoints agree.  Raises InputError where fewer than LEAST_AGREEING do.

    camera: its focal length is the prior's; it is replaced only where nothing was known and LEAST_FOR_FOCAL are given.
    """
    side, points = max(camera.width, camera.height), (keypoints.point - caster.centre) / caster.radius
    estimation, refinement = pycolmap.AbsolutePoseEstimationOptions(), pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.max_error, estimation.ransac.random_seed = MOST_ERROR * side, 0
    sought = prior.sigma > 0 and len(keypoints.pixel) >= LEAST_FOR_FOCAL
    for free in (True, False) if sought else (False,):
        estimation.estimate_focal_length = refinement.refine_focal_length = free
        colmap = camera.colmap()  # gets the focal length
        found = pycolmap.estimate_and_refine_absolute_pose(keypoints.pixel, points, colmap, estimation, refinement)
        agreeing = found["num_inliers"] if found else 0
        if agreeing >= LEAST_AGREEING and FOCALS[0] * side <= colmap.focal_length <= FOCALS[1] * side:
            rotation = found["cam_from_world"].rotation.matrix()
            pose = Pose(rotation, caster.radius * found["cam_from_world"].translation - rotation @ caster.centre)
            return state_of(pose, msgspec.structs.replace(camera, focal=float(colmap.focal_length)), caster)
    raise InputError(
        f"only {agreeing} of the {len(keypoints.pixel)} keypoints of '{name}' agree on a pose", file="dataset.yaml", key=f"{photo}.{name}.keypoints",
        cure=f"at least {LEAST_AGREEING} must, within {MOST_ERROR:.1%} of the photo's longer side: is each pixel (x, y) beside its own point?",
    )  # fmt: skip
