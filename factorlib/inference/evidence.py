"""Evidence for a choice of the model: held-out observations, to which no candidate was fitted.

Two models are fitted to the same observations.  Held-out observations are those of whole cells of mirror directions
(`factorlib.inference.observed`).  With a_i and b_i the mean robust losses of light i without and with the richer part, and n_i its held-out
observations,

    d = Σ_i n_i (log a_i − log b_i) / Σ_i n_i                                                                       (1)

is the difference of the logarithms of geometric means over lights: the likelihood of residuals whose variance differs from light to light
and is unknown.  A light whose normals are wrong has many times the loss of another, and in a sum its change would outweigh all others.

Neighbouring residuals err alike, so the standard error of d is taken over clusters: with A_k, B_k the summed losses of cluster k of light i,
the delta method gives log a_i − log b_i the variance K/(K−1) Σ_k (A_k/ΣA − B_k/ΣB)², K the number of clusters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from factorlib.inference.materials import Point
from factorlib.inference.problem import JointProblem
from factorlib.results.materials import Decision

LEAST_LOSS = 1e-4  # in σ² of the noise model, added to every loss: two losses far below it count as equal
# Thresholds, in standard errors.  Shadows go only if the evidence is clearly against them; bounces and tone curves need clear evidence;
# smaller cells obey the same prior as larger ones, so one standard error is enough for them.
AGAINST = -2.0
FOR = 2.0
FINER = 1.0


class Losses(NamedTuple):
    """Robust losses of the held-out observations of each light, and their clusters."""

    values: list[Float[np.ndarray, " n"]]
    clusters: list[Int[np.ndarray, " n"]]


def losses_of(problem: JointProblem, point: Point) -> Losses:
    """The held-out observations' losses at a point; of every observation, if none is held out."""
    none = problem.none_held_out
    judged = [block.take(block.held_out | none) for block in problem.blocks]
    return Losses(problem.held_out_losses(point), [block.clusters() for block in judged])


def compare(without: Losses, richer: Losses, least: float) -> Decision:
    """Whether the richer model is kept: if d is more than `least` standard errors; where nothing is held out, it is not.

    >>> same = Losses([np.array([1.0, 2.0, 3.0])], [np.array([0, 1, 2])])
    >>> compare(same, same, FOR).kept, compare(same, same, AGAINST).kept
    (False, True)
    """
    counts = np.array([len(values) for values in richer.values])
    if not counts.sum():
        return Decision(False)
    differences = []
    variances = []
    logs = []
    for a, b, cluster in zip(without.values, richer.values, richer.clusters, strict=True):
        both = [np.bincount(cluster, losses + LEAST_LOSS) for losses in (a, b)]
        shares = [sums / max(float(sums.sum()), 1e-300) for sums in both]
        logs.append([np.log(np.mean(losses) + LEAST_LOSS) if len(losses) else 0.0 for losses in (a, b)])
        differences.append(logs[-1][0] - logs[-1][1])
        number = len(both[0])
        variances.append(number / max(number - 1, 1) * float(np.sum((shares[0] - shares[1]) ** 2)))
    share = counts / counts.sum()
    d = float(share @ differences)
    error = float(np.sqrt(share**2 @ variances))
    margin = d / max(error, 1e-12)
    with_, without_ = (float(np.exp(share @ [pair[k] for pair in logs])) for k in (1, 0))
    return Decision(margin > least, with_, without_, margin)
