"""Whether the photos of a light have a tone curve: where held-out observations are explained much better with one.

    1. The problem is brought near its optimum.
    2. One Gauss–Newton step of all unknowns predicts what an exponent for each photo would gain.  If that is little, no photo gets one.
    3. Else the problem is brought near its optimum once more, with exponents and without, by equally many iterations, and for each
       light the held-out losses decide (`compare_by_light`).
    4. An exponent that runs toward its bounds only makes up for other errors of the model: its light goes without curves.

A light that has curves already, from an earlier solution, keeps them.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.model.tone import beyond_cameras, with_curves
from factorlib.solve.descent import Descent, descend
from factorlib.solve.evidence import Evidence, compare_by_light
from factorlib.solve.iterate import Iterate, evaluate
from factorlib.solve.step import damped_step
from factorlib.solve.thresholds import PROMISED_BY_TONE, TONE

ITERATIONS = 6
DAMPING = 1e-3


class Curves(msgspec.Struct, frozen=True):
    """A point with the tone curves that it needs, and what decided about each light."""

    point: Point
    evidence: list[Evidence]


def near_optimum(problem: JointProblem, point: Point) -> Iterate:
    """The point after ITERATIONS of descent."""
    return descend(problem, evaluate(problem, point), Descent(ITERATIONS))


def with_curves_where_needed(problem: JointProblem, start: Iterate, robust: Loss) -> Curves:
    """The point with the tone curves that it needs, and the evidence for every light.

    problem: its loss judges;  start: near the optimum of the loss `robust`, which is the one that is lowered
    """
    fitting, at, lights = problem.with_loss(robust), start.point, start.point.lights
    had = np.array([len(light.log_tone) > 0 for light in lights])
    if promised_gain(fitting, start) < PROMISED_BY_TONE:
        return Curves(at, [Evidence(bool(has)) for has in had])
    straight, curved = (near_optimum(fitting, _in(at, of)).point for of in (lights, _curved(lights, ~had)))
    evidence = compare_by_light(problem, (straight, at), curved, TONE)  # against both: a lobe that grew where nothing is fitted is no evidence for curves
    kept = np.array([of_light.kept for of_light in evidence]) & ~had
    if kept.any():
        settled = near_optimum(fitting, curved).point
        kept &= ~np.array([beyond_cameras(light) for light in settled.lights])
    if kept.any():
        all_kept = bool((kept | had).all())
        chosen = curved if all_kept else near_optimum(fitting, _in(at, _curved(lights, kept))).point
    else:
        chosen = straight
    return Curves(chosen, [_decided(*of_light) for of_light in zip(evidence, kept.tolist(), had.tolist(), strict=True)])


def _decided(evidence: Evidence, kept: bool, had: bool) -> Evidence:
    return Evidence(True) if had else msgspec.structs.replace(evidence, kept=kept)


def promised_gain(problem: JointProblem, at: Iterate) -> float:
    """Predicted decrease by one step with tone curves for all photos, less that without, as a share of the loss."""
    none = np.array([len(light.log_tone) == 0 for light in at.point.lights])
    curved = evaluate(problem, _in(at.point, _curved(at.point.lights, none)))
    without, richer = (damped_step(iterate, DAMPING).predicted for iterate in (at, curved))
    return (richer - without) / max(at.loss, 1e-300)


def _curved(lights: Sequence[Light], which: Bool[np.ndarray, " k"]) -> list[Light]:
    """The lights, those of `which` with a curve for each photo, the identity."""
    return [with_curves(light) if one else light for light, one in zip(lights, which, strict=True)]


def _in(point: Point, lights: list[Light]) -> Point:
    return Point(point.materials, lights)
