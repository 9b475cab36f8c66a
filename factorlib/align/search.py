"""Search for the pose of one object in one photo from its mask alone.

Rotation, place and distance are unknown, and the focal length where it is not given. The search is coarse to fine:
every view and roll at thumbnail size (`coarse`), the best of them refined on contours (`refine`) at three resolutions,
fewer at each. A survivor rotated by more than DISTINCT_DEG against the winner is refined as finely and becomes the
runner-up. Its score and the difference of its normals tell how far the answer can be trusted.
"""

from collections.abc import Callable, Iterable
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.coarse import candidates, is_cut
from factorlib.align.refine import FocalPrior, Refined, refined
from factorlib.align.silhouette import Silhouette
from factorlib.align.state import State
from factorlib.align.target import Target, target_of
from factorlib.geometry.camera import Camera, angle_between
from factorlib.geometry.raster import Caster, Maps, rasterise

Count = Annotated[int, msgspec.Meta(ge=1)]
Report = Callable[[float], None]
SAME_DEG = 6.0  # refined poses with a smaller angle between them are the same
DISTINCT_DEG = 15.0  # least angle of a runner-up
UNLIKELY_FOCAL = 0.001  # penalty on the score for a focal length one sigma from the expected one
UNKNOWN_FOCAL = FocalPrior(1.5, 0.5)  # in units of the photo's longer side: wide angle 0.7, normal 1.4, portrait 2.5
EXIF_SIGMA = 0.05  # log: EXIF rounds to whole millimetres and ignores focus
# a pose is given up if its unexplained share exceeds this multiple of the best one's, and this absolute share
GIVEN_UP_RATIO = 4.0
GIVEN_UP_UNEXPLAINED = 0.04


def after(done: float, report: Report) -> Report:
    """Return a report of the share of the next piece of work, which follows `done` pieces."""
    return lambda share: report(done + share)


