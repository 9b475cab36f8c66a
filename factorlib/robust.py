"""Statistics that are robust to outliers."""

import numpy as np
from jaxtyping import Float

TINY = 1e-300  # keeps a denominator or the argument of a logarithm above 0
PER_MEDIAN = 1.4826  # σ over the median of |x| for a normal x of mean 0


def robust_deviation(residual: Float[np.ndarray, "*n"]) -> float:
    """Return the standard deviation of residuals of mean 0, from the median of their absolute values; NaN for none.

    This is the median absolute deviation about 0 (scipy.stats.median_abs_deviation is about the median), scaled for
    normal residuals (P. J. Huber, Robust Statistics, 1981, section 5.1).

    >>> robust_deviation(np.array([-1.0, 2.0, -1000.0]))
    2.9652
    """
    return PER_MEDIAN * float(np.median(np.abs(residual)))
