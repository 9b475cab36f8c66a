"""The pose of one object in one photo, from its mask alone: unknown rotation, place, distance and, if need be, focal length.

Coarse to fine: every view and roll at thumbnail size (`coarse`), the best of them refined on contours (`refine`) at
three resolutions, fewer at each.  Whatever survives beside the winner, turned by more than DISTINCT_DEG, is refined as finely
and is the runner-up: how near its score comes, and how different its normals are, says how far the answer can be trusted.
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
SAME_DEG = 6.0  # refined poses nearer than this are one
DISTINCT_DEG = 15.0  # a runner-up is turned by more than this
UNLIKELY_FOCAL = 0.001  # score that a focal length one sigma from the expected costs
UNKNOWN_FOCAL = FocalPrior(1.5, 0.5)  # in units of the photo's longer side: wide angle .7, normal 1.4, portrait 2.5
EXIF_SIGMA = 0.05  # whole millimetres, and focus
GIVEN_UP_RATIO = 4.0  # times as much left unexplained as by the best, or GIVEN_UP_UNEXPLAINED: not refined further
GIVEN_UP_UNEXPLAINED = 0.04


class Search(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How hard to look.  The tuples hold one number per round of refinement, in order; most guesses fall in the first."""

    views: Count = 300
    """Directions of view, evenly over the sphere, that are tried."""
    rolls: Count = 20
    """Turns about the line of sight tried for each direction of view."""
    apart_deg: float = 14.0
    """Least angle, in degrees, between two guesses."""
    cut_effort: Count = 2
    """Factor on views and first guesses where the frame or another object cuts the mask."""
    keep: tuple[Count, Count, Count, Count] = (32, 14, 7, 3)
    """Guesses that each round of refinement takes up."""
    steps: tuple[Count, Count, Count, Count] = (4, 8, 10, 8)
    """Gauss-Newton steps of each round."""
    resolution: tuple[Count, Count, Count, Count] = (80, 100, 200, 400)
    """Pixels of the mask's longer side in each round."""
    margin: tuple[float, float, float, float] = (0.35, 0.35, 0.2, 0.1)
    """What is seen around the mask in each round, as a share of its longer side."""
    rivals: Annotated[int, msgspec.Meta(ge=0)] = 2
    """Guesses dropped on the way that are refined to the end all the same, to find a runner-up."""


class RunnerUp(msgspec.Struct, frozen=True):
    """The best pose turned by more than DISTINCT_DEG from the one found."""

    state: State
    score: float
    normal_difference_deg: float  # median over the pixels both cover; small for a symmetric object


class Found(msgspec.Struct, frozen=True):
    """The pose found, its labelled IoU at the finest resolution, the standard error of log focal, and the runner-up."""

    state: State
    score: float
    log_focal_sigma: float
    runner_up: RunnerUp | None
    by_keypoints: bool = False  # started where the user's keypoints say; nothing else was tried
    earlier: bool = False  # taken from an earlier result as it is


def focal_prior(camera_focal: float | None, source: str | None, width: int, height: int) -> FocalPrior:
    """Return what is known of the focal length before looking: given is exact, EXIF nearly so, else a broad guess."""
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
    """The pose whose labelled silhouette agrees best with the photo's.

    camera: the photo's; its focal length is replaced by the prior's.  It must show some pixels of the object.
    report: called with the share of the search that is done, after the first guesses and after each round of refinement
    """
    camera = msgspec.structs.replace(camera, focal=prior.focal)
    effort = search.cut_effort if is_cut(silhouette) else 1
    states = candidates(
        caster, silhouette, camera, effort * search.views, search.rolls, effort * search.keep[0], search.apart_deg
    )
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
    # refined anew: scores of different resolutions do not compare
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
    """The pose refined from `start`, at the two finest resolutions; `start` itself where that leads far off."""
    camera, state = msgspec.structs.replace(camera, focal=prior.focal), start
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
    """Refined from `start` at the finest resolution of the search; in no steps, `start` with its score."""
    target = target_of(silhouette, caster.mesh.labels, search.resolution[-1], search.margin[-1])
    return refined(caster, target, camera, start, prior, steps)


def _distinct(results: list[Refined], prior: FocalPrior) -> list[Refined]:
    """Best first, without those that ended where a better one did."""

    def value(result: Refined) -> float:
        """The score, less a little for an unlikely focal length."""
        off = (result.state.log_focal - np.log(prior.focal)) / prior.sigma if prior.sigma else 0.0
        return result.score - UNLIKELY_FOCAL * off**2

    distinct: list[Refined] = []
    for result in sorted(results, key=lambda result: -value(result)):
        if _is_apart(result, distinct, SAME_DEG):
            distinct.append(result)
    return distinct


def _is_apart(one: Refined, others: Iterable[Refined], degrees: float) -> bool:
    """Whether it is turned by more than `degrees` against each of the others."""
    return all(angle_between(one.state.rotation, other.state.rotation) > degrees for other in others)


def seen_in(caster: Caster, target: Target, camera: Camera, state: State) -> Maps:
    """Return the maps of the mesh in a state, in the target's window."""
    return rasterise(caster, target.camera(state.camera(camera)), state.pose(caster))


def normal_difference(a: Maps, b: Maps) -> float:
    """Median angle in degrees between the normals where both see the mesh; 180 if they share no pixel."""
    both = (a.label > 0) & (b.label > 0)
    if not both.any():
        return 180.0
    cosine = np.clip(np.sum(a.normal[both] * b.normal[both], axis=1), -1, 1)
    return float(np.rad2deg(np.median(np.arccos(cosine))))
