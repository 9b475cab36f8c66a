"""All objects of one photo: given poses are used, the others searched, one camera for all."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import msgspec
import numpy as np
from scipy.optimize import minimize_scalar

from factorlib.align.keypoints import Keypoints, state_of_keypoints
from factorlib.align.refine import FocalPrior
from factorlib.align.search import (
    CLEARLY_BETTER,
    UNKNOWN_FOCAL,
    WELL_FOUND,
    Found,
    RunnerUp,
    Search,
    find,
    focal_prior,
    found_before,
    found_near,
    with_focal_free,
)  # fmt: skip
from factorlib.align.silhouette import Silhouette, labelled_iou
from factorlib.align.state import state_of
from factorlib.align.target import target_of
from factorlib.errors import InputError
from factorlib.geometry.camera import Camera, Pose
from factorlib.geometry.raster import Caster, rasterise

log = logging.getLogger("factorlib.align")


class Earlier(msgspec.Struct, frozen=True):
    """A pose that an earlier result found, and its runner-up where that is still to be reckoned with."""

    pose: Pose
    runner_up: Pose | None = None
    runner_up_score: float = 0.0
    runner_up_difference_deg: float = 0.0


class EarlierFocal(msgspec.Struct, frozen=True):
    """The focal length that goes with earlier poses, photo pixels; where it was from, and its standard error (log)."""

    focal: float
    source: str
    log_sigma: float


class KnownFocal(msgspec.Struct, frozen=True):
    """What is known of the focal length beforehand, photo pixels; None where nothing is.

    source: dataset | colmap | transforms | bop | exif
    """

    focal: float | None = None
    source: str | None = None


class ObjectToPlace(msgspec.Struct, frozen=True):
    """An object to place: its mesh, what the photo says about it, and what the user, or an earlier result, said of its pose."""

    name: str
    caster: Caster
    silhouette: Silhouette
    pose: Pose | None = None
    keypoints: Keypoints | None = None
    earlier: Earlier | None = None
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of the caster's mesh, against the file's


class Placed(msgspec.Struct, frozen=True):
    """The photo's camera with its focal length, where that is from, its standard error (log), and each object's pose."""

    camera: Camera
    focal_source: str  # dataset | colmap | transforms | bop | exif | estimated
    log_focal_sigma: float
    poses: list[Pose]
    found: list[Found | None]  # None where the pose was given
    prior: FocalPrior  # what was known of the focal length beforehand


def placed(
    objects: Sequence[ObjectToPlace],
    camera: Camera,
    known: KnownFocal,
    photo: str,
    search: Search = Search(),
    before: EarlierFocal | None = None,
) -> Placed:
    """Poses of all objects.  The focal length, where neither known nor found `before`, is found with the object that shows most.

    camera: of the photo; its focal length is not used.  Raises InputError for an object to search whose mask has no pixel.
    """
    source = known.source
    prior = beforehand = focal_prior(known.focal, source, camera.width, camera.height)
    camera = msgspec.structs.replace(camera, focal=prior.focal)
    sigma, found = 0.0, {}
    if before is not None:
        prior, source, sigma = FocalPrior(before.focal, 0.0), before.source, before.log_sigma
        camera = msgspec.structs.replace(camera, focal=before.focal)
    if prior.sigma > 0 and any(each.pose is not None for each in objects):
        camera, source = _focal_of_given(objects, camera), "estimated"
        prior = FocalPrior(camera.focal, 0.0)
    for k in sorted(range(len(objects)), key=lambda k: (-int(objects[k].silhouette.inside.sum()), k)):
        obj = objects[k]
        if obj.pose is not None:
            continue
        if not obj.silhouette.inside.any():
            raise InputError(
                f"no pixel of the mask shows object {obj.name!r}", file="dataset.yaml", key=photo,
                cure="remove the object from this photo, or check its mask and materials",
            )  # fmt: skip
        if obj.earlier is not None:
            found[k] = _found_before(obj, camera, sigma, search)
        elif obj.keypoints is None:
            found[k] = find(obj.caster, obj.silhouette, camera, prior, search)
        else:
            start = state_of_keypoints(obj.keypoints, obj.caster, camera, prior, photo, obj.name)
            found[k] = found_near(obj.caster, obj.silhouette, camera, start, prior, search)
        if prior.sigma > 0:
            found[k], source = _judged(obj, camera, found[k], source, photo, search)
            sigma = found[k].log_focal_sigma
            camera = found[k].state.camera(camera)
            prior = FocalPrior(camera.focal, 0.0)
    poses = [_pose(each, found.get(k)) for k, each in enumerate(objects)]
    return Placed(camera, source or "estimated", sigma, poses, [found.get(k) for k in range(len(objects))], beforehand)


def _pose(obj: ObjectToPlace, found: Found | None) -> Pose:
    """What was said or found before is used to the last digit."""
    if obj.pose is None and obj.earlier is None:
        return found.state.pose(obj.caster)
    return obj.pose or obj.earlier.pose


def _found_before(obj: ObjectToPlace, camera: Camera, sigma: float, search: Search) -> Found:
    earlier = obj.earlier
    found = found_before(obj.caster, obj.silhouette, camera, state_of(earlier.pose, camera, obj.caster), sigma, search)
    if earlier.runner_up is None:
        return found
    state = state_of(earlier.runner_up, camera, obj.caster)
    other = RunnerUp(state, earlier.runner_up_score, earlier.runner_up_difference_deg)
    return msgspec.structs.replace(found, runner_up=other)


def _judged(
    obj: ObjectToPlace, camera: Camera, found: Found, source: str | None, photo: str, search: Search
) -> tuple[Found, str]:
    """EXIF's focal length stands unless the mask clearly contradicts it: crops keep their EXIF."""
    if source != "exif":
        return found, "estimated"
    broad = FocalPrior(UNKNOWN_FOCAL.focal * max(camera.width, camera.height), UNKNOWN_FOCAL.sigma)
    if found.score >= WELL_FOUND:
        free = with_focal_free(obj.caster, obj.silhouette, camera, found, broad, search)
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
    fixed = [
        (t.caster, t.pose, target_of(t.silhouette, t.caster.mesh.labels, 200))
        for t in objects
        if t.pose and t.silhouette.inside.any()
    ]

    def misfit(log_focal: float) -> float:
        """Minus the sum of overlaps (IoU) with the focal length exp(log_focal)."""
        trial = msgspec.structs.replace(camera, focal=float(np.exp(log_focal)))
        return -sum(
            labelled_iou(target.silhouette, rasterise(caster, target.camera(trial), pose).label)
            for caster, pose, target in fixed
        )

    grid = np.log(camera.focal) + np.linspace(-1.6, 1.6, 33)
    best = grid[int(np.argmin([misfit(g) for g in grid]))]
    fit = minimize_scalar(misfit, bounds=(best - 0.1, best + 0.1), method="bounded", options={"xatol": 1e-4})
    return msgspec.structs.replace(camera, focal=float(np.exp(fit.x)))
