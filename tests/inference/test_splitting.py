"""Cells split where the marginal likelihood supports it: around a sharp lamp, and not in a light without one."""

import numpy as np
import pytest

from factorlib.inference import joint_solver
from factorlib.inference.fit import FitSchedule, fit_problem
from factorlib.inference.fit_runner import FitRunner, SolveState
from factorlib.inference.joint_solver import MATERIALS as JOINTLY
from factorlib.inference.joint_solver import OBSERVATION_FACTOR, SolveRequest, fit_materials
from factorlib.inference.model_selection import VERY_STRONG
from factorlib.inference.options import SolveOptions
from factorlib.inference.splitting import SPLIT_CELLS, split_cells
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made import none_held_out
from tests.inference.made_lights import PRIOR, begun, light_of, spheres

CELLS, SHOWN = 60, [1, 2]


def lamp(x: float):
    """One sharper than any cell, in a room that is nearly dark."""
    return light_of([[x, -0.4, -0.75], [0, 0, 1.0]], [100, 1e-4], np.array([20, 0.3])[:, None] * np.ones(3))


CONSTANT = light_of([[0, 0, 1.0]], 1e-4, [[1.0, 1.0, 1.0]])


def fitted(lights):
    """The problem of some lights, and its fit on cells of one size."""
    problem = spheres(lights, size=18, shown=SHOWN)
    return problem, fit_problem(problem, begun(problem, CELLS), PRIOR, FitSchedule(4, (10, 8)))


@pytest.fixture(scope="module")
def lamps():
    problem, fit = fitted([lamp(0.5), lamp(-0.5)])
    return problem, fit, split_cells("splitting", problem, fit, 1, FitRunner())


def test_around_a_lamp_cells_split_and_what_they_hid_of_roughness_comes_out(lamps):
    problem, before, (finer, (evidence,)) = lamps
    assert evidence.accepted and evidence.log_bayes_factor > VERY_STRONG
    assert finer.point.materials is before.point.materials
    assert [len(light) for light in finer.point.lights] == pytest.approx([CELLS + 3 * SPLIT_CELLS] * 2, rel=0.1)
    after = fit_problem(problem, finer, PRIOR, JOINTLY)
    errors = [np.abs(fit.point.materials.roughness - MATERIALS.roughness)[SHOWN] for fit in (before, after)]
    assert errors[1].sum() < 0.6 * errors[0].sum() and (errors[1] < errors[0]).all(), errors
    assert problem.held_out_loss(after.point) < problem.held_out_loss(before.point)


def test_each_light_splits_by_its_own_evidence_and_only_those_that_did_split_again():
    problem, before = fitted([lamp(0.5), CONSTANT])
    after, evidence = split_cells("splitting", problem, before, 3, FitRunner())
    assert [len(light) > CELLS for light in after.point.lights] == [True, False]
    assert len(evidence) > 1


def test_a_constant_light_needs_no_finer_cells():
    problem, before = fitted([CONSTANT])
    after, evidence = split_cells("splitting", problem, before, 1, FitRunner())
    assert [decision.accepted for decision in evidence] == [False] and len(after.point.lights[0]) == CELLS


def test_evidence_needs_no_held_out_observations_and_nothing_splits_if_none_is_allowed(lamps):
    problem, before, _ = lamps
    nothing_held_out = problem.with_blocks([none_held_out(block) for block in problem.blocks])
    assert split_cells("splitting", nothing_held_out, before, 1, FitRunner())[1][0].accepted
    assert split_cells("splitting", problem, before, 0, FitRunner()) == (before, [])


@pytest.mark.parametrize(("threshold", "factor"), [(np.inf, OBSERVATION_FACTOR), (0.0, 1)])
def test_where_observations_are_explained_closely_more_of_them_are_fitted(lamps, monkeypatch, threshold, factor):
    problem, before, _ = lamps
    monkeypatch.setattr(joint_solver, "SMALL_LOSS", threshold)
    options = SolveOptions(cells=CELLS, splittings=2)
    after = fit_materials(SolveRequest(problem, [], options, FitRunner()), SolveState(before, before))
    assert after.observations == factor * options.observations and after.splitting[0].accepted
    assert sum(decision.accepted for decision in after.splitting) <= 2 * options.splittings
