"""Cells split where that explains what is held out: around a sharp lamp, and not in a light without one."""

import numpy as np
import pytest

from factorlib.inference.fit import FitSchedule, fit_problem
from factorlib.inference.fit_runner import FitRunner
from factorlib.inference.joint_solver import SPLIT_CELLS, split_while_gaining
from factorlib.inference.model_selection import WEAKLY_FOR
from factorlib.inference.options import SolveOptions
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made import none_held_out
from tests.inference.made_lights import PRIOR, begun, light_of, spheres

CELLS, SHOWN = 60, [1, 2]
ONCE = SolveOptions(splittings=1)


def lamp(x: float):
    """One sharper than any cell, in a room that is nearly dark."""
    return light_of([[x, -0.4, -0.75], [0, 0, 1.0]], [100, 1e-4], np.array([20, 0.3])[:, None] * np.ones(3))


def splitting_of(lights):
    """The fit on cells of one size, and what comes of splitting."""
    problem = spheres(lights, size=18, shown=SHOWN)
    fit = fit_problem(problem, begun(problem, CELLS), PRIOR, FitSchedule(4, (10, 8)))
    return problem, fit, split_while_gaining(problem, fit, ONCE, FitRunner())


@pytest.fixture(scope="module")
def lamps():
    return splitting_of([lamp(0.5), lamp(-0.5)])


def test_around_a_lamp_cells_split_and_what_they_hid_of_roughness_comes_out(lamps):
    problem, before, after = lamps
    (evidence,) = after.evidence
    assert (
        evidence.kept and evidence.margin > WEAKLY_FOR and evidence.held_out_loss_with < evidence.held_out_loss_without
    )
    errors = [np.abs(fit.point.materials.roughness - MATERIALS.roughness)[SHOWN] for fit in (before, after.fit)]
    assert errors[1].sum() < 0.6 * errors[0].sum() and (errors[1] < errors[0]).all(), errors
    assert [len(light) for light in after.fit.point.lights] == pytest.approx([CELLS + 3 * SPLIT_CELLS] * 2, rel=0.1)
    assert problem.held_out_loss(after.fit.point) < problem.held_out_loss(before.point)


def test_a_constant_light_needs_no_finer_cells():
    _, before, after = splitting_of([light_of([[0, 0, 1.0]], 1e-4, [[1.0, 1.0, 1.0]])])
    assert not after.evidence[0].kept
    np.testing.assert_array_equal(after.fit.point.lights[0].weight, before.point.lights[0].weight)


def test_nothing_splits_where_nothing_is_held_out_or_nobody_asks(lamps):
    problem, fit, _ = lamps
    for some, choices in (
        (problem.with_blocks([none_held_out(b) for b in problem.blocks]), ONCE),
        (problem, SolveOptions(splittings=0)),
    ):
        found = split_while_gaining(some, fit, choices, FitRunner())
        assert found.evidence == [] and found.fit is fit
