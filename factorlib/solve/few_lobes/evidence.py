"""Which of two models is used: whether a material has a specular part.

Both models are brought to (or near) their optimum on the observations that are fitted.  The richer model is used if the loss of the
held-out observations, which neither model was fitted to, is so much higher without it that a threshold is passed
(`factorlib.solve.few_lobes.thresholds`).
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.evidence import Evidence
from factorlib.solve.few_lobes.thresholds import Threshold


class Candidates(NamedTuple):
    """The best points of two models of one problem."""

    without: Point
    richer: Point


def compare(
    problem: JointProblem, candidates: Candidates, threshold: Threshold, material: int | None = None
) -> Evidence:
    """Whether the richer model is kept, by the problem's loss of held-out observations.

    material: only observations of this material decide; None: all do.  Harm (`Threshold.harm`) counts over all observations
    """
    without, richer = (np.concatenate(problem.held_out_losses(point)) for point in candidates)
    own = _in_question(problem, material)
    harmed = mean(without) > (1 + threshold.harm) * mean(richer)
    decided = decide(mean(without[own]), mean(richer[own]), threshold)
    return msgspec.structs.replace(decided, kept=decided.kept or harmed)


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
