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

from factorlib.align.photo_alignment import ObjectToAlign, PhotoAlignment
from factorlib.align.refine import interpolate, mesh_contour, normal_equations, render
from factorlib.align.search import PoseEstimate, SearchOptions, estimate_pose, normal_difference, render_maps
from factorlib.align.silhouette import ObjectView
from factorlib.align.state import PoseState, pose_state
from factorlib.align.target import Target, make_target
from factorlib.geometry.raster import Caster

LARGEST_MOVE = 0.5  # greatest move of one unknown (radians or log) for which the normal equations hold
FITS_TO_A_PIXEL = 0.995  # no other pose fits clearly better than a pose of this score
QUICK = SearchOptions(views=200, rolls=16, keep=(10, 5, 2, 1), steps=(4, 8, 8, 6), rivals=0)
LEAST_SCORE_LEAD = 0.001  # share of the mask's pixels: a smaller lead is noise, however little is left unexplained
DIFFERENT_DEG = 5.0  # a runner-up is a different answer if the median angle of normals exceeds this
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class Reliability(msgspec.Struct, frozen=True):
    """Measures of reliability; None stands for a measure that was not taken.

    contour_error is a share of the mask's extent, mirrored_score a labelled IoU.
    """

    contour_error: float
    normal_stderr_deg: float | None = None
    mirrored_score: float | None = None


class Thresholds(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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


def find_doubts(
    iou: float,
    agreement: float,
    measures: Reliability,
    estimate: PoseEstimate | None,
    thresholds: Thresholds = Thresholds(),
) -> list[str]:
    """Return one sentence for each threshold that the pose misses.

    Args:
        iou: Overlap of mesh and mask.
        agreement: Share of the pixels of both whose materials agree.
        measures: Measures of reliability.
        estimate: Result of the search; None for a given pose.
        thresholds: Thresholds.

    Returns:
        Sentences; none for a pose without doubt.
    """
    normal_stderr = measures.normal_stderr_deg or 0.0
    apart = f"{measures.contour_error:.1%} of the mask's extent"
    doubts = [
        (iou < thresholds.least_iou, f"mesh and mask overlap by {iou:.2f} only"),
        (
            agreement < thresholds.least_agreement,
            f"the materials of mesh and mask agree on {agreement:.2f} of the pixels only",
        ),
        (
            measures.contour_error > thresholds.most_contour_error,
            f"half of the contours of mesh and mask lie {apart} apart, or more",
        ),
        (normal_stderr > thresholds.most_normal_stderr_deg, f"the mask tells normals to {normal_stderr:.1f}° only"),
    ]
    if estimate and (mirrored := measures.mirrored_score) is not None:
        scores = f"({mirrored:.3f}, {estimate.score:.3f})"
        fault = f"the mirror image of the mask fits better {scores}: was it mirrored?"
        doubts.append((1 - mirrored < (1 - estimate.score) / 2, fault))
    if estimate and (other := estimate.runner_up):
        lead = max(thresholds.least_lead * (1 - other.score), LEAST_SCORE_LEAD)
        fault = f"another pose, its normals {other.normal_difference_deg:.0f}° away, fits as well "
        fault += f"({other.score:.3f}, {estimate.score:.3f})"
        doubts.append((other.normal_difference_deg > DIFFERENT_DEG and estimate.score - other.score < lead, fault))
    return [reason for is_missed, reason in doubts if is_missed]


def measure_reliability(obj: ObjectToAlign, alignment: PhotoAlignment, number: int) -> Reliability:
    """Measure the reliability of the pose of `obj`; for a given pose, only the contours are compared.

    Args:
        obj: The object.
        alignment: Camera and poses of the photo.
        number: Index of the object in `alignment`.

    Returns:
        The measures.
    """
    estimate = alignment.estimates[number]
    caster = obj.caster
    if not obj.silhouette.inside.any():
        return Reliability(1.0)
    # the focal length counts as uncertain as it was before alignment
    view = ObjectView(obj.silhouette, *alignment.prior)
    target = make_target(view, caster.mesh.labels, resolution=200)
    if estimate is None:
        return Reliability(contour_error(caster, target, pose_state(alignment.poses[number], alignment.camera, caster)))
    may_be_mirrored = estimate.score < FITS_TO_A_PIXEL and estimate.source != "keypoints"
    return Reliability(
        contour_error(caster, target, estimate.state),
        normal_stderr_deg(caster, target, estimate.state),
        mirrored_score(caster, view) if may_be_mirrored else None,
    )


def contour_error(caster: Caster, target: Target, state: PoseState) -> float:
    """Return the median distance between the contours of mesh and mask, as a share of the mask's extent.

    It is 1 if there are no contours.
    """
    rendering = render(caster, target, state)
    distances = [np.zeros(0)]
    for label, region in target.regions.items():
        points, _ = mesh_contour(rendering, label)
        # mesh → mask: signed distance; mask → mesh: distance to the nearest point
        distances.append(np.abs(interpolate(region.distance, points)))
        if len(points) and len(region.contour):
            distances.append(cKDTree(points).query(region.contour)[0])
        else:
            distances.append(np.full(len(region.contour), target.extent))
    together = np.concatenate(distances)
    return float(np.median(together) / target.extent) if len(together) else 1.0


def normal_stderr_deg(caster: Caster, target: Target, state: PoseState) -> float:
    """Return the standard error of the normals in degrees.

    It is the root of summed squares, over the independent directions of the unknowns, of the normals' median rotation
    by one standard error.
    """
    information, _ = normal_equations(render(caster, target, state))
    angles = []
    free = target.view.free
    unmoved = render_maps(caster, target, state)
    # move the state by one standard error along each eigenvector of the information
    precisions, directions = np.linalg.eigh(information[:free, :free])
    for precision, direction in zip(precisions, directions.T, strict=True):
        move = direction * min(max(precision, 1e-12) ** -0.5, LARGEST_MOVE / np.abs(direction).max())
        moved = state.moved(np.append(move, np.zeros(7 - free)))
        angles.append(normal_difference(unmoved, render_maps(caster, target, moved)))
    return float(np.sqrt(np.sum(np.square(angles))))


def mirrored_score(caster: Caster, view: ObjectView) -> float:
    """Return the best score for the photo with left and right exchanged, a labelled IoU."""
    return estimate_pose(caster, view.mirrored(), QUICK).score
