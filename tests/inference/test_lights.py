"""Lights on cells: what equal ones show, and what splitting keeps."""

import numpy as np
import pytest

from factorlib.inference.forward import Illumination
from factorlib.inference.lights import Light, fibonacci_cells
from factorlib.inference.splitting import LEAST_SPACING_DEG, SPLIT_CELLS
from factorlib.scenes.joint_problems import MATERIALS, block
from tests.inference.made_lights import OPERATOR, drawn, on_even_cells

DIRECTIONS = np.random.default_rng(1).normal(size=(2000, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def shown(light: Light, directions=DIRECTIONS) -> np.ndarray:
    return light.lobes.radiance(directions)


def smooth(cells: int) -> Light:
    return on_even_cells(
        np.array([[0.5], [0.3], [0.4]]) * (fibonacci_cells(cells).axis @ np.array([0.6, 0.8, 0.0]) + 1)
    )


@pytest.mark.parametrize("count", [200, 400])
def test_cells_of_equal_radiance_are_a_constant_light_but_for_a_ripple(count):
    radiance = shown(on_even_cells(np.zeros((3, count))))
    ripple = np.abs(radiance - 1)  # largest at the poles, where cells are least even
    assert radiance.std() < 0.03 and np.quantile(ripple, 0.99) < 0.1 and abs(radiance.mean() - 1) < 0.005


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_a_smooth_light_stays_when_cells_split_and_when_theirs_split_again(share):
    """Its energy does, and what surfaces reflect of it, but for the ripple of cells that are not where even ones would be."""
    light = smooth(200)
    some = np.random.default_rng(0).random(200) < share
    once = light.split(some)
    twice = once.split(once.sharpness > light.sharpness.max())
    for one, more in ((once, 3), (twice, 15)):
        assert len(one) == pytest.approx(200 + more * some.sum(), rel=0.05)
    spheres = block("room", light, MATERIALS, [0, 1, 2], OPERATOR, size=14)
    before = Illumination(spheres, light, MATERIALS, OPERATOR).radiance()
    rough = MATERIALS.roughness[spheres.material] > 0.3
    for one, ripple in ((once, 0.04), (twice, 0.06)):
        np.testing.assert_allclose(one.energy.sum(0), light.energy.sum(0), rtol=0.02)
        np.testing.assert_allclose(np.linalg.norm(one.axis, axis=1), 1, rtol=1e-12)
        off = np.log(Illumination(spheres, one, MATERIALS, OPERATOR).radiance() / before)
        assert off[rough].std() < 0.01 and off[~rough].std() < ripple, (off[rough].std(), off[~rough].std())


@pytest.mark.parametrize("scattered", [False, True])
def test_split_cells_leave_no_dark_or_bright_spots(scattered):
    """Of a constant light, at the most unfavourable direction and on average, split three times around one direction or here and there."""
    light, rng = on_even_cells(np.zeros((3, 400))), np.random.default_rng(0)
    for _ in range(3):
        near = np.argsort(-light.axis @ [0.6, 0.0, 0.8])[: 100 if scattered else 24]
        light = light.split(np.isin(np.arange(len(light)), rng.permutation(near)[:24]))
        light = light.with_log_radiance(np.zeros((3, len(light))))
    there = np.array([0.6, 0.0, 0.8]) + 0.4 * DIRECTIONS
    radiance = shown(light, there / np.linalg.norm(there, axis=1, keepdims=True))
    assert radiance.std() < 0.1 and radiance.min() > 0.45 and radiance.max() < 1.3


def test_the_brightest_split_but_none_that_is_too_small():
    light, how = on_even_cells(drawn(1, 200)), (SPLIT_CELLS, 2 * np.radians(LEAST_SPACING_DEG))
    which = light.brightest_cells(*how)
    assert which.sum() == SPLIT_CELLS and light.energy.sum(1)[which].min() >= light.energy.sum(1)[~which].max()
    for _ in range(8):
        light = light.split(light.brightest_cells(*how))
    assert np.degrees(2 / np.sqrt(light.sharpness)).min() > LEAST_SPACING_DEG
    assert on_even_cells(np.zeros((3, 12))).brightest_cells(*how).all()
