"""Reliability of a pose, from the mask alone, and the reasons for doubt in words.

contour_error      Overlap tells little of a big round object and much of a thin one; distance between contours is fair
                   to both. It is the median over all contour points, of mesh and mask, so that parts that only one of
                   the two has do not count.
normal_stderr_deg  Angle by which the normals in the mask turn when the pose moves by its standard errors, one after
                   another; the standard errors are those of the contours' normal equations. Rotations that change
                   nothing visible, as of a sphere, cost nothing. It is large for few pixels.
mirrored_score     From far away, a body and its mirror image have one outline, from opposite sides. So a mask that was
                   mirrored by mistake fits well with normals that are all wrong. Its mirror image fits better, by
                   perspective and parts. It is searched with less effort, and only where a better fit is possible.
"""

from typing import Annotated

import msgspec
import numpy as np
from scipy.spatial import cKDTree

from factorlib.align.place import ObjectToPlace, Placed
from factorlib.align.refine import FocalPrior, at_points, contour_of, normal_equations, rendered
from factorlib.align.search import Found, Search, find, normal_difference, seen_in
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import State, state_of
from factorlib.align.target import Target, target_of
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster

LARGEST_MOVE = 0.5  # greatest move of one unknown (radians or log) for which the normal equations hold
FITS_TO_A_PIXEL = 0.995  # no other pose fits clearly better than a pose of this score
QUICK = Search(views=200, rolls=16, keep=(10, 5, 2, 1), steps=(4, 8, 8, 6), rivals=0)
LEAST_SCORE_LEAD = 0.001  # share of the mask's pixels: a smaller lead is noise, however little is left unexplained
DIFFERENT_DEG = 5.0  # a runner-up is a different answer if the median angle of normals exceeds this
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class Trust(msgspec.Struct, frozen=True):
    """Measures of reliability; None stands for a measure that was not taken.

    contour_error is a share of the mask's extent, mirrored_score a labelled IoU.
    """

    contour_error: float
    normal_stderr_deg: float | None = None
    mirrored_score: float | None = None


