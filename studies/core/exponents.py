"""How a cost grows: the exponent of a power law, with its interval over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from studies.core.statistics import spread
from studies.core.table import Spread

LINEAR = (
    0.9,
    1.1,
)  # an interval within it is called linear: from 9 entries to 1,600 the cost is then within a factor 1.7 of proportion


def exponent(costs: Mapping[float, float]) -> float:
    """Slope of log cost over log size, by least squares.

    >>> round(exponent({10: 3.0, 100: 30.0, 1000: 300.0}), 6)
    1.0
    """
    return float(np.polyfit(np.log(list(costs)), np.log(list(costs.values())), 1)[0])


def exponents(costs: Mapping[float, Mapping[int, float]], seeds: Sequence[int]) -> Spread:
    """One exponent a seed, over sizes; costs: by size, then by seed."""
    return spread([exponent({size: of[seed] for size, of in costs.items()}) for seed in seeds])


def called(found: Spread) -> str:
    """What an exponent's interval shows.

    >>> called(Spread(1.0, 5, 0.01, 0.97, 1.03)), called(Spread(1.3, 5, 0.01, 1.28, 1.32)), called(Spread(1.1, 5, 0.1, 0.97, 1.23))
    ('linear', 'more than linear', 'not decided')
    """
    if found.low is None:
        return "not decided"
    if LINEAR[0] <= found.low and found.high <= LINEAR[1]:
        return "linear"
    return "less than linear" if found.high < 1 else "more than linear" if found.low > 1 else "not decided"
