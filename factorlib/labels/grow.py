"""Labels grown from strokes: a random walker over a photo, with the colours of each label as its prior.

A walker starts at a pixel, seldom crosses an edge of the photo, and stops at a stroke: the pixel takes the label that it most likely
stops at (Grady 2006).  It also stops anywhere, at a label that has such colours there (Grady 2005).  The colours are learnt from the strokes,
a little from the first guess, and then twice more from the answer, as GrabCut does (Rother et al. 2004).
"""

from math import ceil

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage, sparse
from scipy.sparse.linalg import cg

MOST_PIXELS = 200_000  # that walkers walk on: about a second
ROUNDS = 3
BINS = 32  # of a channel, in a label's histogram of colours, which is smoothed by a Gaussian of one bin
FLOOR = 1e-7  # the probability of a colour that a label has nowhere
PRIOR = 0.05  # γ: how often a walker stops at a colour, against a step to a pixel like its own
GUESSED = 0.1  # the weight of the first guess's colours beside those of strokes, which may lie on a glint alone
CROSSING = 1e-3  # how often it crosses the strongest edge, likewise
BESIDE = 0.05  # of a box's longer side: what lies so near to it is looked at, too


def grow(
    box: tuple[int, int, int, int], fill: int, pixels: UInt8[np.ndarray, "h w 3"], label: UInt8[np.ndarray, "h w"],
    sure: Bool[np.ndarray, "h w"], most_pixels: int = MOST_PIXELS,
) -> UInt8[np.ndarray, "h w"]:  # fmt: skip
    """The labels of a picture, grown inside a box from those of `sure` pixels, which stay, and of pixels beside the box.

    box: first column, first row, and those behind the last;  fill: the label of the box;  pixels: sRGB-encoded;  label: inside, a first
    guess.  Background, `fill` and the labels of sure pixels grow.  Any other is of another object: it stays, and counts as background, where
    most of it lies beyond the box; elsewhere `fill` takes its place.
    A box of more than `most_pixels` is averaged down by a whole factor, and the answer interpolated.
    """
    x0, y0, x1, y1 = box
    inside = np.zeros_like(sure)
    inside[y0:y1, x0:x1] = True
    stays = ~inside
    for kind in set(np.unique(label[inside]).tolist()) - {0, fill}:
        bodies = ndimage.label(label == kind)[0]
        pixels_of, pixels_in = np.bincount(bodies.ravel()), np.bincount(bodies[inside], minlength=bodies.max() + 1)
        stays |= (2 * pixels_in < pixels_of)[bodies] & (bodies > 0)
    own = np.isin(label, [0, fill, *np.unique(label[sure & ~stays])])
    sure = stays | (inside & sure)
    first = np.where(own, label, np.where(stays, 0, fill)).astype(np.uint8)
    result = np.where(sure, label, first)
    beside = max(4, round(BESIDE * max(x1 - x0, y1 - y0)))
    part = np.s_[max(0, y0 - beside) : y1 + beside, max(0, x0 - beside) : x1 + beside]
    pixels, label, sure = pixels[part], first[part], sure[part]
    factor = ceil((label.size / most_pixels) ** 0.5)
    some = np.s_[factor // 2 :: factor, factor // 2 :: factor]
    strokes = ndimage.maximum_filter(np.where(sure, label + 1.0, 0), factor)[some]  # thin ones count, too
    coarse, fixed = np.where(strokes > 0, strokes - 1, label[some]).astype(np.uint8), strokes > 0
    kinds = np.unique(coarse)
    if fixed.all() or len(kinds) == 1:
        return result
    colour = ndimage.uniform_filter(pixels / np.float32(255), (factor, factor, 0))[some]
    chances = _walk(colour, kinds, coarse, fixed).astype(np.float32)
    scale = (1, *(n / m for n, m in zip(label.shape, coarse.shape)))
    grown = kinds[ndimage.zoom(chances, scale, order=1, mode="nearest", grid_mode=True).argmax(axis=0)]
    result[part] = np.where(sure, result[part], grown)
    return result


def _walk(
    pixels: Float[np.ndarray, "h w 3"], kinds: UInt8[np.ndarray, " k"], label: UInt8[np.ndarray, "h w"],
    fixed: Bool[np.ndarray, "h w"],
) -> Float[np.ndarray, "k h w"]:  # fmt: skip
    """The probability of each of the labels `kinds` at each pixel: (L + γ) x = γ p beside strokes, x known in them."""
    number, colour, edges = np.arange(label.size).reshape(label.shape), pixels.reshape(-1, 3), []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        edges.append((number[here].ravel(), number[there].ravel()))
    one, other = np.concatenate(edges, axis=1)
    step = np.square(colour[one] - colour[other]).sum(axis=1)
    weight = np.exp(-step / max(2 * step.mean(), 1e-12)) + CROSSING
    weights = sparse.coo_array((weight, (one, other)), shape=(label.size, label.size)).tocsr()
    weights = weights + weights.T
    laplacian = (sparse.diags_array(weights.sum(axis=1)) - weights).tocsr()  # L
    known, current = fixed.ravel(), label.ravel().copy()
    rows = laplacian[~known]
    system, beside = rows[:, ~known] + PRIOR * sparse.eye_array((~known).sum()), rows[:, known]
    scale = sparse.diags_array(1 / system.diagonal())
    bins = np.ravel_multi_index(tuple((colour.T * (BINS - 1)).round().astype(int)), (BINS,) * 3)
    chances = np.empty((len(kinds), label.size))
    learnt = known if np.isin(kinds, current[known]).all() else np.ones_like(known)
    for _ in range(ROUNDS):
        some, every = ([_histogram(bins[which & (current == kind)]) for kind in kinds] for which in (learnt, True))
        prior = (np.array(some) + GUESSED * np.array(every))[:, bins]  # p
        prior /= prior.sum(axis=0)
        for k, kind in enumerate(kinds):
            chances[k, known] = current[known] == kind
            right = PRIOR * prior[k, ~known] - beside @ chances[k, known]
            chances[k, ~known], _ = cg(system, right, rtol=1e-3, M=scale)
        current, learnt = kinds[chances.argmax(axis=0)], np.ones_like(known)
    return chances.reshape(-1, *label.shape)


def _histogram(bins: np.ndarray) -> Float[np.ndarray, " b"]:
    counts = np.bincount(bins, minlength=BINS**3).reshape((BINS,) * 3).astype(float)
    counts = ndimage.gaussian_filter(counts, 1.0, mode="constant").ravel()
    return counts / max(counts.sum(), 1.0) + FLOOR
