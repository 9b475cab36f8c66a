"""How far a pose is to be believed, from the mask alone, and in words why it is not.

contour_error      overlap says little of a big round object and much of a thin one; distance between contours is fair to both.
                   The median over all contour points, of mesh and mask, so that parts that one of the two lacks do not count.
normal_stderr_deg  the pose's standard errors, by the normal equations of its contours, moved one after another: how far the
                   normals in the mask turn.  Turns that show nothing new, as of a sphere, cost nothing.  Large for few pixels.
mirrored_score     seen from far away, a body and its mirror image have one outline, from opposite sides.  So a mask that was
                   mirrored by mistake fits well, and normals are all wrong; but its mirror image fits better, by perspective
                   and parts.  Searched with less effort, and only where a better fit is to be had.
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

LARGEST_MOVE = 0.5  # of one unknown, radians or log: beyond, normal equations say nothing
FITS_TO_A_PIXEL = 0.995  # score from which no other pose fits clearly better
QUICK = Search(views=200, rolls=16, keep=(10, 5, 2, 1), steps=(4, 8, 8, 6), rivals=0)
LEAST_SCORE_LEAD = 0.001  # of the mask's pixels: a lead of less is their noise, however little is left unexplained
DIFFERENT_DEG = 5.0  # median angle of normals from which a runner-up is another answer
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class Trust(msgspec.Struct, frozen=True):
    """contour_error: of the mask's extent; mirrored_score: labelled IoU.  None for what was not tried."""

    contour_error: float
    normal_stderr_deg: float | None = None
    mirrored_score: float | None = None


class Standards(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a pose must reach to be believed."""

    least_iou: Share = 0.7
    """Overlap (intersection over union) of mesh and mask below which a pose is doubtful."""
    least_agreement: Share = 0.8
    """Share of the pixels both cover on which the materials of mesh and mask agree; below, the pose is doubtful."""
    most_contour_error: Share = 0.009
    """Median distance of the contours of mesh and mask, as a share of the mask's extent; above, the pose is doubtful."""
    most_normal_stderr_deg: Annotated[float, msgspec.Meta(gt=0)] = 10.0
    """Standard error of normals, in degrees, that the mask leaves; above, the pose is doubtful."""
    least_lead: Share = 0.1
    """Share of what the runner-up leaves unexplained that the pose found must explain; below, the pose is doubtful."""


def doubts(
    iou: float, agreement: float, trust: Trust, found: Found | None, standards: Standards = Standards()
) -> list[str]:
    """One sentence per standard missed; `found` is None for a pose that was given."""
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
            f"the mirror image of the mask fits better ({trust.mirrored_score:.3f}, {found.score:.3f}): was it mirrored?"
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
    """Measure the trust in the pose of `obj`, the photo's `number`-th; of a pose that was given only the contours are compared."""
    found, caster, silhouette, camera = placed.found[number], obj.caster, obj.silhouette, placed.camera
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
    """Median distance from the contours of mesh and mask, of every material, to the other's, as a share of the mask's extent."""
    seen, distances = rendered(caster, target, camera, state), [np.zeros(0)]
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
    """Root of the summed squares, over the independent directions of the unknowns, of the normals' median turn by one
    standard error."""
    information, _ = normal_equations(rendered(caster, target, camera, state), target, prior)
    turns, free, unmoved = [], prior.free, seen_in(caster, target, camera, state)
    precisions, directions = np.linalg.eigh(information[:free, :free])
    for precision, direction in zip(precisions, directions.T, strict=True):
        move = direction * min(max(precision, 1e-12) ** -0.5, LARGEST_MOVE / np.abs(direction).max())
        moved = state.moved(np.append(move, np.zeros(7 - free)))
        turns.append(normal_difference(unmoved, seen_in(caster, target, camera, moved)))
    return float(np.sqrt(np.sum(np.square(turns))))


def mirrored_score(caster: Caster, silhouette: Silhouette, camera: Camera, prior: FocalPrior) -> float:
    """The best score for the photo with left and right exchanged."""
    camera = msgspec.structs.replace(camera, centre=(camera.width - camera.centre[0], camera.centre[1]))
    return find(caster, Silhouette(np.ascontiguousarray(silhouette.label[:, ::-1])), camera, prior, QUICK).score
