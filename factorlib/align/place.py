"""All objects of one photo: given poses are used, the others searched, one camera for all."""

import logging
from collections.abc import Sequence

import msgspec
import numpy as np
import pycolmap
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from factorlib.align.refine import FocalPrior
from factorlib.align.search import Found, Report, RunnerUp, Search, find, focal_prior, found_near, refined_finest
from factorlib.align.silhouette import Silhouette, labelled_iou
from factorlib.align.state import State, state_of
from factorlib.align.target import target_of
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, rasterise
from factorlib.results.poses import AS_IT_IS, CameraEntry, ObjectEntry

WELL_FOUND = 0.9  # score from which the pose is right enough to judge EXIF's focal length by
CLEARLY_BETTER = 0.01  # score by which another focal length must win against EXIF's
MOST_ERROR = 0.015  # of the photo's longer side, from a point named in the photo to the mesh's: more is a mistake
LEAST_AGREEING = 4  # three have up to four poses
LEAST_FOR_FOCAL = 6  # so many also tell the focal length
FOCALS = (0.4, 10.0)  # of the longer side: what else comes out is not believed
log = logging.getLogger("factorlib.align")


class KnownFocal(msgspec.Struct, frozen=True):
    """What is known of the focal length beforehand, photo pixels; None where nothing is.

    source: dataset | colmap | transforms | bop | exif
    """

    focal: float | None = None
    source: str | None = None


class Keypoints(msgspec.Struct, frozen=True):
    """pixel [n, 2] (x right, y down, pixel centres at 0.5) shows point [n, 3] of the mesh, in its own frame and units."""

    pixel: Float[np.ndarray, "n 2"]
    point: Float[np.ndarray, "n 3"]


class ObjectToPlace(msgspec.Struct, frozen=True):
    """An object to place: its mesh, what the photo says about it, and what the user, or an earlier result, said of its pose."""

    name: str
    caster: Caster
    silhouette: Silhouette
    pose: Pose | None = None
    keypoints: Keypoints | None = None
    earlier: ObjectEntry | None = None
    scale: tuple[float, float, float] = AS_IT_IS  # of the caster's mesh, against the file's


class Placed(msgspec.Struct, frozen=True):
    """The photo's camera with its focal length, where that is from, its standard error (log), and each object's pose."""

    camera: Camera
    focal_source: str  # dataset | colmap | transforms | bop | exif | estimated
    log_focal_sigma: float
    poses: list[Pose]
    found: list[Found | None]  # None where the pose was given
    prior: FocalPrior  # what was known of the focal length beforehand


def placed(
    objects: Sequence[ObjectToPlace], camera: Camera, known: KnownFocal, photo: str,
    search: Search = Search(), before: CameraEntry | None = None, report: Report = lambda done: None,
) -> Placed:  # fmt: skip
    """Poses of all objects.  The focal length, where neither known nor found `before`, is found with the object that shows most.

    camera: of the photo; its focal length is not used.  before: the camera of an earlier result, in pixels of this photo.
    report: called now and then with how many objects are done, and what share of the next
    Raises InputError for an object to search whose mask has no pixel.
    """
    source, sigma, found = known.source, 0.0, {}
    prior = beforehand = focal_prior(known.focal, source, camera.width, camera.height)
    if before is not None:
        prior, source, sigma = FocalPrior(before.focal_px, 0.0), before.focal_source, before.focal_relative_stderr
    camera = msgspec.structs.replace(camera, focal=prior.focal)
    if prior.sigma > 0 and any(each.pose is not None for each in objects):
        camera, source = _focal_of_given(objects, camera), "estimated"
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
        if obj.earlier is not None:  # as it is, scored anew, with its runner-up where that still counts
            start, other = state_of(obj.earlier.pose, camera, obj.caster), obj.earlier.runner_up
            known_camera = FocalPrior(camera.focal, 0.0)
            score = refined_finest(obj.caster, obj.silhouette, camera, start, known_camera, search, 0).score
            second = other and RunnerUp(
                state_of(other.pose, camera, obj.caster), other.score, other.normal_difference_deg
            )
            found[k] = Found(start, score, sigma, second, earlier=True)
        elif obj.keypoints is None:
            found[k] = find(
                obj.caster, obj.silhouette, camera, prior, search, lambda share, done=done: report(done + share)
            )
        else:
            start = state_of_keypoints(obj, camera, prior, photo)
            found[k] = found_near(obj.caster, obj.silhouette, camera, start, prior, search)
        if prior.sigma > 0:
            if source == "exif":
                found[k], source = _judged(obj, camera, found[k], photo, search)
            else:
                source = "estimated"
            sigma, camera = found[k].log_focal_sigma, found[k].state.camera(camera)
            prior = FocalPrior(camera.focal, 0.0)
    poses = [  # known ones are used to the last digit
        obj.pose or (obj.earlier.pose if obj.earlier else found[k].state.pose(obj.caster)) for k, obj in enumerate(objects)
    ]  # fmt: skip
    return Placed(camera, source or "estimated", sigma, poses, [found.get(k) for k in range(len(objects))], beforehand)


