"""Placement of all objects of one photo: given poses are used, the others are searched, with one camera for all."""

import logging
from collections.abc import Sequence

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from factorlib.align.refine import FocalPrior
from factorlib.align.search import Found, Report, RunnerUp, Search, after, find, focal_prior, found_near, refined_finest
from factorlib.align.silhouette import Silhouette, labelled_iou
from factorlib.align.state import State, state_of
from factorlib.align.target import target_of
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, rasterise
from factorlib.results.poses import AS_IT_IS, CameraEntry, ObjectPose

WELL_FOUND = 0.9  # least score of a pose that can judge EXIF's focal length
CLEARLY_BETTER = 0.01  # lead in score that another focal length needs over EXIF's
MOST_ERROR = 0.015  # greatest reprojection error of a keypoint, as a share of the photo's longer side
LEAST_AGREEING = 4  # least number of keypoints that agree; three have up to four poses
LEAST_FOR_FOCAL = 6  # least number of keypoints that determine the focal length too
FOCALS = (0.4, 10.0)  # range of plausible focal lengths in units of the photo's longer side
log = logging.getLogger("factorlib.align")


class KnownFocal(msgspec.Struct, frozen=True):
    """Prior knowledge of the focal length in photo pixels; None where nothing is known.

    source: dataset | colmap | transforms | bop | exif
    """

    focal: float | None = None
    source: str | None = None


class Keypoints(msgspec.Struct, frozen=True):
    """Correspondences of pixels and points of the mesh.

    pixel   [n, 2], x right, y down, pixel centres at 0.5
    point   [n, 3], in the mesh's frame and units
    """

    pixel: Float[np.ndarray, "n 2"]
    point: Float[np.ndarray, "n 3"]


class ObjectToPlace(msgspec.Struct, frozen=True):
    """Object to place: its mesh, its mask, and its pose as far as the user or an earlier result gives it."""

    name: str
    caster: Caster
    silhouette: Silhouette
    pose: Pose | None = None
    keypoints: Keypoints | None = None
    earlier: ObjectPose | None = None
    scale: tuple[float, float, float] = AS_IT_IS  # factors of the caster's mesh against the file's


class Placed(msgspec.Struct, frozen=True):
    """Camera of the photo with its focal length, its source and standard error (log), and the pose of each object."""

    camera: Camera
    focal_source: str  # dataset | colmap | transforms | bop | exif | estimated
    log_focal_sigma: float
    poses: list[Pose]
    found: list[Found | None]  # None for a given pose
    prior: FocalPrior  # prior of the focal length, before alignment


def placed(
    objects: Sequence[ObjectToPlace],
    camera: Camera,
    known: KnownFocal,
    photo: str,
    search: Search = Search(),
    before: CameraEntry | None = None,
    report: Report = lambda done: None,
) -> Placed:
    """Estimate the poses of all objects of a photo.

    The focal length, where neither `known` nor `before` gives it, is estimated with the object that covers most pixels.

    Args:
        objects: The objects.
        camera: The photo's camera; its focal length is not used.
        known: Prior knowledge of the focal length.
        photo: Name of the photo.
        search: Effort of the search.
        before: Camera of an earlier result, in pixels of this photo.
        report: Function called now and then with the number of objects that are done, fractions included.

    Returns:
        The camera and the poses.

    Raises:
        InputError: If the mask of an object to search has no pixel, or if its keypoints do not agree.
    """
    source = known.source
    sigma = 0.0
    found = {}
    prior = beforehand = focal_prior(known.focal, source, camera.width, camera.height)
    if before is not None:
        prior = FocalPrior(before.focal_px, 0.0)
        source = before.focal_source
        sigma = before.focal_relative_stderr
    camera = msgspec.structs.replace(camera, focal=prior.focal)
    if prior.sigma > 0 and any(each.pose is not None for each in objects):
        camera = _focal_of_given(objects, camera)
        source = "estimated"
        prior = FocalPrior(camera.focal, 0.0)
    most_first = sorted(range(len(objects)), key=lambda k: (-int(objects[k].silhouette.inside.sum()), k))
    for done, k in enumerate(most_first):
        report(done)
        obj = objects[k]
        if obj.pose is not None:
            continue
        if not obj.silhouette.inside.any():
            cure = "remove the object from this photo, or check its mask and materials"
            fault = f"no pixel of the mask shows object {obj.name!r}"
            raise InputError(fault, file="dataset.yaml", key=photo, cure=cure)
        if obj.earlier is not None:  # keep the earlier pose and its runner-up; compute the score again
            start = state_of(obj.earlier.pose, camera, obj.caster)
            known_camera = FocalPrior(camera.focal, 0.0)
            score = refined_finest(obj.caster, obj.silhouette, camera, start, known_camera, search, 0).score
            second = None
            if (other := obj.earlier.runner_up) is not None:
                state = state_of(other.pose, camera, obj.caster)
                second = RunnerUp(state, other.score, other.normal_difference_deg)
            found[k] = Found(start, score, sigma, second, earlier=True)
        elif obj.keypoints is None:
            found[k] = find(obj.caster, obj.silhouette, camera, prior, search, after(done, report))
        else:
            start = state_of_keypoints(obj, camera, prior, photo)
            found[k] = found_near(obj.caster, obj.silhouette, camera, start, prior, search)
        if prior.sigma > 0:
            if source == "exif":
                found[k], source = _judged(obj, camera, found[k], photo, search)
            else:
                source = "estimated"
            sigma = found[k].log_focal_sigma
            camera = found[k].state.camera(camera)
            prior = FocalPrior(camera.focal, 0.0)
    # given and earlier poses are kept to the last digit
    poses = [
        obj.pose or (obj.earlier.pose if obj.earlier else found[k].state.pose(obj.caster))
        for k, obj in enumerate(objects)
    ]
    return Placed(camera, source or "estimated", sigma, poses, [found.get(k) for k in range(len(objects))], beforehand)


