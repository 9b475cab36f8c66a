"""Reliability of a pose from the mask alone, reasons for doubt in words, and confidence in each pixel's normal.

contour_error      Overlap tells little of a big round object and much of a thin one; distance between contours is fair
                   to both. It is the median over all contour points, of mesh and mask, so that parts that only one of
                   the two has do not count.
normal_stderr_deg  Angle by which the normals in the mask turn when the pose moves by its standard errors, one after
                   another; the standard errors are those of the contours' normal equations. Rotations that change
                   nothing visible, as of a sphere, cost nothing. It is large for few pixels.
confidence         A coarse mesh does not tell how its surface bends within a face, nor a thin part how it bends within
                   a pixel. The variance of the normal then grows by the factor

                       1 + (facet / FACET)² + (turn / TURN)²,                                                   (1)

                   facet: largest angle between the face's normal and its corners' normals; turn: RMS angle of the
                   normals of 3 × 3 pixels about their mean. Confidence, from 0 to 1, is the inverse of (1), times
                   factors for contours, depth jumps, slant and sides.
"""

from typing import Annotated

import msgspec
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_dilation, distance_transform_edt, uniform_filter
from scipy.spatial import cKDTree

from factorlib.align.photo_alignment import ObjectToAlign, PhotoAlignment
from factorlib.align.refine import PoseState, interpolate, mesh_contour, normal_equations, pose_state, render
from factorlib.align.search import (
    PoseEstimate,
    normal_difference,
    render_maps,
)
from factorlib.align.silhouette import ObjectView, Silhouette, Target, make_target
from factorlib.geometry.raster import Caster, Maps
from factorlib.images.picture import picture as sdr_picture

LARGEST_MOVE = 0.5  # greatest move of one unknown (radians or log) for which the normal equations hold
LEAST_SCORE_LEAD = 0.001  # share of the mask's pixels: a smaller lead is noise, however little is left unexplained
DIFFERENT_DEG = 5.0  # a runner-up is a different answer if the median angle of normals exceeds this
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
FULL_DISTANCE = 0.01  # share of the mask's extent: nearer to a contour, a small error of pose shows another place
FULL_COSINE = 0.3  # at a smaller cosine, a small error of shape turns the normal much
INSIDE_OF_SHELL = 0.3  # factor on back faces: the inside of an open shell is often another surface than the outside
DEPTH_JUMP = 0.02  # share of the object's depth range: a larger step to the next pixel is a depth jump
STEEPER = 3.0  # and the step must be this many times its neighbours, so that slanted surfaces do not count
# On data/eames, whose true normals are known, the median error of normals is 1.1° where facet is less than 5°, 2.3°
# from 10° to 16° and 8° beyond; it is 20° on flat faces where turn is more than 20°. An angle of 12° gave better
# lights than 5°.
FACET = np.radians(12.0)
TURN = np.radians(20.0)
MESH = np.array([1.0, 0.15, 0.75])  # contour colour of the mesh, magenta
MASK = np.array([0.2, 1.0, 0.2])  # contour colour of the mask, green


class Reliability(msgspec.Struct, frozen=True):
    """Measures of reliability; None stands for a measure that was not taken.

    contour_error is a share of the mask's extent.
    """

    contour_error: float
    normal_stderr_deg: float | None = None


