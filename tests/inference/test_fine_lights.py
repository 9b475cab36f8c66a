"""Cells split where the marginal likelihood supports it: around a sharp lamp, and not in a light without one."""

from functools import cache

import msgspec
import numpy as np
import pytest

from factorlib.inference import joint_solver
from factorlib.inference.choices import suns
from factorlib.inference.choices.model_selection import CLEARLY_AGAINST, VERY_STRONG
from factorlib.inference.choices.splitting import SPLIT_CELLS, split_cells
from factorlib.inference.choices.suns import (
    WIDE_SHARPNESS,
    accept_sun,
    compare_illuminations,
    replace_brightest,
    select_suns,
)
from factorlib.inference.fit import fit as fits
from factorlib.inference.fit.fit import FitSchedule, fit_problem
from factorlib.inference.fit.fit_runner import FitRunner, SolveState
from factorlib.inference.joint_solver import MATERIALS as JOINTLY
from factorlib.inference.joint_solver import OBSERVATION_FACTOR, SolveRequest, fit_materials
from factorlib.inference.model.lights import UnitLobes
from factorlib.inference.options import SolveOptions
from factorlib.light.lobes import SUN, lobe_energy
from factorlib.results.materials import Decision
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made import none_held_out
from tests.inference.made_lights import FEW, PRIOR, begun, drawn, light_of, likelihood, on_even_cells, spheres

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


# ── Suns: found where they shine, not found where none does, and apart from the prior on cells ──────────


TOWARDS = np.array([0.36, -0.48, -0.8])
SUN_LOBE = UnitLobes(TOWARDS[None], np.array([SUN]))
LIGHTS, AROUND = (
    FitSchedule(descents=together, least_temperature=0.1, materials_fixed=True) for together in ((0, 8, 6), (0, 8))
)


@cache
def solved(irradiance: float, seed: int):
    """Spheres under a sky drawn from the prior and a sun; the true irradiance by the sun in the blocks' unit; and the illumination and the fit
    that a solve without suns ends with, materials as they are."""
    sky = on_even_cells(drawn(seed, FEW))
    energy = irradiance * sky.energy.sum(0) / lobe_energy(np.array([SUN]))
    problem = spheres([(sky.with_lobes(SUN_LOBE, energy) if irradiance else sky)], size=24, seed=seed)
    fit = fit_problem(problem, begun(problem, 2 * FEW, MATERIALS), PRIOR, LIGHTS)
    (one,) = problem.illuminations(fit.point)
    return problem, energy * lobe_energy(np.array([SUN])) / problem.blocks[0].unit, one, fit


def tried(irradiance: float, seed: int):
    """The fits in cells alone, with a sun, and with a wide lobe."""
    problem, _, one, fit = solved(irradiance, seed)
    fits = [
        fit_problem(problem, fit.with_lights([replace_brightest(one, of)]), PRIOR, AROUND)
        for of in (SUN, WIDE_SHARPNESS)
    ]
    return [one, *(problem.illuminations(around.point)[0] for around in fits)]


def test_the_determinant_of_the_prior_counts_suns(monkeypatch):
    monkeypatch.setattr(fits, "SUN_DEVIATION", 0.5)
    light = on_even_cells(drawn(1, 40)).with_lobes(SUN_LOBE, np.ones((1, 3)))
    one = likelihood(spheres([light], size=6), light)
    assert one.log_determinant == pytest.approx(np.linalg.slogdet(one.precision)[1])


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_sun_is_found_with_its_direction_and_its_irradiance(seed):
    cells, sun, wide = tried(0.5, seed)
    light, irradiance = sun.light, solved(0.5, seed)[1]
    assert accept_sun(cells, sun).accepted and compare_illuminations(wide, sun, CLEARLY_AGAINST).accepted
    assert light.suns.sum() == 1 and np.arccos(light.axis[light.suns][0] @ TOWARDS) < cells.light.spacing[0] / 4
    np.testing.assert_allclose(light.energy[light.suns][0], irradiance, rtol=0.3)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3))])
def test_no_sun_is_found_in_a_sky_without_one(seed):
    cells, sun, wide = tried(0.0, seed)
    assert not (accept_sun(cells, sun).accepted and compare_illuminations(wide, sun, CLEARLY_AGAINST).accepted)


def test_the_solve_keeps_suns_of_lights_that_have_one():
    problem, *_, fit = solved(0.5, 1)
    result = select_suns(problem, fit, FitRunner())
    assert result.evidence[0].accepted and result.fit.point.lights[0].suns.any()
    again = select_suns(problem, result.fit, FitRunner())
    assert again.fit is result.fit and again.evidence[0].accepted
    cloudy, *_, fit = solved(0.0, 1)
    none = select_suns(cloudy, fit, FitRunner())
    assert not none.evidence[0].accepted and none.fit.point.lights[0] is fit.point.lights[0]


@pytest.mark.parametrize(
    "colour, share, margin, kept",
    [
        ((3, 2, 1), 0.2, 9.0, True),
        ((1, 2, 3), 0.2, 9.0, False),  # bluer than the rest
        ((3, 2, 1), 0.02, 9.0, False),  # weak
        ((3, 2, 1), 0.2, -1.5, True),  # sunlight, which hard shadows of a wrong mesh contradict a little
        ((3, 2, 1), 0.2, -2.5, False),
        ((1, 1, 1), 0.2, -1.5, False),  # a lamp
    ],
)
def test_a_sun_is_strong_and_no_bluer_than_its_light_and_kept_in_sunlight(monkeypatch, colour, share, margin, kept):
    """Whatever the observations say."""
    monkeypatch.setattr(suns, "compare_illuminations", lambda cells, sun, least: Decision(margin > least, 1, 2, margin))
    one = solved(0.0, 1)[2]
    total = one.light.energy.sum() / lobe_energy(np.array([SUN]))[0]
    weight = total * share * np.array(colour) / sum(colour)
    lit = msgspec.structs.replace(one, light=one.light.with_lobes(SUN_LOBE, weight))
    assert accept_sun(one, lit).accepted == kept
