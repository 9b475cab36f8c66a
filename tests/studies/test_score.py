"""Scores do not depend on what no observation tells."""

import numpy as np
import pytest

from factorlib.evaluate.ball import Light, constant_light
from factorlib.results.materials import Reflectance
from studies.core.case import NAMES, Case
from studies.core.score import Pictures, in_true_gauge
from studies.core.world import materials_of

CASE = Case(0, ((0, 0), (1, 0), (2, 1)), 10)  # two components
COMPONENT = {NAMES[0]: 0, NAMES[1]: 0, NAMES[2]: 1}
TRUTHS = materials_of(0)
LIGHTS = {li: constant_light(np.array([1.0, 0.8, 0.5]) * (1 + li)) for li in range(2)}


def times(material, factor):
    return Reflectance(tuple(np.array(material.diffuse) * factor), tuple(np.array(material.specular) * factor), material.roughness)


def answer(factors, roughness=0.0):
    """The truth, each component's materials times a factor per channel, its lights divided by it."""
    table = {n: times(TRUTHS[n], factors[c]) for n, c in COMPONENT.items()}
    table = {n: Reflectance(m.diffuse, m.specular, min(1.0, m.roughness + roughness)) for n, m in table.items()}
    lights = {li: Light(tuple(level / factors[li] for level in light.levels)) for li, light in LIGHTS.items()}
    return in_true_gauge(CASE, table, lights, TRUTHS, COMPONENT)


ONES, FACTORS = np.ones((2, 3)), np.array([[0.5, 0.7, 0.9], [0.3, 0.9, 0.6]])


def test_the_truth_in_any_gauge_scores_nothing():
    values, nulls = Pictures(CASE, answer(FACTORS), TRUTHS, LIGHTS).scores()
    assert max(values.values()) < 1e-6 < 1e-3 < min(nulls["entries"], nulls["new_light"])
    assert {"observed", "unobserved", "first_material", "first_light"} <= values.keys()


def test_an_error_scores_the_same_in_any_gauge():
    plain, scaled = (Pictures(CASE, answer(f, 0.2), TRUTHS, LIGHTS).scores()[0] for f in (ONES, FACTORS))
    assert plain == pytest.approx(scaled, rel=1e-3) and plain["new_light"] > 1e-5