def state_of_keypoints(obj: ObjectToPlace, camera: Camera, prior: FocalPrior, photo: str) -> State:
    """The state in which most keypoints of `obj` agree, by COLMAP's robust absolute pose (LO-RANSAC over P3P, or P4Pf where the focal
    length is sought too), then refined.  Points named wrongly are outliers, as long as enough agree: raises InputError where
    fewer than LEAST_AGREEING do.

    camera: its focal length is the prior's; it is replaced only where nothing was known and LEAST_FOR_FOCAL are given.
    """
    keypoints, caster = obj.keypoints, obj.caster
    assert keypoints is not None
    side, points = max(camera.width, camera.height), (keypoints.point - caster.centre) / caster.radius
    estimation, refinement = pycolmap.AbsolutePoseEstimationOptions(), pycolmap.AbsolutePoseRefinementOptions()
    estimation.ransac.max_error, estimation.ransac.random_seed = MOST_ERROR * side, 0
    sought = prior.sigma > 0 and len(keypoints.pixel) >= LEAST_FOR_FOCAL
    for free in (True, False) if sought else (False,):
        estimation.estimate_focal_length = refinement.refine_focal_length = free
        colmap = camera.colmap()  # gets the focal length
        found = pycolmap.estimate_and_refine_absolute_pose(keypoints.pixel, points, colmap, estimation, refinement)
        agreeing = found["num_inliers"] if found else 0
        if found and agreeing >= LEAST_AGREEING and FOCALS[0] * side <= colmap.focal_length <= FOCALS[1] * side:
            rotation = found["cam_from_world"].rotation.matrix()
            pose = Pose(rotation, caster.radius * found["cam_from_world"].translation - rotation @ caster.centre)
            return state_of(pose, msgspec.structs.replace(camera, focal=float(colmap.focal_length)), caster)
    raise InputError(
        f"only {agreeing} of the {len(keypoints.pixel)} keypoints of '{obj.name}' agree on a pose", file="dataset.yaml", key=f"{photo}.{obj.name}.keypoints",
        cure=f"at least {LEAST_AGREEING} must, within {MOST_ERROR:.1%} of the photo's longer side: is each pixel (x, y) beside its own point?",
    )  # fmt: skip


def _judged(obj: ObjectToPlace, camera: Camera, found: Found, photo: str, search: Search) -> tuple[Found, str]:
    """EXIF's focal length stands unless the mask clearly contradicts it: crops keep their EXIF."""
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
        "%s: the EXIF focal length (%.0f px) does not fit the mask, %.0f px does (%.3f against %.3f): is the photo a crop? "
        "give camera.focal_px to settle it", photo, camera.focal, np.exp(free.state.log_focal), free.score, found.score,
    )  # fmt: skip
    return free, "estimated"


def _focal_of_given(objects: Sequence[ObjectToPlace], camera: Camera) -> Camera:
    """The focal length at which given poses fit their masks best."""
    shown = [t for t in objects if t.pose and t.silhouette.inside.any()]
    fixed = [(t.caster, t.pose, target_of(t.silhouette, t.caster.mesh.labels, 200)) for t in shown]

    def at(log_focal: float) -> Camera:
        return msgspec.structs.replace(camera, focal=float(np.exp(log_focal)))

    def misfit(log_focal: float) -> float:
        """Minus the sum of overlaps (IoU) with the focal length exp(log_focal)."""
        seen = ((t, rasterise(caster, t.camera(at(log_focal)), pose)) for caster, pose, t in fixed)
        return -sum(labelled_iou(target.silhouette, maps.label) for target, maps in seen)

    grid = np.log(camera.focal) + np.linspace(-1.6, 1.6, 33)
    best = grid[int(np.argmin([misfit(g) for g in grid]))]
    return at(minimize_scalar(misfit, bounds=(best - 0.1, best + 0.1), method="bounded", options={"xatol": 1e-4}).x)