class Thresholds(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds of the measures of a pose, beyond which it is doubtful."""

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
    if estimate and (runner_up := estimate.runner_up):
        lead = max(thresholds.least_lead * (1 - runner_up.score), LEAST_SCORE_LEAD)
        fault = f"another pose, its normals {runner_up.normal_difference_deg:.0f}° away, fits as well "
        fault += f"({runner_up.score:.3f}, {estimate.score:.3f})"
        doubts.append(
            (runner_up.normal_difference_deg > DIFFERENT_DEG and estimate.score - runner_up.score < lead, fault)
        )
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
    error = contour_error(caster, target, estimate.state)
    return Reliability(error, normal_stderr_deg(caster, target, estimate.state))


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
    all_distances = np.concatenate(distances)
    return float(np.median(all_distances) / target.extent) if len(all_distances) else 1.0


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
        moved = state.apply_step(np.append(move, np.zeros(7 - free)))
        angles.append(normal_difference(unmoved, render_maps(caster, target, moved)))
    return float(np.sqrt(np.sum(np.square(angles))))


def confidence(maps: Maps, silhouette: Silhouette) -> Float[np.ndarray, "h w"]:
    """Return the confidence in each pixel's normal.

    It is the product of five factors: distance to contours, to depth jumps and to pixels where mask and mesh disagree;
    slant; visible side; the inverse of (1). It is 0 where mask and mesh have different materials, where there is no
    mesh, and where the normal was bent.
    """
    agree = (maps.label > 0) & (silhouette.label == maps.label) & ~_depth_jumps(maps)
    if not agree.any():
        return np.zeros(agree.shape)
    # distance to contours, jumps and disagreement; slant
    extent = max(np.ptp(indices) for indices in np.nonzero(agree)) + 1
    distance = distance_transform_edt(np.pad(agree, 1, mode="edge"))[1:-1, 1:-1]
    result = np.clip(distance / max(FULL_DISTANCE * extent, 1.0), 0, 1) * np.clip(maps.edge / FULL_COSINE, 0, 1)
    unsure = (maps.facet / FACET) ** 2 + (normal_spread(maps) / TURN) ** 2  # (1) less 1
    return result * np.where(maps.back, INSIDE_OF_SHELL, 1.0) * ~maps.bent / (1 + unsure)


def normal_spread(maps: Maps) -> Float[np.ndarray, "h w"]:
    """Return the spread of the normals within 3 × 3 pixels, radians, the `turn` of (1); 0 at pixels without a mesh."""
    mesh = (maps.label > 0).astype(float)
    share = np.maximum(uniform_filter(mesh, 3, mode="constant"), 1e-12)
    sums = [uniform_filter(n, 3, mode="constant") for n in np.moveaxis(maps.normal, -1, 0)]
    # |mean| = 1 − turn²/2 for small angles
    mean = np.stack(sums, axis=-1) / share[..., None]
    return np.sqrt(np.maximum(2 - 2 * np.linalg.norm(mean, axis=-1), 0)) * mesh


def _depth_jumps(maps: Maps) -> Bool[np.ndarray, "h w"]:
    """Return the pixels on both sides of an abrupt change of depth, or of object, to the right or lower neighbour."""
    mesh = maps.label > 0
    result = np.zeros(mesh.shape, bool)
    limit = DEPTH_JUMP * max(float(np.ptp(maps.depth[mesh])), 1e-12) if mesh.any() else np.inf
    for axis in (0, 1):
        first = (slice(None),) * axis + (slice(None, -1),)
        second = (slice(None),) * axis + (slice(1, None),)
        # steps of depth larger than the limit and much larger than the neighbouring steps
        on_mesh = mesh[first] & mesh[second]
        step = np.where(on_mesh, np.abs(maps.depth[first] - maps.depth[second]), np.inf)
        padded = np.pad(step, [(1, 1) if k == axis else (0, 0) for k in range(2)], constant_values=np.inf)
        before, after = (np.take(padded, range(k, k + step.shape[axis]), axis) for k in (0, 2))
        steep = step > STEEPER * np.minimum(before, after)
        jump = on_mesh & (((step > limit) & steep) | (maps.object[first] != maps.object[second]))
        result[first] |= jump
        result[second] |= jump
    return result


def overlay(radiance: Float[np.ndarray, "h w 3"], maps: Maps, silhouette: Silhouette) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the aligned mesh over the photo as an sRGB picture.

    Contours of the mesh and of its parts are magenta, those of the mask are green; pixels left out are grey-blue.

    Args:
        radiance: The photo, linear.
        maps: Rendered maps of the mesh.
        silhouette: The mask.

    Returns:
        The picture.
    """
    picture = 0.55 / 255 * sdr_picture(radiance).astype(float)
    mesh = maps.label > 0
    unknown = ~silhouette.known
    # the usual colours of normals: red to the right, green upward, blue toward the viewer
    picture[mesh] = 0.6 * picture[mesh] + 0.4 * ((maps.normal * (1, -1, -1) + 1) / 2)[mesh]
    picture[unknown] = 0.7 * picture[unknown] + 0.3 * np.array([0.4, 0.5, 0.7])
    width = max(1, round(max(mesh.shape) / 600))
    for label, colour in ((np.maximum(silhouette.label, 0), MASK), (maps.label + 1000 * maps.object, MESH)):
        # pixels whose label differs from that of the right or lower neighbour
        contour = np.zeros(label.shape, bool)
        contour[:, :-1] |= label[:, :-1] != label[:, 1:]
        contour[:-1] |= label[:-1] != label[1:]
        picture[binary_dilation(contour, iterations=width) if width > 1 else contour] = colour
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
