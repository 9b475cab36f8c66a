"""The gauge depends on what lights send, not on how lobes make it up."""

import numpy as np

from factorlib.light.lobes import lobe_integral
from factorlib.model.gauge import BRIGHTEST, in_gauge
from factorlib.model.lights import Light
from factorlib.model.point import Point
from factorlib.reflection import reflection_operator
from studies.scenes.problems import MATERIALS, block, random_light


def test_a_lobe_made_sharper_at_its_energy_moves_no_tint():
    light = random_light(np.random.default_rng(2), 4)
    data = block("room", light, MATERIALS, [0, 1, 2], reflection_operator("closed_form"), size=8)
    sharper = light.log_sharpness + np.array([2.0, 0, 0, 0])
    kept = lobe_integral(light.sharpness) / lobe_integral(np.exp(sharper))
    other = Light(light.axis, sharper, light.weight * kept[:, None], light.log_exposure)
    first, second = (in_gauge(Point(MATERIALS, [li]), [data]).materials for li in (light, other))
    np.testing.assert_allclose(first.vector(), second.vector(), rtol=1e-12)
    assert abs((first.diffuse + first.specular).max() - BRIGHTEST) < 1e-12


def test_a_single_light_comes_out_grey():
    light = random_light(np.random.default_rng(2), 4)
    data = block("room", light, MATERIALS, [0, 1, 2], reflection_operator("closed_form"), size=8)
    (grey,) = in_gauge(Point(MATERIALS, [light]), [data]).lights
    np.testing.assert_allclose(grey.energy.sum(0) / grey.energy.sum(), 1 / 3, rtol=1e-9)
