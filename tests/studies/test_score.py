"""Scores do not depend on what no observation tells, of spheres or of objects; pictures show what is scored."""

import numpy as np
import pytest

from factorlib.evaluate.ball import Light, constant_light
from factorlib.evaluate.gauge import connected_components
from factorlib.results.materials import Reflectance
from studies.core.case import Case, light_name
from studies.core.gauge import in_true_gauge, times
from studies.core.objects import world as of_seven
from studies.core.objects.case import ObjectsCase
from studies.core.objects.show import matrix
from studies.core.score import Pictures
from studies.core.world import materials_of

LIGHTS = {li: constant_light(np.array([1.0, 0.8, 0.5]) * (1 + li)) for li in range(3)}
CASES = [  # two components each; objects with the two materials that spheres do not have
    (Case(0, ((0, 0), (1, 0), (2, 1)), 10), materials_of(0)),
    (ObjectsCase(0, ((5, 0), (6, 0), (2, 1)), 10), of_seven.materials_of(0)),
]
ONES, FACTORS = np.ones((2, 3)), np.array([[0.5, 0.7, 0.9], [0.3, 0.9, 0.6]])


def pictures(case, truths, factors, roughness=0.0):
    """The truth, each component's materials times a factor per channel, its lights divided by it."""
    component = connected_components({light_name(li): case.names_in(li) for li in case.lights})
    table = {n: times(truths[n], factors[c]) for n, c in component.items()}
    table = {n: Reflectance(m.diffuse, m.specular, min(1.0, m.roughness + roughness)) for n, m in table.items()}
    factor = {li: factors[component[case.names_in(li)[0]]] for li in case.lights}
    lights = {li: Light(tuple(level / factor[li] for level in LIGHTS[li].levels)) for li in case.lights}
    return Pictures(case, in_true_gauge(case, table, lights, truths, component), truths, LIGHTS)


@pytest.mark.parametrize("case, truths", CASES)
def test_the_truth_in_any_gauge_scores_nothing(case, truths):
    score = pictures(case, truths, FACTORS).score()
    assert max(score.values.values()) < 1e-6
    assert {"entries", "observed", "unobserved", "new_light", "new_material", "first_light"} == score.values.keys() - {
        "first_material"
    }
    assert min(error for measure, error in score.nulls.items() if measure != "new_material") > 1e-3, (
        "these lights are constant, as its null's"
    )


@pytest.mark.parametrize("case, truths", CASES)
def test_an_error_scores_the_same_in_any_gauge_and_pictures_show_it(case, truths):
    plain, scaled = (pictures(case, truths, factors, 0.2) for factors in (ONES, FACTORS))
    values = plain.score().values
    assert values == pytest.approx(scaled.score().values, rel=1e-3) and values["new_light"] > 1e-5
    true, found = (matrix(plain, of).astype(int) for of in (True, False))
    assert true.shape == found.shape == (3 * 70, 2 * 70, 3) and np.abs(true - found).max() > 5


def test_the_null_of_a_part_is_of_its_entries():
    nulls = pictures(Case(0, ((0, 0), (0, 1), (1, 1)), 10), materials_of(0), ONES).score().nulls
    assert nulls["entries"] == pytest.approx((3 * nulls["observed"] + nulls["unobserved"]) / 4)
    assert nulls["observed"] != pytest.approx(nulls["unobserved"], rel=0.01)


def test_material_0_has_a_score_where_it_is_seen():
    seen, unseen = (pictures(case, truths, ONES).score().values for case, truths in CASES)
    assert "first_material" in seen and "first_material" not in unseen
