"""Number of colours of a material's pixels: modes of the histogram of their chromaticities.

Shading and highlights spread a colour, and do not split it.  Paint of two colours leaves a valley between two modes.
"""

import numpy as np
from jaxtyping import Float
from scipy import ndimage

# Chosen on data/eames and two real sets of one colour a mask, which have 1, and on a painted figure, which has 2 or 3
# in each of ten photos.
DARK = 0.1  # least value of the largest channel, in units of the 90th percentile: darker pixels are noise
FAINT = 0.01  # least value of the smallest channel, in the same units
LEAST_PIXELS = 500
BINS = np.linspace(-3, 3, 61)  # bins of log(R/G) and log(B/G)
SHARE = 0.1  # least share of the pixels that a mode holds
VALLEY = 4.0  # least ratio of a mode's peak to the valley around it
LEVELS = 0.8 ** np.arange(30)  # levels that are tried, in units of the highest peak


def count_colours(radiance: Float[np.ndarray, "n 3"]) -> int:
    """Return the number of colours among linear radiances that are not clipped; 1 for too few of them."""
    largest = radiance.max(axis=1, initial=0)
    white = np.quantile(largest, 0.9) if len(largest) else 0.0
    bright = radiance[(largest > DARK * white) & (radiance.min(axis=1, initial=np.inf) > FAINT * white)]
    if len(bright) < LEAST_PIXELS:
        return 1
    ratios = np.log(bright[:, [0, 2]] / bright[:, [1]])
    counts = np.histogram2d(ratios[:, 0], ratios[:, 1], bins=BINS)[0]
    density = ndimage.gaussian_filter(counts / len(bright), 1.0, mode="constant")
    modes = [1]
    for level in density.max() * LEVELS:
        pieces, number = ndimage.label(density >= level, np.ones((3, 3)))
        index = np.arange(1, number + 1)
        large = ndimage.sum(density, pieces, index) >= SHARE
        modes.append(int(np.sum(large & (ndimage.maximum(density, pieces, index) >= VALLEY * level))))
    return max(modes)
