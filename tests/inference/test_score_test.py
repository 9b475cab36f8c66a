"""The score test predicts what a fit of an effect would gain, at the price of gradients."""

import msgspec
import numpy as np
import pytest

from factorlib.inference.fit import FitSchedule
from factorlib.inference.fit_runner import FitRunner
from factorlib.inference.model_selection import PLAUSIBLE
from factorlib.inference.problem import JointProblem
from factorlib.inference.score_test import EffectTerms, ScoreTest
from tests.inference.made_lights import OPERATOR, PRIOR, begun
from tests.inference.test_model_selection import photographed_at

BEGINNING = FitSchedule(light_steps=2, descents=(4,))


def near(illumination, curvature):
    light = msgspec.structs.replace(illumination.light, curvature=curvature)
    return msgspec.structs.replace(illumination, light=light, table=None)


def fitted(*curvatures):
    """A problem with lights of these curvatures, and its fit with all of them far."""
    problem = JointProblem(photographed_at(*curvatures), OPERATOR)
    return problem, FitRunner().fit("trial", problem, begun(problem, 60), BEGINNING)


@pytest.fixture(scope="module")
def of_three():
    return ScoreTest(*fitted(0.2, 0.0, 0.1), PRIOR)


def test_it_tells_near_lights_from_far_ones(of_three):
    factor, size = np.array(of_three.of_each_light(near, 0.05, 0.5)).T
    assert factor[[0, 2]].min() > 100 > PLAUSIBLE > factor[1], factor
    assert size == pytest.approx([0.2, 0.0, 0.1], abs=0.05)
    far, _ = np.array(ScoreTest(*fitted(0.0, 0.0), PRIOR).of_each_light(near, 0.05, 0.5)).T
    assert (far >= 0).all() and far.max() < PLAUSIBLE, far


def test_an_effect_that_changes_nothing_gains_nothing(of_three):
    assert all(each.log_bayes_factor < 1e-6 for each in of_three.of_each_light(lambda one, size: one, 0.1, 1.0))


def test_a_quadratic_is_minimised_exactly(of_three):
    """Held to the dense system of all unknowns and sizes, of which the test eliminates all but the sizes."""
    rng, test = np.random.default_rng(0), of_three
    lights = [len(each.by_light) for each in test.gradients]
    ends = np.cumsum([21, *lights])[:-1]
    # H⁻¹ column by column, on the unknowns that are not at a limit
    columns = []
    for unit in np.eye(21 + sum(lights)):
        step, steps = test.arrow.solve(*(lambda first, *rest: (first, rest))(*np.split(unit, ends)))
        columns.append(np.concatenate([step, *steps]))
    free = np.append(np.isin(np.arange(21), test.arrow.free), np.ones(sum(lights), bool))
    hessian = np.linalg.inv(np.array(columns).T[np.ix_(free, free)])
    g = np.concatenate([test.material_gradient, *(each.by_light for each in test.gradients)])[free]
    terms, vectors = [], np.zeros((3, len(free)))
    for k, first in enumerate(ends):
        of_materials, of_light = rng.normal(size=21), rng.normal(size=lights[k])
        vectors[k, :21], vectors[k, first : first + lights[k]] = of_materials, of_light
        bend = float(vectors[k][free] @ np.linalg.solve(hessian, vectors[k][free]))
        terms.append(EffectTerms(-9.0 * bend, 4 * bend, of_materials, of_light))
    B, c, slope = (
        vectors[:, free],
        np.diag([each.curvature for each in terms]),
        np.array([each.slope for each in terms]),
    )

    def lowest(used):
        """The least of F with some effects, relative to F."""
        whole, ends = np.block([[hessian, B[used].T], [B[used], c[np.ix_(used, used)]]]), slope[used]
        return -np.append(g, ends) @ np.linalg.solve(whole, np.append(g, ends))

    for k, each in enumerate(test.predict(terms, np.inf)):
        others = [j for j in range(3) if j != k]
        gain = (lowest(others) - lowest([0, 1, 2])) / 2
        assert each.size > 0 and each.log_bayes_factor == pytest.approx(gain, rel=1e-4)
