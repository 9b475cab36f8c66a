"""Search for the pose of one object in one photo from its mask alone.

Rotation, place and distance are unknown, and the focal length where it is not given. The search is coarse to fine:
every view and roll at thumbnail size (`coarse`), the best of them refined on contours (`refine`) at four resolutions,
fewer at each. A survivor rotated by more than DISTINCT_DEG against the winner is refined as finely and becomes the
runner-up. Its score and the difference of its normals tell how far the answer can be trusted.
"""

from collections.abc import Callable, Iterable
from typing import Annotated

import msgspec
import numpy as np

from factorlib.align.coarse import initial_states, is_cut
from factorlib.align.refine import PoseState, RefinedState, refine
from factorlib.align.silhouette import ObjectView, Target, make_target
from factorlib.geometry.camera import angle_between
from factorlib.geometry.raster import Caster, Maps, rasterise
from factorlib.results.poses import RunnerUpPose, pose_fields

Count = Annotated[int, msgspec.Meta(ge=1)]
Report = Callable[[float], None]
SAME_DEG = 6.0  # refined poses with a smaller angle between them are the same
DISTINCT_DEG = 15.0  # least angle of a runner-up
UNLIKELY_FOCAL = 0.001  # penalty on the score for a focal length one sigma from the expected one
# a pose is given up if its unexplained share exceeds this multiple of the best one's, and this absolute share
GIVEN_UP_RATIO = 4.0
GIVEN_UP_UNEXPLAINED = 0.04


class SearchOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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


class PoseEstimate(msgspec.Struct, frozen=True):
    """Result of the search for the pose of one object.

    score             labelled IoU at the finest resolution
    log_focal_sigma   standard error of the log focal length
    runner_up         best pose that is rotated by more than DISTINCT_DEG against this one
    source            found (by search) or keypoints (refined from the user's keypoints)
    """

    state: PoseState
    score: float
    log_focal_sigma: float
    runner_up: RunnerUpPose | None = None
    source: str = "found"


def estimate_pose(
    caster: Caster, view: ObjectView, search: SearchOptions = SearchOptions(), report: Report = lambda share: None
) -> PoseEstimate:
    """Search for the pose whose labelled silhouette agrees best with the photo's.

    Args:
        caster: The mesh.
        view: The mask, with at least one pixel of the object, and the camera.
        search: Effort of the search.
        report: Called with the completed share of the search, after the first guesses and after each round.

    Returns:
        The pose with its score and runner-up.
    """
    effort = search.cut_effort if is_cut(view.silhouette) else 1
    states = initial_states(
        caster, view, search.views * effort, search.rolls, search.keep[0] * effort, search.apart_deg
    )
    report(1 / (len(search.keep) + 2))
    # rounds of refinement, each finer and with fewer states
    ranked: list[RefinedState] = []
    coarser: list[RefinedState] = []
    rounds = zip(search.keep, search.steps, search.resolution, search.margin)
    for number, (keep, steps, size, margin) in enumerate(rounds, start=2):
        states = states[: keep if ranked else effort * keep]
        target = make_target(view, caster.mesh.labels, size, margin)
        coarser = ranked + coarser
        ranked = _rank([refine(caster, target, state, steps) for state in states], view)
        most = max(GIVEN_UP_RATIO * (1 - ranked[0].score), GIVEN_UP_UNEXPLAINED)
        states = [result.state for result in ranked if 1 - result.score <= most]
        report(number / (len(search.keep) + 2))
    # refine rivals at the finest resolution, since scores of different resolutions do not compare
    rivals: list[RefinedState] = []
    for other in coarser:
        if len(rivals) < search.rivals and _is_apart(other, (ranked[0], *rivals), DISTINCT_DEG):
            rivals.append(other)
    refined = [refine(caster, target, rival.state, search.steps[-1]) for rival in rivals]
    best, *others = _rank(ranked + refined, view)
    runner_up = next((other for other in others if _is_apart(other, [best], DISTINCT_DEG)), None)
    second = _describe_runner_up(caster, target, best, runner_up) if runner_up else None
    return PoseEstimate(best.state, best.score, best.log_focal_sigma(), second)


def _describe_runner_up(caster: Caster, target: Target, best: RefinedState, runner_up: RefinedState) -> RunnerUpPose:
    """Return the pose of the runner-up, its score, and the angle between its normals and those of the best pose."""
    maps = (render_maps(caster, target, result.state) for result in (best, runner_up))
    pose = pose_fields(runner_up.state.pose(caster))
    return RunnerUpPose(**pose, score=runner_up.score, normal_difference_deg=normal_difference(*maps))


def refine_near(
    caster: Caster, view: ObjectView, start: PoseState, search: SearchOptions = SearchOptions()
) -> PoseEstimate:
    """Refine the pose from `start` at the two finest resolutions; keep `start` if refinement leads far away.

    Args:
        caster: The mesh.
        view: The mask and the camera.
        start: Initial state, as from keypoints.
        search: Effort of the search.

    Returns:
        The pose, without a runner-up.
    """
    state = start
    for steps, size, margin in zip(search.steps[-2:], search.resolution[-2:], search.margin[-2:]):
        target = make_target(view, caster.mesh.labels, size, margin)
        result = refine(caster, target, state, steps)
        if angle_between(result.state.rotation, start.rotation) > DISTINCT_DEG:
            result = refine(caster, target, start, 0)
        state = result.state
    return PoseEstimate(result.state, result.score, result.log_focal_sigma(), source="keypoints")


def refine_finest(
    caster: Caster, view: ObjectView, start: PoseState, search: SearchOptions, steps: int
) -> RefinedState:
    """Refine `start` at the finest resolution of the search; with 0 steps, only score it.

    Args:
        caster: The mesh.
        view: The mask and the camera.
        start: Initial state.
        search: Effort of the search, whose last resolution is used.
        steps: Gauss–Newton steps.

    Returns:
        The best state.
    """
    target = make_target(view, caster.mesh.labels, search.resolution[-1], search.margin[-1])
    return refine(caster, target, start, steps)


def _rank(results: list[RefinedState], view: ObjectView) -> list[RefinedState]:
    """Sort the results, best first, and drop those whose rotation is near that of a better one."""

    def value(result: RefinedState) -> float:
        """Return the score less a penalty for an unlikely focal length."""
        sigma = view.focal_sigma
        off = (result.state.log_focal - np.log(view.camera.focal)) / sigma if sigma else 0.0
        return result.score - UNLIKELY_FOCAL * off**2

    distinct: list[RefinedState] = []
    for result in sorted(results, key=lambda result: -value(result)):
        if _is_apart(result, distinct, SAME_DEG):
            distinct.append(result)
    return distinct


def _is_apart(result: RefinedState, others: Iterable[RefinedState], degrees: float) -> bool:
    """Return whether `result` is rotated by more than `degrees` against each of the others."""
    return all(angle_between(result.state.rotation, other.state.rotation) > degrees for other in others)


def render_maps(caster: Caster, target: Target, state: PoseState) -> Maps:
    """Render the maps (normals, labels, …) of the mesh at a pose, in the target's window."""
    return rasterise(caster, target.window(state.focal), state.pose(caster))


def normal_difference(a: Maps, b: Maps) -> float:
    """Return the median angle in degrees between the normals of common pixels of the mesh; 180 if there are none."""
    overlap = (a.label > 0) & (b.label > 0)
    if not overlap.any():
        return 180.0
    cosine = np.clip(np.sum(a.normal[overlap] * b.normal[overlap], axis=1), -1, 1)
    return float(np.rad2deg(np.median(np.arccos(cosine))))
