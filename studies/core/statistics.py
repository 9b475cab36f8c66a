"""Seeds summed up: a mean with its interval, and whether two settings differ.

Interval    mean ± t · s / √n, Student's t of n − 1 degrees of freedom, s the standard deviation over n seeds: 95 %.
Difference  of two settings, seed by seed, because a seed shows the same materials in the same lights in both.  It is called shown
            where the interval of the mean difference, and its sign, leave no doubt: the interval excludes 0 at 95 % for
            all comparisons of a study together (Bonferroni: each at 1 − .05 / comparisons), over at least `LEAST_SEEDS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import t as student

from studies.core.table import Difference, Spread

LEAST_SEEDS = 5
DOUBT = 0.05


def spread(values: Sequence[float], doubt: float = DOUBT) -> Spread:
    """The mean and its interval of 1 − doubt.

    >>> s = spread([1.0, 2.0, 3.0])
    >>> s.mean, s.deviation, round(s.high - s.mean, 3)
    (2.0, 1.0, 2.484)
    """
    n, mean = len(values), float(np.mean(values))
    if n < 2:
        return Spread(mean, n)
    deviation = float(np.std(values, ddof=1))
    half = float(student.ppf(1 - doubt / 2, n - 1)) * deviation / n**0.5
    return Spread(mean, n, deviation, mean - half, mean + half)


def difference(first: Mapping[int, float], second: Mapping[int, float], comparisons: int = 1) -> Difference:
    """Of a measure by seed in two settings; comparisons: how many the study makes.  Raises ValueError where no seed has both.

    >>> better = {seed: 0.1 + 0.001 * seed for seed in range(5)}
    >>> difference(better, {seed: 0.2 for seed in range(5)}).verdict
    'lower'
    """
    seeds = sorted(first.keys() & second.keys())
    if not seeds:
        raise ValueError("no seed has both")
    found = spread([first[seed] - second[seed] for seed in seeds], DOUBT / comparisons)
    if found.seeds < LEAST_SEEDS:
        return Difference(found, "too few seeds")
    if found.low <= 0 <= found.high:
        return Difference(found, "not shown")
    return Difference(found, "lower" if found.mean < 0 else "higher")
