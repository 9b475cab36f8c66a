"""Growth of labels from strokes: a random walker on a photo, with the colours of each label as its prior.

A walker starts at a pixel, seldom crosses an edge of the photo, and stops at a stroke. The pixel gets the label at
which it most likely stops (Grady 2006). It may also stop anywhere, at a label that has such colours (Grady 2005). The
colours are learnt from the strokes, a little from the first guess, and then twice more from the result, as in GrabCut
(Rother et al. 2004).

scikit-image's random walker has no prior on colours, and needs a stroke of every label: a box alone gives none.
"""

from math import ceil

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage, sparse
from scipy.sparse.linalg import cg

MOST_PIXELS = 200_000  # greatest number of pixels of the random walk, which takes about a second
ROUNDS = 3  # number of rounds of learning colours
BINS = 32  # number of bins per channel of a label's histogram, which is smoothed by a Gaussian of one bin
FLOOR = 1e-7  # probability of a colour that a label does not have
PRIOR = 0.05  # γ: rate of stopping at a colour, relative to a step to a pixel of the same colour
GUESSED = 0.1  # weight of the first guess's colours beside those of strokes, which may be on a highlight only
CROSSING = 1e-3  # rate of crossing the strongest edge, relative to the same step
BESIDE = 0.05  # margin around the box that is included, in units of its longer side


def grow(
    box: tuple[int, int, int, int],
    fill: int,
    pixels: UInt8[np.ndarray, "h w 3"],
    label: UInt8[np.ndarray, "h w"],
    sure: Bool[np.ndarray, "h w"],
    most_pixels: int = MOST_PIXELS,
) -> UInt8[np.ndarray, "h w"]:
    """Grow the labels of a picture inside a box.

    They grow from the labels of `sure` pixels, which are fixed, and of pixels beside the box.
    Background, `fill` and the labels of sure pixels grow. Any other label belongs to another object. If most of a
    connected region of it lies outside the box, the region is fixed and counts as background; otherwise `fill` replaces
    it. A box of more than `most_pixels` is downsampled by a whole factor, and the result is interpolated.

    Args:
        box: First column and row, and the column and row after the last.
        fill: Label of the box.
        pixels: Photo, sRGB-encoded.
        label: Labels; inside the box, a first guess.
        sure: Mask of fixed pixels.
        most_pixels: Greatest number of pixels of the random walk.
    """
    x0, y0, x1, y1 = box
    guess, sure = _guess(box, fill, label, sure)
    result = np.where(sure, label, guess)
    margin = max(4, round(BESIDE * max(x1 - x0, y1 - y0)))
    part = np.s_[max(0, y0 - margin) : y1 + margin, max(0, x0 - margin) : x1 + margin]
    pixels = pixels[part]
    label = guess[part]
    sure = sure[part]
    factor = ceil((label.size / most_pixels) ** 0.5)
    sampled = np.s_[factor // 2 :: factor, factor // 2 :: factor]
    # downsample labels and colours; the maximum keeps thin strokes
    strokes = ndimage.maximum_filter(np.where(sure, label + 1.0, 0), factor)[sampled]
    coarse = np.where(strokes > 0, strokes - 1, label[sampled]).astype(np.uint8)
    fixed = strokes > 0
    kinds = np.unique(coarse)
    if fixed.all() or len(kinds) == 1:
        return result
    colour = ndimage.uniform_filter(pixels / np.float32(255), (factor, factor, 0))[sampled]
    chances = _walk(colour, kinds, coarse, fixed).astype(np.float32)
    scale = (1, *(n / m for n, m in zip(label.shape, coarse.shape)))
    grown = kinds[ndimage.zoom(chances, scale, order=1, mode="nearest", grid_mode=True).argmax(axis=0)]
    result[part] = np.where(sure, result[part], grown)
    return result


def _guess(
    box: tuple[int, int, int, int], fill: int, label: UInt8[np.ndarray, "h w"], sure: Bool[np.ndarray, "h w"]
) -> tuple[UInt8[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Return the labels from which the walk starts, and the mask of pixels that keep the label of the picture."""
    x0, y0, x1, y1 = box
    inside = np.zeros_like(sure)
    inside[y0:y1, x0:x1] = True
    fixed = ~inside
    # fix the connected regions of other labels that lie mostly outside the box
    for kind in set(np.unique(label[inside]).tolist()) - {0, fill}:
        regions = ndimage.label(label == kind)[0]
        sizes = np.bincount(regions.ravel())
        sizes_inside = np.bincount(regions[inside], minlength=regions.max() + 1)
        fixed |= (2 * sizes_inside < sizes)[regions] & (regions > 0)
    growing = np.isin(label, [0, fill, *np.unique(label[sure & ~fixed])])
    return np.where(growing, label, np.where(fixed, 0, fill)).astype(np.uint8), fixed | (inside & sure)


def _walk(
    pixels: Float[np.ndarray, "h w 3"],
    kinds: UInt8[np.ndarray, " k"],
    label: UInt8[np.ndarray, "h w"],
    fixed: Bool[np.ndarray, "h w"],
) -> Float[np.ndarray, "k h w"]:
    """Return the probability of each of the labels `kinds` at each pixel.

    Outside strokes it solves (L + γ) x = γ p with x fixed at strokes, where L is the graph Laplacian and p the prior.
    """
    number = np.arange(label.size).reshape(label.shape)
    colour = pixels.reshape(-1, 3)
    first = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    second = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    # L, with weights that fall with the difference of colours between neighbours
    step = np.square(colour[first] - colour[second]).sum(axis=1)
    weight = np.exp(-step / max(2 * step.mean(), 1e-12)) + CROSSING
    weights = sparse.coo_array((weight, (first, second)), shape=(label.size, label.size)).tocsr()
    weights = weights + weights.T
    laplacian = (sparse.diags_array(weights.sum(axis=1)) - weights).tocsr()
    known = fixed.ravel()
    current = label.ravel().copy()
    # system of the unknown pixels, with the diagonal as preconditioner
    rows = laplacian[~known]
    system = rows[:, ~known] + PRIOR * sparse.eye_array((~known).sum())
    coupling = rows[:, known]
    scale = sparse.diags_array(1 / system.diagonal())
    bins = np.ravel_multi_index(tuple((colour.T * (BINS - 1)).round().astype(int)), (BINS,) * 3)
    chances = np.empty((len(kinds), label.size))
    learnt = known if np.isin(kinds, current[known]).all() else np.ones_like(known)
    for _ in range(ROUNDS):
        # p from the histograms of colours, then (L + γ) x = γ p for each label
        prior = np.array(
            [
                _histogram(bins[learnt & (current == kind)]) + GUESSED * _histogram(bins[current == kind])
                for kind in kinds
            ]
        )[:, bins]
        prior /= prior.sum(axis=0)
        for k, kind in enumerate(kinds):
            chances[k, known] = current[known] == kind
            right = PRIOR * prior[k, ~known] - coupling @ chances[k, known]
            chances[k, ~known], _ = cg(system, right, rtol=1e-3, M=scale)
        current = kinds[chances.argmax(axis=0)]
        learnt = np.ones_like(known)
    return chances.reshape(-1, *label.shape)


def _histogram(bins: np.ndarray) -> Float[np.ndarray, " b"]:
    """Return the smoothed, normalised histogram of colours."""
    counts = np.bincount(bins, minlength=BINS**3).reshape((BINS,) * 3).astype(float)
    counts = ndimage.gaussian_filter(counts, 1.0, mode="constant").ravel()
    return counts / max(counts.sum(), 1.0) + FLOOR
