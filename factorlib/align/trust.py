"""How far a pose is to be believed, from the mask alone.

contour_error      overlap says little of a big round object and much of a thin one; distance between contours is fair to both.
                   The median over all contour points, of mesh and mask, so that parts that one of the two lacks do not count.
normal_stderr_deg  the pose's standard errors, by the normal equations of its contours, moved one after another: how far the
                   normals in the mask turn.  Turns that show nothing new, as of a sphere, cost nothing.  Large for few pixels.
mirrored_score     seen from far away, a body and its mirror image have one outline, from opposite sides.  So a mask that was
                   mirrored by mistake fits well, and normals are all wrong; but its mirror image fits better, by perspective
                   and parts.  Searched with less effort, and only where a better fit is to be had.
"""

from __future__ import annotations

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from factorlib.align.place import ObjectToPlace, Placed
from factorlib.align.refine import FocalPrior, contour_of, normal_equations, rendered
from factorlib.align.search import Search, find, normal_difference
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import State, state_of
from factorlib.align.target import Target, target_of
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import Caster

RESOLUTION, MARGIN = 200, 0.2
LARGEST_MOVE = 0.5  # of one unknown, radians or log: beyond, normal equations say nothing
FITS_TO_A_PIXEL = 0.995  # score from which no other pose fits clearly better
QUICK = Search(views=200, rolls=16, keep=(10, 5, 2, 1), steps=(5, 8, 8, 6), rivals=0)


class Trust(msgspec.Struct, frozen=True):
    """contour_error: of the mask's extent; mirrored_score: labelled IoU.  None for what was not tried."""

    contour_error: float
    normal_stderr_deg: float | None = None
    mirrored_score: float | None = None


def trust_in(obj: ObjectToPlace, placed: Placed, number: int) -> Trust:
    """Of the pose of `obj`, the photo's `number`-th; of a pose that was given only the contours are compared."""
    found, caster, silhouette = placed.found[number], obj.caster, obj.silhouette
    if not silhouette.inside.any():
        return Trust(1.0)
    target = target_of(silhouette, caster.mesh.labels, RESOLUTION, MARGIN)
    if found is None:
        return Trust(
            contour_error(caster, target, placed.camera, state_of(placed.poses[number], placed.camera, caster))
        )
    return Trust(
        contour_error(caster, target, placed.camera, found.state),
        normal_stderr_deg(caster, target, placed.camera, found.state, placed.prior),
        mirrored_score(caster, silhouette, placed.camera, placed.prior)
        if found.score < FITS_TO_A_PIXEL and not found.by_keypoints
        else None,
    )


def contour_error(caster: Caster, target: Target, camera: Camera, state: State) -> float:
    """Median distance from the contours of mesh and mask, of every material, to the other's, as a share of the mask's extent."""
    seen, distances = rendered(caster, target, camera, state), [np.zeros(0)]
    for name, region in target.regions.items():
        points = contour_of(seen, name)[0]
        distances.append(np.abs(map_coordinates(region.distance, points.T[::-1] - 0.5, order=1, mode="nearest")))
        if len(region.contour):
            distances.append(
                cKDTree(points).query(region.contour)[0] if len(points) else np.full(len(region.contour), target.extent)
            )
    every = np.concatenate(distances)
    return float(np.median(every) / target.extent) if len(every) else 1.0


def normal_stderr_deg(caster: Caster, target: Target, camera: Camera, state: State, prior: FocalPrior) -> float:
    """Root of the summed squares, over the independent directions of the unknowns, of the normals' median turn by one
    standard error."""
    equations = normal_equations(rendered(caster, target, camera, state), target, prior)
    free = 7 if prior.sigma > 0 else 6
    precision, directions = np.linalg.eigh(equations.information[:free, :free])
    turns = [
        normal_difference(caster, target, camera, state, state.moved(_move(direction, value)))
        for value, direction in zip(precision, directions.T)
    ]
    return float(np.sqrt(np.sum(np.square(turns))))


def _move(direction: Float[np.ndarray, " n"], precision: float) -> Float[np.ndarray, "7"]:
    """One standard error along a unit direction, all of LARGEST_MOVE at most."""
    length = min(max(precision, 1e-12) ** -0.5, LARGEST_MOVE / np.abs(direction).max())
    return np.append(length * direction, np.zeros(7 - len(direction)))


def mirrored_score(
    caster: Caster, silhouette: Silhouette, camera: Camera, prior: FocalPrior, search: Search = QUICK
) -> float:
    """The best score for the photo with left and right exchanged."""
    centre = (camera.width - camera.centre[0], camera.centre[1])
    mirror = Silhouette(np.ascontiguousarray(silhouette.label[:, ::-1]))
    return find(caster, mirror, msgspec.structs.replace(camera, centre=centre), prior, search).score
