"""Cells split where the marginal likelihood supports it: around a sharp lamp, and not in a light without one."""

import numpy as np
import pytest

from factorlib.inference import splitting
from factorlib.inference.fit import FitSchedule, fit_problem
from factorlib.inference.fit_runner import FitRunner, SolveState
from factorlib.inference.model_selection import VERY_STRONG
from factorlib.inference.options import SolveOptions
from factorlib.inference.splitting import OBSERVATION_FACTOR, SPLIT_CELLS, split_cells
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made import none_held_out
from tests.inference.made_lights import PRIOR, begun, light_of, spheres

CELLS, SHOWN = 60, [1, 2]
ONCE = SolveOptions(splittings=1)


def lamp(x: float):
    """One sharper than any cell, in a room that is nearly dark."""
    return light_of([[x, -0.4, -0.75], [0, 0, 1.0]], [100, 1e-4], np.array([20, 0.3])[:, None] * np.ones(3))


CONSTANT = light_of([[0, 0, 1.0]], 1e-4, [[1.0, 1.0, 1.0]])


def fitted(lights):
    """The problem of some lights, and the state of a solve after its fit on cells of one size."""
    problem = spheres(lights, size=18, shown=SHOWN)
    fit = fit_problem(problem, begun(problem, CELLS), PRIOR, FitSchedule(4, (10, 8)))
    return problem, SolveState(fit, fit, observations=ONCE.observations)


def split(problem, state, options=ONCE):
    return split_cells(problem, state, options, FitRunner())


@pytest.fixture(scope="module")
def lamps():
    problem, state = fitted([lamp(0.5), lamp(-0.5)])
    return problem, state, split(problem, state)


def test_around_a_lamp_cells_split_and_what_they_hid_of_roughness_comes_out(lamps):
    problem, before, after = lamps
    (evidence,) = after.splitting
    assert evidence.accepted and evidence.log_bayes_factor > VERY_STRONG
    errors = [np.abs(state.fit.point.materials.roughness - MATERIALS.roughness)[SHOWN] for state in (before, after)]
    assert errors[1].sum() < 0.6 * errors[0].sum() and (errors[1] < errors[0]).all(), errors
    assert [len(light) for light in after.fit.point.lights] == pytest.approx([CELLS + 3 * SPLIT_CELLS] * 2, rel=0.1)
    assert problem.held_out_loss(after.fit.point) < problem.held_out_loss(before.fit.point)


def test_each_light_splits_by_its_own_evidence():
    problem, before = fitted([lamp(0.5), CONSTANT])
    after = split(problem, before)
    assert [len(light) > CELLS for light in after.fit.point.lights] == [True, False]


def test_a_constant_light_needs_no_finer_cells():
    problem, before = fitted([CONSTANT])
    after = split(problem, before)
    assert [decision.accepted for decision in after.splitting] == [False]
    assert after.fit is before.fit and after.observations == before.observations


@pytest.mark.parametrize(("threshold", "factor"), [(np.inf, OBSERVATION_FACTOR), (0.0, 1)])
def test_where_observations_are_explained_closely_more_of_them_are_fitted(lamps, monkeypatch, threshold, factor):
    problem, before, _ = lamps
    monkeypatch.setattr(splitting, "SMALL_LOSS", threshold)
    assert split(problem, before).observations == factor * before.observations


def test_evidence_needs_no_held_out_observations(lamps):
    problem, before, _ = lamps
    nothing_held_out = problem.with_blocks([none_held_out(block) for block in problem.blocks])
    assert split(nothing_held_out, before).splitting[0].accepted


def test_nothing_splits_if_no_splitting_is_allowed(lamps):
    problem, before, _ = lamps
    after = split(problem, before, SolveOptions(splittings=0))
    assert after.splitting == [] and after.fit is before.fit
