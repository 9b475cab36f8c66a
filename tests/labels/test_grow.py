"""Labels grown from strokes, on pictures whose parts are known."""

import numpy as np
import pytest

from factorlib.labels.grow import grow

COLOURS = np.array([[90, 90, 90], [200, 40, 40], [150, 110, 60]])


def scene(size=60, noise=8.0):
    """A red disc on a thin brown stem, before grey; the truth's labels, its picture, and a box around both."""
    y, x = np.indices((size, size)) * 60 / size
    truth = np.where(np.hypot(x - 30, y - 22) < 14, 1, np.where((abs(x - 30) < 2) & (y > 30) & (y < 52), 2, 0))
    picture = COLOURS[truth] + np.random.default_rng(0).normal(0, noise, (size, size, 3))
    return truth.astype(np.uint8), picture.clip(0, 255).astype(np.uint8), tuple(k * size // 60 for k in (10, 4, 50, 56))


def clicked(truth, box):
    """What the page sends: the box filled with label 1, a click on each part."""
    label, sure, unit = np.zeros_like(truth), np.zeros(truth.shape, bool), len(truth) // 60
    label[box[1] : box[3], box[0] : box[2]] = 1
    for row, kind in ((22, 1), (45, 2)):
        at = np.s_[row * unit : (row + 2) * unit, 29 * unit : 31 * unit]
        label[at], sure[at] = kind, True
    return label, sure


@pytest.mark.parametrize("size, most, least", [(60, 10**6, 0.9), (240, 60 * 60, 0.75)])
def test_a_click_on_each_part_finds_the_parts(size, most, least):
    truth, picture, box = scene(size)
    found = grow(box, 1, picture, *clicked(truth, box), most)
    for kind in (1, 2):
        assert ((found == kind) & (truth == kind)).sum() > least * ((found == kind) | (truth == kind)).sum()
    assert np.array_equal(found, grow(box, 1, picture, *clicked(truth, box), most))


def test_a_box_alone_finds_what_is_of_another_colour():
    truth, picture, box = scene(noise=30.0)
    label, sure = clicked(truth, box)
    found = grow(box, 1, picture, np.minimum(label, 1), np.zeros_like(sure))
    assert ((found > 0) == (truth > 0)).mean() > 0.98 and set(np.unique(found)) == {0, 1}


def test_sure_pixels_and_what_is_beside_the_box_stay():
    truth, picture, box = scene()
    label, sure = clicked(truth, box)
    label[:3], label[50, 20], sure[50, 20] = 2, 1, True  # both wrong, but said
    twice, wide = picture.repeat(2, 0).repeat(2, 1), [each.repeat(2, 0).repeat(2, 1) for each in (label, sure)]
    wide[0][80, 40:44], wide[1][80, 40:44] = (1, 2, 1, 2), True  # finer than the walk
    assert np.array_equal(grow(tuple(2 * k for k in box), 1, twice, *wide, 3600)[80, 40:44], (1, 2, 1, 2))
    found = grow(box, 1, picture, label, sure)
    outside = np.ones_like(sure)
    outside[box[1] : box[3], box[0] : box[2]] = False
    assert np.array_equal(found[sure | outside], label[sure | outside])
    assert np.array_equal(grow(box, 1, picture, label, np.ones_like(sure)), label)


def test_another_object_keeps_its_labels_and_lends_them_to_none():
    """A grey ball before grey, and one that is partly red and partly grey as well, which reaches into its box, is labelled 2, and was mended by the brush there."""
    y, x = np.indices((60, 90))
    truth = np.where(np.hypot(x - 30, y - 30) < 14, 1, np.where(np.hypot(x - 60, y - 30) < 17, 2, 0)).astype(np.uint8)
    picture = np.array([[90, 90, 90], [120, 120, 120], [200, 40, 40]], np.uint8)[np.where(x > 70, truth, truth > 0)]
    box, label, sure = (12, 12, 48, 48), np.where(truth == 2, 2, 0).astype(np.uint8), (truth == 2) & (x < 47)
    inside = np.s_[12:48, 12:48]
    label[inside] = np.where(label[inside] > 0, label[inside], 1)
    for marked in (sure, np.zeros_like(sure)):
        assert (grow(box, 1, picture, label, marked) == truth).mean() > 0.99
    wrong = np.where(truth == 1, 2, 0).astype(np.uint8)  # the box was drawn with another label before
    assert (grow(box, 1, picture, wrong, np.zeros_like(sure)) == np.where(truth == 1, 1, 0))[truth < 2].mean() > 0.99