def state_of_keypoints(obj: ObjectToPlace, camera: Camera, prior: FocalPrior, photo: str) -> State:
    """Return the state in which most keypoints of `obj` agree.

    It is COLMAP's robust absolute pose (LO-RANSAC over P3P, or over P4Pf with an unknown focal length), then refined.
    Wrong keypoints are outliers as long as enough of the others agree.

    Args:
        obj: Object with keypoints.
        camera: The photo's camera with the prior's focal length. The length is estimated too if it is not exactly known
            and there are LEAST_FOR_FOCAL keypoints.
        prior: Prior of the focal length.
        photo: Name of the photo.

    Returns:
        The state.

    Raises:
        InputError: If fewer than LEAST_AGREEING keypoints agree.
    """
    keypoints = obj.keypoints
    caster = obj.caster
    assert keypoints is not None
    side = max(camera.width, camera.height)
    points = (keypoints.point - caster.centre) / caster.radius
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.max_error = MOST_ERROR * side
    estimation.ransac.random_seed = 0
    # first with an unknown focal length, if there are enough keypoints, then with the known one
    sought = prior.sigma > 0 and len(keypoints.pixel) >= LEAST_FOR_FOCAL
    for free in (True, False) if sought else (False,):
        estimation.estimate_focal_length = refinement.refine_focal_length = free
        colmap = camera.colmap()  # pycolmap writes the estimated focal length into it
        found = pycolmap.estimate_and_refine_absolute_pose(keypoints.pixel, points, colmap, estimation, refinement)
        agreeing = found["num_inliers"] if found else 0
        if found and agreeing >= LEAST_AGREEING and FOCALS[0] * side <= colmap.focal_length <= FOCALS[1] * side:
            rotation = found["cam_from_world"].rotation.matrix()
            pose = Pose(rotation, caster.radius * found["cam_from_world"].translation - rotation @ caster.centre)
            return state_of(pose, msgspec.structs.replace(camera, focal=float(colmap.focal_length)), caster)
    raise InputError(
        f"only {agreeing} of the {len(keypoints.pixel)} keypoints of '{obj.name}' agree on a pose",
        file="dataset.yaml",
        key=f"{photo}.{obj.name}.keypoints",
        cure=f"at least {LEAST_AGREEING} must, within {MOST_ERROR:.1%} of the photo's longer side: is each pixel (x, "
        "y) beside its own point?",
    )


def _judged(obj: ObjectToPlace, camera: Camera, found: Found, photo: str, search: Search) -> tuple[Found, str]:
    """Decide between EXIF's focal length and an estimated one; return the pose and the source of the length.

    EXIF's length is replaced only if the mask clearly contradicts it: cropped photos keep their EXIF.
    """
    broad = focal_prior(None, None, camera.width, camera.height)
    if found.score >= WELL_FOUND:
        steps = 2 * search.steps[-1]
        best = refined_finest(obj.caster, obj.silhouette, camera, found.state, broad, search, steps)
        free = Found(best.state, best.score, best.log_focal_sigma(), found.runner_up, found.by_keypoints)
    else:
        free = find(obj.caster, obj.silhouette, camera, broad, search)
    if free.score < found.score + CLEARLY_BETTER:
        return found, "exif"
    log.warning(
        "%s: the EXIF focal length (%.0f px) does not fit the mask, %.0f px does (%.3f against %.3f): is the photo a "
        "crop? give camera.focal_px to settle it",
        photo,
        camera.focal,
        np.exp(free.state.log_focal),
        free.score,
        found.score,
    )
    return free, "estimated"


def _focal_of_given(objects: Sequence[ObjectToPlace], camera: Camera) -> Camera:
    """Return the camera with the focal length at which given poses fit their masks best."""
    fixed = [
        (t.caster, t.pose, target_of(t.silhouette, t.caster.mesh.labels, 200))
        for t in objects
        if t.pose is not None and t.silhouette.inside.any()
    ]

    def at(log_focal: float) -> Camera:
        """Return the camera with the focal length exp(log_focal)."""
        return msgspec.structs.replace(camera, focal=float(np.exp(log_focal)))

    def misfit(log_focal: float) -> float:
        """Return minus the sum of overlaps (IoU) at the focal length exp(log_focal)."""
        seen = ((t, rasterise(caster, t.camera(at(log_focal)), pose)) for caster, pose, t in fixed)
        return -sum(labelled_iou(target.silhouette, maps.label) for target, maps in seen)

    # a grid over log focal length, then Brent's method about its best point
    grid = np.log(camera.focal) + np.linspace(-1.6, 1.6, 33)
    best = grid[int(np.argmin([misfit(g) for g in grid]))]
    return at(minimize_scalar(misfit, bounds=(best - 0.1, best + 0.1), method="bounded", options={"xatol": 1e-4}).x)