class Search(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Effort of the search; the tuples hold one number per round of refinement, in order.

    Most guesses are dropped in the first round.
    """

    views: Count = 300
    """Number of directions of view to try, spread evenly over the sphere."""
    rolls: Count = 20
    """Number of rotations about the line of sight to try for each direction of view."""
    apart_deg: float = 14.0
    """Least angle between two guesses, degrees."""
    cut_effort: Count = 2
    """Factor on views and first guesses where the frame or another object cuts the mask."""
    keep: tuple[Count, Count, Count, Count] = (32, 14, 7, 3)
    """Number of guesses that enter each round of refinement."""
    steps: tuple[Count, Count, Count, Count] = (4, 8, 10, 8)
    """Greatest number of Gauss-Newton steps in each round."""
    resolution: tuple[Count, Count, Count, Count] = (80, 100, 200, 400)
    """Pixels of the mask's longer side in each round."""
    margin: tuple[float, float, float, float] = (0.35, 0.35, 0.2, 0.1)
    """Margin around the mask in each round, as a share of its longer side."""
    rivals: Annotated[int, msgspec.Meta(ge=0)] = 2
    """Number of dropped guesses that are refined to the end, to find a runner-up."""


class RunnerUp(msgspec.Struct, frozen=True):
    """Best pose that is rotated by more than DISTINCT_DEG against the winner."""

    state: State
    score: float
    normal_difference_deg: float  # median over common pixels; small for a symmetric object


class Found(msgspec.Struct, frozen=True):
    """Estimated pose, its labelled IoU at the finest resolution, the standard error of log focal, and the runner-up."""

    state: State
    score: float
    log_focal_sigma: float
    runner_up: RunnerUp | None
    by_keypoints: bool = False  # refined from the pose of the user's keypoints, without a search
    earlier: bool = False  # copied from an earlier result


def focal_prior(camera_focal: float | None, source: str | None, width: int, height: int) -> FocalPrior:
    """Return the prior of the focal length: exact if it is given, narrow if from EXIF, else broad.

    Args:
        camera_focal: Focal length in pixels; None if it is unknown.
        source: Source of the length; "exif" makes it uncertain.
        width: Width of the photo.
        height: Height of the photo.

    Returns:
        The prior.
    """
    if camera_focal is None:
        return FocalPrior(UNKNOWN_FOCAL.focal * max(width, height), UNKNOWN_FOCAL.sigma)
    return FocalPrior(camera_focal, EXIF_SIGMA if source == "exif" else 0.0)


def find(
    caster: Caster,
    silhouette: Silhouette,
    camera: Camera,
    prior: FocalPrior,
    search: Search = Search(),
    report: Report = lambda share: None,
) -> Found:
    """Find the pose whose labelled silhouette agrees best with the photo's.

    Args:
        caster: The mesh.
        silhouette: The mask, with at least one pixel of the object.
        camera: The photo's camera; the prior replaces its focal length.
        prior: Prior of the focal length.
        search: Effort of the search.
        report: Function of the share of the search that is done, called after the first guesses and after each round.

    Returns:
        The pose with its score and runner-up.
    """
    camera = msgspec.structs.replace(camera, focal=prior.focal)
    effort = search.cut_effort if is_cut(silhouette) else 1
    states = candidates(
        caster, silhouette, camera, effort * search.views, search.rolls, effort * search.keep[0], search.apart_deg
    )
    # rounds of refinement, each finer and with fewer states
    others: list[Refined] = []
    rounds = zip(search.keep, search.steps, search.resolution, search.margin)
    for number, (keep, steps, size, margin) in enumerate(rounds, start=1):
        report(number / (len(search.keep) + 2))
        states = states[: keep if others else effort * keep]
        target = target_of(silhouette, caster.mesh.labels, size, margin)
        ranked = _distinct([refined(caster, target, camera, state, prior, steps) for state in states], prior)
        most = max(GIVEN_UP_RATIO * (1 - ranked[0].score), GIVEN_UP_UNEXPLAINED)
        states = [result.state for result in ranked if 1 - result.score <= most]
        others = ranked + others
    report(1 - 1 / (len(search.keep) + 2))
    rivals: list[Refined] = []
    for other in others[len(ranked) :]:
        if len(rivals) < search.rivals and _is_apart(other, (ranked[0], *rivals), DISTINCT_DEG):
            rivals.append(other)
    # refine the rivals at the finest resolution, since scores of different resolutions do not compare
    again = [refined(caster, target, camera, rival.state, prior, search.steps[-1]) for rival in rivals]
    best, *others = _distinct(ranked + again, prior)
    runners_up = (
        RunnerUp(
            other.state,
            other.score,
            normal_difference(*(seen_in(caster, target, camera, of.state) for of in (best, other))),
        )
        for other in others
        if _is_apart(other, [best], DISTINCT_DEG)
    )
    return Found(best.state, best.score, best.log_focal_sigma(), next(runners_up, None))


def found_near(
    caster: Caster, silhouette: Silhouette, camera: Camera, start: State, prior: FocalPrior, search: Search = Search()
) -> Found:
    """Refine the pose from `start` at the two finest resolutions; keep `start` if refinement leads far away.

    Args:
        caster: The mesh.
        silhouette: The mask.
        camera: The photo's camera; the prior replaces its focal length.
        start: Initial state.
        prior: Prior of the focal length.
        search: Effort of the search.

    Returns:
        The pose, without a runner-up.
    """
    camera = msgspec.structs.replace(camera, focal=prior.focal)
    state = start
    for steps, size, margin in zip(search.steps[-2:], search.resolution[-2:], search.margin[-2:]):
        target = target_of(silhouette, caster.mesh.labels, size, margin)
        result = refined(caster, target, camera, state, prior, steps)
        if angle_between(result.state.rotation, start.rotation) > DISTINCT_DEG:
            result = refined(caster, target, camera, start, prior, 0)
        state = result.state
    return Found(result.state, result.score, result.log_focal_sigma(), None, by_keypoints=True)


def refined_finest(
    caster: Caster, silhouette: Silhouette, camera: Camera, start: State, prior: FocalPrior, search: Search, steps: int
) -> Refined:
    """Refine `start` at the finest resolution of the search; with 0 steps, only score it.

    Args:
        caster: The mesh.
        silhouette: The mask.
        camera: The photo's camera.
        start: Initial state.
        prior: Prior of the focal length.
        search: Effort of the search, whose last resolution is used.
        steps: Gauss–Newton steps.

    Returns:
        The best state.
    """
    target = target_of(silhouette, caster.mesh.labels, search.resolution[-1], search.margin[-1])
    return refined(caster, target, camera, start, prior, steps)


def _distinct(results: list[Refined], prior: FocalPrior) -> list[Refined]:
    """Sort the results, best first, and drop those whose rotation is near that of a better one."""

    def value(result: Refined) -> float:
        """Return the score less a penalty for an unlikely focal length."""
        off = (result.state.log_focal - np.log(prior.focal)) / prior.sigma if prior.sigma else 0.0
        return result.score - UNLIKELY_FOCAL * off**2

    distinct: list[Refined] = []
    for result in sorted(results, key=lambda result: -value(result)):
        if _is_apart(result, distinct, SAME_DEG):
            distinct.append(result)
    return distinct


def _is_apart(one: Refined, others: Iterable[Refined], degrees: float) -> bool:
    """Return whether `one` is rotated by more than `degrees` against each of the others."""
    return all(angle_between(one.state.rotation, other.state.rotation) > degrees for other in others)


def seen_in(caster: Caster, target: Target, camera: Camera, state: State) -> Maps:
    """Render the maps of the mesh in a state, in the target's window.

    Args:
        caster: The mesh.
        target: Window about the mask.
        camera: The photo's camera.
        state: State of the mesh.

    Returns:
        The maps.
    """
    return rasterise(caster, target.camera(state.camera(camera)), state.pose(caster))


def normal_difference(a: Maps, b: Maps) -> float:
    """Return the median angle in degrees between the normals of common pixels of the mesh; 180 if there are none."""
    both = (a.label > 0) & (b.label > 0)
    if not both.any():
        return 180.0
    cosine = np.clip(np.sum(a.normal[both] * b.normal[both], axis=1), -1, 1)
    return float(np.rad2deg(np.median(np.arccos(cosine))))
