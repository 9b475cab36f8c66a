"""Lights on cells: what equal ones show, and what splitting keeps."""

import numpy as np
import pytest

from benchmarks.solve.problems import MATERIALS, block
from factorlib.light.lobes import Lobes
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light, even_cells, tangents
from factorlib.solve.solve import SMALLEST, SPLIT, brightest, on_cells
from tests.solve.made import OPERATOR, drawn, on_even_cells

DIRECTIONS = np.random.default_rng(1).normal(size=(2000, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def shown(light: Light, directions=DIRECTIONS) -> np.ndarray:
    return Lobes(light.axis, light.sharpness, light.weight).radiance(directions)


def smooth(cells: int) -> Light:
    return on_even_cells(np.array([[0.5], [0.3], [0.4]]) * (even_cells(cells).axis @ np.array([0.6, 0.8, 0.0]) + 1))


@pytest.mark.parametrize("count", [200, 400])
def test_cells_of_equal_radiance_are_a_constant_light_but_for_a_ripple(count):
    radiance = shown(on_even_cells(np.zeros((3, count))))
    ripple = np.abs(radiance - 1)  # largest at the poles, where cells are least even
    assert radiance.std() < 0.03 and np.quantile(ripple, 0.99) < 0.1 and abs(radiance.mean() - 1) < 0.005, (radiance.std(), ripple.max())


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_a_smooth_light_stays_when_cells_split_and_when_theirs_split_again(share):
    """Its energy does; so does what surfaces reflect of it, but for the ripple of cells that are not where even ones would be."""
    light = smooth(200)
    some = np.random.default_rng(0).random(200) < share
    once = light.split(some)
    twice = once.split(np.arange(len(once)) >= len(once) - 4 * int(some.sum()))
    assert len(once) == 200 + 3 * some.sum() and len(twice) == 200 + 15 * some.sum()
    spheres = block("room", light, MATERIALS, [0, 1, 2], OPERATOR, size=14)
    before, rough = Illumination(spheres, light, MATERIALS, OPERATOR).radiance(), MATERIALS.roughness[spheres.material] > 0.3
    for one, ripple in ((once, 0.04), (twice, 0.06)):
        np.testing.assert_allclose(one.energy.sum(0), light.energy.sum(0), rtol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(one.axis, axis=1), 1, rtol=1e-12)
        off = np.log(Illumination(spheres, one, MATERIALS, OPERATOR).radiance() / before)
        assert off[rough].std() < 0.01 and off[~rough].std() < ripple, (off[rough].std(), off[~rough].std())


def test_four_stand_where_one_stood_with_its_radiance_and_its_middle():
    light, which = on_even_cells(drawn(0, 60)), np.arange(60) % 7 == 3
    split, kept = light.split(which), (~which).sum()
    for name in ("axis", "log_sharpness", "weight"):
        np.testing.assert_array_equal(getattr(split, name)[:kept], getattr(light, name)[~which])
    four = split.axis[kept:].reshape(4, -1, 3)
    middle = four.mean(0) / np.linalg.norm(four.mean(0), axis=1, keepdims=True)
    np.testing.assert_allclose(middle, light.axis[which], atol=1e-12)
    np.testing.assert_allclose(split.sharpness[kept:].reshape(4, -1), np.tile(4 * light.sharpness[which], (4, 1)))
    np.testing.assert_allclose(split.log_radiance[:, kept:].reshape(3, 4, -1), np.repeat(light.log_radiance[:, None, which], 4, axis=1))
    apart = np.arccos((four[0] * four[1]).sum(1))
    np.testing.assert_allclose(apart, 1 / np.sqrt(light.sharpness[which]), rtol=0.05)  # half a spacing
    np.testing.assert_array_equal(split.axis, light.split(which).axis)


def test_tangents_are_perpendicular_and_unit():
    first, second = tangents(DIRECTIONS)
    frame = np.stack([DIRECTIONS, first, second], axis=1)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (len(DIRECTIONS), 1, 1)), atol=1e-12)


def test_the_brightest_split_but_none_that_is_too_small():
    light = on_even_cells(drawn(1, 200))
    which = brightest(light)
    assert which.sum() == SPLIT and light.energy.sum(1)[which].min() >= light.energy.sum(1)[~which].max()
    for _ in range(8):
        light = light.split(brightest(light))
    assert np.degrees(2 / np.sqrt(light.sharpness)).min() > SMALLEST
    assert brightest(on_even_cells(np.zeros((3, 12)))).all()


@pytest.mark.parametrize("cells", [120, 200, 400])
def test_other_cells_show_the_same_smooth_light(cells):
    light = smooth(200)
    other = on_cells(light, cells)
    assert len(other) == cells and np.abs(np.log(shown(other) / shown(light))).mean() < 0.05
    np.testing.assert_allclose(light.with_log_radiance(light.log_radiance).weight, light.weight, rtol=1e-12)