class Standards(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds that a pose must reach."""

    least_iou: Share = 0.7
    """Least overlap (intersection over union) of mesh and mask; below, the pose is doubtful."""
    least_agreement: Share = 0.8
    """Least share of common pixels on which the materials of mesh and mask agree; below, the pose is doubtful."""
    most_contour_error: Share = 0.009
    """Greatest median distance of the contours, as a share of the mask's extent; above, the pose is doubtful."""
    most_normal_stderr_deg: Annotated[float, msgspec.Meta(gt=0)] = 10.0
    """Greatest standard error of the normals, degrees; above, the pose is doubtful."""
    least_lead: Share = 0.1
    """Least lead over the runner-up, as a share of what that leaves unexplained; below, the pose is doubtful."""


def doubts(
    iou: float, agreement: float, trust: Trust, found: Found | None, standards: Standards = Standards()
) -> list[str]:
    """Return one sentence for each threshold that the pose misses.

    Args:
        iou: Overlap of mesh and mask.
        agreement: Share of the pixels of both whose materials agree.
        trust: Measures of reliability.
        found: Result of the search; None for a given pose.
        standards: Thresholds.

    Returns:
        Sentences; none for a pose without doubt.
    """
    reasons = []
    if iou < standards.least_iou:
        reasons.append(f"mesh and mask overlap by {iou:.2f} only")
    if agreement < standards.least_agreement:
        reasons.append(f"the materials of mesh and mask agree on {agreement:.2f} of the pixels only")
    if trust.contour_error > standards.most_contour_error:
        reasons.append(
            f"half of the contours of mesh and mask lie {trust.contour_error:.1%} of the mask's extent apart, or more"
        )
    if trust.normal_stderr_deg is not None and trust.normal_stderr_deg > standards.most_normal_stderr_deg:
        reasons.append(f"the mask tells normals to {trust.normal_stderr_deg:.1f}° only")
    if found and trust.mirrored_score is not None and 1 - trust.mirrored_score < (1 - found.score) / 2:
        reasons.append(
            f"the mirror image of the mask fits better ({trust.mirrored_score:.3f}, {found.score:.3f}): "
            "was it mirrored?"
        )
    if found and (other := found.runner_up) and other.normal_difference_deg > DIFFERENT_DEG:
        lead = max(standards.least_lead * (1 - other.score), LEAST_SCORE_LEAD)
        if found.score - other.score < lead:
            reasons.append(
                f"another pose, its normals {other.normal_difference_deg:.0f}° away, fits as well "
                f"({other.score:.3f}, {found.score:.3f})"
            )
    return reasons


def trust_in(obj: ObjectToPlace, placed: Placed, number: int) -> Trust:
    """Measure the reliability of the pose of `obj`; for a given pose, only the contours are compared.

    Args:
        obj: The object.
        placed: Camera and poses of the photo.
        number: Index of the object in `placed`.

    Returns:
        The measures.
    """
    found = placed.found[number]
    caster = obj.caster
    silhouette = obj.silhouette
    camera = placed.camera
    if not silhouette.inside.any():
        return Trust(1.0)
    target = target_of(silhouette, caster.mesh.labels, resolution=200)
    if found is None:
        return Trust(contour_error(caster, target, camera, state_of(placed.poses[number], camera, caster)))
    may_be_mirrored = found.score < FITS_TO_A_PIXEL and not found.by_keypoints
    return Trust(
        contour_error(caster, target, camera, found.state),
        normal_stderr_deg(caster, target, camera, found.state, placed.prior),
        mirrored_score(caster, silhouette, camera, placed.prior) if may_be_mirrored else None,
    )


def contour_error(caster: Caster, target: Target, camera: Camera, state: State) -> float:
    """Return the median distance between the contours of mesh and mask, as a share of the mask's extent.

    Args:
        caster: The mesh.
        target: Window about the mask.
        camera: The photo's camera.
        state: State of the mesh.

    Returns:
        The median; 1 if there are no contours.
    """
    seen = rendered(caster, target, camera, state)
    distances = [np.zeros(0)]
    for name, region in target.regions.items():
        points, _ = contour_of(seen, name)
        distances.append(np.abs(at_points(region.distance, points)))
        if len(points) and len(region.contour):
            distances.append(cKDTree(points).query(region.contour)[0])
        else:
            distances.append(np.full(len(region.contour), target.extent))
    every = np.concatenate(distances)
    return float(np.median(every) / target.extent) if len(every) else 1.0


def normal_stderr_deg(caster: Caster, target: Target, camera: Camera, state: State, prior: FocalPrior) -> float:
    """Return the standard error of the normals in degrees.

    It is the root of summed squares, over the independent directions of the unknowns, of the normals' median rotation
    by one standard error.

    Args:
        caster: The mesh.
        target: Window about the mask.
        camera: The photo's camera.
        state: State of the mesh.
        prior: Prior of the focal length.

    Returns:
        An angle.
    """
    information, _ = normal_equations(rendered(caster, target, camera, state), target, prior)
    turns = []
    free = prior.free
    unmoved = seen_in(caster, target, camera, state)
    # move the state by one standard error along each eigenvector of the information
    precisions, directions = np.linalg.eigh(information[:free, :free])
    for precision, direction in zip(precisions, directions.T, strict=True):
        move = direction * min(max(precision, 1e-12) ** -0.5, LARGEST_MOVE / np.abs(direction).max())
        moved = state.moved(np.append(move, np.zeros(7 - free)))
        turns.append(normal_difference(unmoved, seen_in(caster, target, camera, moved)))
    return float(np.sqrt(np.sum(np.square(turns))))


def mirrored_score(caster: Caster, silhouette: Silhouette, camera: Camera, prior: FocalPrior) -> float:
    """Return the best score for the photo with left and right exchanged.

    Args:
        caster: The mesh.
        silhouette: The mask.
        camera: The photo's camera.
        prior: Prior of the focal length.

    Returns:
        A labelled IoU.
    """
    camera = msgspec.structs.replace(camera, centre=(camera.width - camera.centre[0], camera.centre[1]))
    return find(caster, Silhouette(np.ascontiguousarray(silhouette.label[:, ::-1])), camera, prior, QUICK).score
