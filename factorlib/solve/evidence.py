"""Which of two models is used: the same decision for shadows, specular parts and tone curves.

Both models are brought to (or near) their optimum on the observations that are fitted.  The richer model is used if the loss of the
held-out observations, which neither model was fitted to, is so much higher without it that a threshold is passed
(`factorlib.solve.thresholds`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.thresholds import LEAST_DECREASE, Threshold

Losses = Float[np.ndarray, " n"]  # of one light's held-out observations


class Evidence(msgspec.Struct, frozen=True):
    """Whether the richer model is kept, and the mean loss of the held-out observations that decided, with it and without it.

    A loss is None where that model was not tried.  Of interreflection they are geometric means over lights (`decide_over_lights`).
    """

    kept: bool
    held_out_loss_with: float | None = None
    held_out_loss_without: float | None = None


class Candidates(NamedTuple):
    """The best points of two models of one problem."""

    without: Point
    richer: Point


def compare(problem: JointProblem, candidates: Candidates, threshold: Threshold, material: int | None = None) -> Evidence:
    """Whether the richer model is kept, by the problem's loss of held-out observations.

    material: only observations of this material decide; None: all do.  Harm (`Threshold.harm`) counts over all observations
    """
    without, richer = (np.concatenate(problem.held_out_losses(point)) for point in candidates)
    own = _in_question(problem, material)
    harmed = mean(without) > (1 + threshold.harm) * mean(richer)
    decided = decide(mean(without[own]), mean(richer[own]), threshold)
    return msgspec.structs.replace(decided, kept=decided.kept or harmed)


def compare_by_light(problem: JointProblem, without: Sequence[Point], richer: Point, threshold: Threshold) -> list[Evidence]:
    """As `compare`, for each light by its own observations; a light without held-out observations does not get the richer model.

    without: several points of the simpler model; for each light the best of them counts
    """
    losses = zip(*(problem.held_out_losses(point) for point in (richer, *without)), strict=True)
    return [decide(min(mean(other) for other in others), mean(richer), threshold) for richer, *others in losses]


def decide_over_lights(without: Sequence[Losses], richer: Sequence[Losses], threshold: Threshold) -> Evidence:
    """As `decide`, by the geometric mean over lights of each light's mean loss; lights without held-out observations have no say.

    This is the likelihood of residuals whose variance differs from light to light and is unknown.  A light whose normals are wrong has many
    times the loss of another, and in a sum of losses its change would outweigh those of all others.
    """
    number = [len(losses) for losses in richer]
    logarithms = ([np.log(max(mean(losses), LEAST_DECREASE)) for losses in model] for model in (without, richer))
    return decide(*(float(np.exp(np.average(of, weights=number))) if sum(number) else 0.0 for of in logarithms), threshold)


def decide(without: float, richer: float, threshold: Threshold) -> Evidence:
    """The evidence of two mean held-out losses.

    >>> decide(without=1.3, richer=1.0, threshold=Threshold(gain=0.25)).kept
    True
    """
    return Evidence(without > (1 + threshold.gain) * richer, richer, without)


def mean(losses: Float[np.ndarray, " n"]) -> float:
    """The mean of the losses; 0 if there are none."""
    return float(losses.mean()) if len(losses) else 0.0


def _in_question(problem: JointProblem, material: int | None) -> Bool[np.ndarray, " n"]:
    held_out = [block.material[block.held_out | problem.none_held_out] for block in problem.blocks]
    every = np.concatenate(held_out)
    return every == material if material is not None else np.ones(len(every), bool)
