"""Evidence for a model choice, from held-out observations to which no candidate was fitted.

Two models are fitted to the same observations.  The held-out observations are those of whole cells of mirror directions
(`factorlib.inference.observed`).  Let a_i and b_i be the mean robust losses of light i without and with the richer
part, and n_i the number of its held-out observations.  Then

    d = Σ_i n_i (log a_i − log b_i) / Σ_i n_i                                                                      (1)

is the difference of the logarithms of geometric means over lights.  It is a log likelihood ratio for residuals whose
unknown variance differs from light to light.  A light with wrong normals has many times the loss of another, and in a
plain sum its change would outweigh all others.

Neighbouring residuals are correlated, so the standard error of d is taken over clusters.  Let A_k and B_k be the summed
losses of cluster k of light i, and K the number of clusters.  By the delta method, log a_i − log b_i has the variance
K/(K−1) Σ_k (A_k/ΣA − B_k/ΣB)².
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from factorlib.inference.materials import Point
from factorlib.inference.problem import JointProblem
from factorlib.results.materials import Decision

LEAST_LOSS = 1e-4  # added to every loss, in σ² of the noise model: two losses far below it count as equal
# Thresholds, in standard errors.  Shadows are dropped only if the evidence is clearly against them.  Interreflection
# and tone curves need clear evidence.  Smaller cells obey the same prior as larger ones: one standard error is enough.
CLEARLY_AGAINST = -2.0
CLEARLY_FOR = 2.0
WEAKLY_FOR = 1.0


class Losses(NamedTuple):
    """Robust losses of each light's held-out observations, and their cluster numbers."""

    values: list[Float[np.ndarray, " n"]]
    clusters: list[Int[np.ndarray, " n"]]


def held_out_losses(problem: JointProblem, point: Point) -> Losses:
    """Return the losses of the held-out observations at a point; of every observation if none is held out."""
    none = problem.none_held_out
    judged = [block.take(block.held_out | none) for block in problem.blocks]
    return Losses(problem.held_out_losses(point), [block.clusters() for block in judged])


def compare_models(without: Losses, richer: Losses, least: float) -> Decision:
    """Compare two models: keep the richer one if d of (1) exceeds `least` standard errors.

    Without held-out observations the richer model is not kept.

    Args:
        without: Losses of the simpler model.
        richer: Losses of the richer model, of the same observations.
        least: Threshold in standard errors.

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
        # A_k and B_k, then log a_i − log b_i and its variance over clusters
        both = [np.bincount(cluster, losses + LEAST_LOSS) for losses in (a, b)]
        shares = [sums / max(float(sums.sum()), 1e-300) for sums in both]
        logs.append([np.log(np.mean(losses) + LEAST_LOSS) if len(losses) else 0.0 for losses in (a, b)])
        differences.append(logs[-1][0] - logs[-1][1])
        number = len(both[0])
        variances.append(number / max(number - 1, 1) * float(np.sum((shares[0] - shares[1]) ** 2)))
    share = counts / counts.sum()
    # d of (1) and its standard error
    d = float(share @ differences)
    error = float(np.sqrt(share**2 @ variances))
    margin = d / max(error, 1e-12)
    with_, without_ = (float(np.exp(share @ [pair[k] for pair in logs])) for k in (1, 0))
    return Decision(margin > least, with_, without_, margin)
