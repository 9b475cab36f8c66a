"""Poses of all objects of one photo: given poses are used, the others are searched, with one camera for all."""

import logging
from collections.abc import Sequence

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from factorlib.align.refine import PoseState, pose_state
from factorlib.align.search import PoseEstimate, Report, SearchOptions, estimate_pose, refine_finest, refine_near
from factorlib.align.silhouette import ObjectView, Silhouette, labelled_iou, make_target, with_prior_focal
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, rasterise

RELIABLE_SCORE = 0.9  # least score of a pose that can judge EXIF's focal length
CLEARLY_BETTER = 0.01  # lead in score that another focal length needs over EXIF's
MOST_ERROR = 0.015  # greatest reprojection error of a keypoint, as a share of the photo's longer side
LEAST_AGREEING = 4  # least number of keypoints that agree; three have up to four poses
LEAST_FOR_FOCAL = 6  # least number of keypoints that determine the focal length too
FOCALS = (0.4, 10.0)  # range of plausible focal lengths in units of the photo's longer side
log = logging.getLogger("factorlib.align")


class KnownFocal(msgspec.Struct, frozen=True):
    """Prior knowledge of the focal length in photo pixels; None where nothing is known.

    source    dataset | colmap | transforms | bop | exif
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


class ObjectToAlign(msgspec.Struct, frozen=True):
    """Object to align: its mesh, its mask, and its pose as far as the user gives it.

    caster      mesh for ray casting
    silhouette  mask of the object
    pose        given pose
    keypoints   given correspondences, from which the search begins
    """

    name: str
    caster: Caster
    silhouette: Silhouette
    pose: Pose | None = None
    keypoints: Keypoints | None = None


class Focal(msgspec.Struct, frozen=True):
    """Focal length of the photo at one point of the alignment, as given or as estimated so far.

    camera        the photo's camera at this focal length
    prior_sigma   standard deviation of its prior for the next object, log; 0 once it is settled
    source        dataset | colmap | transforms | bop | exif | estimated
    stderr        standard error of its logarithm, once it is estimated
    """

    camera: Camera
    prior_sigma: float
    source: str | None
    stderr: float = 0.0


class PhotoAlignment(msgspec.Struct, frozen=True):
    """Camera of the photo, with the source and the standard error (log) of its focal length, and pose of each object.

    estimates   results of the search; None for a given pose
    prior       camera and standard deviation (log) of the prior of the focal length, before alignment
    """

    camera: Camera
    focal_source: str
    log_focal_sigma: float
    poses: list[Pose]
    estimates: list[PoseEstimate | None]
    prior: tuple[Camera, float]


def align_photo(
    objects: Sequence[ObjectToAlign],
    camera: Camera,
    known: KnownFocal,
    photo: str,
    search: SearchOptions = SearchOptions(),
    report: Report = lambda completed: None,
) -> PhotoAlignment:
    """Estimate the poses of all objects of a photo.

    Args:
        objects: The objects.
        camera: The photo's camera; its focal length is not used.
        known: Prior knowledge of the focal length.
        photo: Name of the photo.
        search: Effort of the search.
        report: Called now and then with the number of completed searches, fractions included.

    Returns:
        The camera and the poses. The focal length, where `known` does not give it, is estimated with the object that
        covers most pixels.

    Raises:
        InputError: If the mask of an object to search has no pixel, or if its keypoints do not agree.
    """
    prior = with_prior_focal(camera, known.focal, known.source)
    focal = _initial_focal(objects, known, *prior)
    estimates: dict[int, PoseEstimate] = {}
    searched = [k for k, obj in enumerate(objects) if obj.pose is None]
    for completed, k in enumerate(sorted(searched, key=lambda k: -int(objects[k].silhouette.inside.sum()))):
        report(completed)
        obj = objects[k]
        view = ObjectView(obj.silhouette, focal.camera, focal.prior_sigma)
        estimates[k] = _estimate_object(obj, view, photo, search, _report_after(completed, report))
        if view.focal_sigma > 0:
            source = "estimated"
            if focal.source == "exif":
                estimates[k], source = _check_exif_focal(obj, view, estimates[k], photo, search)
            focal = Focal(estimates[k].state.camera(camera), 0.0, source, estimates[k].log_focal_sigma)
    # given poses are kept to the last digit
    poses = [obj.pose or estimates[k].state.pose(obj.caster) for k, obj in enumerate(objects)]
    in_order = [estimates.get(k) for k in range(len(objects))]
    return PhotoAlignment(focal.camera, focal.source or "estimated", focal.stderr, poses, in_order, prior)


def _report_after(done: int, report: Report) -> Report:
    """Return the report of the next search, which follows `done` others."""
    return lambda share: report(done + share)


def _initial_focal(objects: Sequence[ObjectToAlign], known: KnownFocal, camera: Camera, sigma: float) -> Focal:
    """Return the focal length that fits given poses, else the prior's.

    `camera` and `sigma` are those of the prior.
    """
    if sigma > 0 and any(obj.pose is not None for obj in objects):
        return Focal(_focal_of_given_poses(objects, camera), 0.0, "estimated")
    return Focal(camera, sigma, known.source)


def _estimate_object(
    obj: ObjectToAlign, view: ObjectView, photo: str, search: SearchOptions, report: Report
) -> PoseEstimate:
    """Estimate the pose of one object: from keypoints, or by a search.

    Args:
        obj: The object.
        view: Its mask and the photo's camera.
        photo: Name of the photo.
        search: Effort of the search.
        report: Called with the completed share, from 0 to 1.

    Returns:
        The pose.

    Raises:
        InputError: If no pixel shows the object, or if its keypoints do not agree.
    """
    if not obj.silhouette.inside.any():
        raise InputError(
            f"no pixel of the mask shows object {obj.name!r}",
            file="dataset.yaml",
            key=photo,
            cure="remove the object from this photo, or correct its mask or its materials",
        )
    if obj.keypoints is None:
        return estimate_pose(obj.caster, view, search, report)
    return refine_near(obj.caster, view, keypoint_state(obj, obj.keypoints, view, photo), search)


def keypoint_state(obj: ObjectToAlign, keypoints: Keypoints, view: ObjectView, photo: str) -> PoseState:
    """Estimate the pose of an object from its keypoints.

    It is COLMAP's robust absolute pose (LO-RANSAC over P3P, or over P4Pf with an unknown focal length), then refined.
    Wrong keypoints are outliers as long as enough of the others agree.

    Args:
        obj: The object.
        keypoints: Its keypoints.
        view: Its mask and the photo's camera. The focal length is estimated too if it is not exactly known and there
            are LEAST_FOR_FOCAL keypoints.
        photo: Name of the photo.

    Returns:
        The state.

    Raises:
        InputError: If fewer than LEAST_AGREEING keypoints agree.
    """
    caster = obj.caster
    camera = view.camera
    side = max(camera.width, camera.height)
    points = (keypoints.point - caster.centre) / caster.radius
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.max_error = MOST_ERROR * side
    estimation.ransac.random_seed = 0
    # first with an unknown focal length, if there are enough keypoints, then with the known one
    is_free = view.focal_sigma > 0 and len(keypoints.pixel) >= LEAST_FOR_FOCAL
    for free in (True, False) if is_free else (False,):
        estimation.estimate_focal_length = refinement.refine_focal_length = free
        colmap = camera.colmap()  # pycolmap writes the estimated focal length into it
        result = pycolmap.estimate_and_refine_absolute_pose(keypoints.pixel, points, colmap, estimation, refinement)
        agreeing = result["num_inliers"] if result else 0
        if result and agreeing >= LEAST_AGREEING and FOCALS[0] * side <= colmap.focal_length <= FOCALS[1] * side:
            rotation = result["cam_from_world"].rotation.matrix()
            pose = Pose(rotation, caster.radius * result["cam_from_world"].translation - rotation @ caster.centre)
            return pose_state(pose, msgspec.structs.replace(camera, focal=float(colmap.focal_length)), caster)
    raise InputError(
        f"only {agreeing} of the {len(keypoints.pixel)} keypoints of '{obj.name}' agree on a pose",
        file="dataset.yaml",
        key=f"{photo}.{obj.name}.keypoints",
        cure=f"at least {LEAST_AGREEING} must, within {MOST_ERROR:.1%} of the photo's longer side: check that each "
        "pixel (x, y) belongs to its point",
    )


def _check_exif_focal(
    obj: ObjectToAlign, view: ObjectView, estimate: PoseEstimate, photo: str, search: SearchOptions
) -> tuple[PoseEstimate, str]:
    """Decide between EXIF's focal length and an estimated one; return the pose and the source of the length.

    EXIF's length is replaced only if the mask clearly contradicts it: cropped photos keep their EXIF.

    Args:
        obj: The object.
        view: Its mask and the photo's camera at EXIF's focal length.
        estimate: Pose at EXIF's focal length.
        photo: Name of the photo.
        search: Effort of the search.

    Returns:
        The pose, and "exif" or "estimated".
    """
    broad = ObjectView(view.silhouette, *with_prior_focal(view.camera, None, None))
    if estimate.score >= RELIABLE_SCORE:
        best = refine_finest(obj.caster, broad, estimate.state, search, 2 * search.steps[-1])
        free = PoseEstimate(best.state, best.score, best.log_focal_sigma(), estimate.runner_up, estimate.source)
    else:
        free = estimate_pose(obj.caster, broad, search)
    if free.score < estimate.score + CLEARLY_BETTER:
        return estimate, "exif"
    log.warning(
        "%s: the EXIF focal length (%.0f px) fits the mask worse than %.0f px, which is used (IoU %.3f against %.3f): "
        "the photo may be a crop; camera.focal_px in dataset.yaml overrides both",
        photo,
        view.camera.focal,
        np.exp(free.state.log_focal),
        estimate.score,
        free.score,
    )
    return free, "estimated"


def _focal_of_given_poses(objects: Sequence[ObjectToAlign], camera: Camera) -> Camera:
    """Return the camera with the focal length at which given poses fit their masks best."""
    posed = [
        (obj.caster, obj.pose, make_target(ObjectView(obj.silhouette, camera), obj.caster.mesh.labels, 200))
        for obj in objects
        if obj.pose is not None and obj.silhouette.inside.any()
    ]

    def misfit(log_focal: float) -> float:
        """Return minus the sum of overlaps (IoU) at the focal length exp(log_focal)."""
        focal = float(np.exp(log_focal))
        maps = (rasterise(caster, target.window(focal), pose) for caster, pose, target in posed)
        return -sum(labelled_iou(target.silhouette, each.label) for (*_, target), each in zip(posed, maps))

    # a grid over log focal length, then Brent's method about its best point
    grid = np.log(camera.focal) + np.linspace(-1.6, 1.6, 33)
    best = grid[int(np.argmin([misfit(g) for g in grid]))]
    minimum = minimize_scalar(misfit, bounds=(best - 0.1, best + 0.1), method="bounded", options={"xatol": 1e-4})
    return msgspec.structs.replace(camera, focal=float(np.exp(minimum.x)))
