"""Laws of the balance of exposures: the same radiance, lower priors, and nothing where relative brightness is observed."""

import msgspec
import numpy as np
import pytest

from factorlib.inference.answer.identifiability import before_solving
from factorlib.inference.fit.exposures import ExposureTerms, balance_exposures, material_groups
from factorlib.inference.fit.fit import fit_problem
from factorlib.inference.fit.optimizer import Descent
from factorlib.inference.model.known import KnownValues
from factorlib.inference.model.material_prior import MaterialPrior, material_unknowns
from factorlib.inference.model.materials import Materials, Point
from factorlib.inference.model.problem import JointProblem
from tests.inference.made_lights import (
    MATERIALS,
    OPERATOR,
    PRIOR,
    WHOLE,
    begun,
    drawn,
    light_likelihood,
    on_even_cells,
    spheres,
)

CELLS = 60


def lamps(log_exposure: float = 0.0) -> JointProblem:
    """Two lights, each with one photo of the first and one of the second material; exposures of the latter are given."""
    blocks = []
    for k in range(2):
        light = on_even_cells(drawn(40 + k, CELLS), (0.0, log_exposure), name=f"room{k}")
        one, other = (spheres([light], shown=(m,), size=14).blocks[0] for m in (0, 1))
        joined = {
            name: np.concatenate([getattr(one, name), getattr(other, name)])
            for name in ("normal", "view", "clipped", "material", "held_out")
        }
        radiance = np.concatenate([one.radiance * one.unit, other.radiance * other.unit * np.exp(log_exposure)])
        photo = np.repeat([0, 1], [len(one), len(other)])
        inverse_sigma = one.noise.inverse_sigma(radiance, np.ones(len(radiance)))
        blocks.append(
            msgspec.structs.replace(
                one,
                name=f"room{k}",
                photos=("a", "b"),
                unit=1.0,
                radiance=radiance,
                inverse_sigma=inverse_sigma,
                photo=photo,
                **joined,
            )
        )
    return JointProblem(blocks, OPERATOR)


def state_of(problem: JointProblem, exposures=(0.0, 0.0), factor: float = 1.0):
    """The state at the true materials, the second one times a factor, in drawn lights whose second photo has an exposure."""
    rows = MATERIALS.rows()
    rows[1, :6] *= factor
    materials = Materials.from_rows(rows)
    lights = [on_even_cells(drawn(40 + k, CELLS), (0.0, e), name=f"room{k}") for k, e in enumerate(exposures)]
    pairs = [
        light_likelihood(one, h, PRIOR)
        for one, h in zip(problem.illuminations(Point(materials, lights)), begun(problem).hyperparameters)
    ]
    descent = Descent(MaterialPrior(materials, problem.blocks), problem.spread, lambda loss: None, np.ones(21, bool))
    return descent.linearise(pairs, material_unknowns(materials)), descent


def test_a_balance_predicts_the_same_radiance_and_lowers_the_objective():
    before, descent = state_of(lamps(), (1.2, 0.9), factor=0.3)
    after = balance_exposures(before, descent, KnownValues())
    for old, new in zip(before.likelihoods, after.likelihoods, strict=True):
        np.testing.assert_allclose(new.illumination.radiance(), old.illumination.radiance(), rtol=1e-6)
        assert abs(new.light.log_exposure[1]) < old.light.log_exposure[1] - 0.1 and new.light.log_exposure[0] == 0
    assert after.value < before.value - 1
    # no other factor of the second material is better
    for change in (-0.05, 0.05):
        theta = after.theta.copy()
        theta[1, :6] += change
        lights = []
        for likelihood in after.likelihoods:
            light = likelihood.light
            exposures = light.log_exposure - np.array([0.0, change])
            lights.append(likelihood.with_point(msgspec.structs.replace(light, log_exposure=exposures)))
        assert descent.linearise(lights, theta).value > after.value
    again = balance_exposures(after, descent, KnownValues())
    np.testing.assert_allclose(again.theta, after.theta, atol=1e-3)


def test_a_balance_that_interreflection_makes_worse_is_not_taken():
    """Bounced light keeps its radiance, so that the move changes the prediction."""
    problem = lamps()
    rng = np.random.default_rng(0)
    bounced = [msgspec.structs.replace(b, bounced=3 * rng.random((len(b), 6))) for b in problem.blocks]
    before, descent = state_of(problem.with_blocks(bounced), (1.2, 0.9))
    assert balance_exposures(before, descent, KnownValues()).value <= before.value


def test_materials_of_one_photo_or_of_known_exposures_are_one_group_and_stay():
    problem = spheres([on_even_cells(drawn(1, CELLS))])
    assert len(set(material_groups(problem.blocks, 3, KnownValues()))) == 1
    apart = lamps()
    assert len(set(material_groups(apart.blocks, 2, KnownValues()))) == 2
    known = KnownValues(exposures=("room0",))
    assert len(set(material_groups(apart.blocks, 2, known))) == 1
    state, descent = state_of(apart, (1.2, 0.9), factor=0.3)
    assert balance_exposures(state, descent, known) is state
    given = KnownValues(materials={0: MATERIALS.rows()[0]})
    assert balance_exposures(state, descent, given) is state


def test_a_fit_finds_equal_exposures_where_photos_of_a_light_show_one_material_each():
    problem = lamps()
    fit = fit_problem(problem, begun(problem, CELLS), PRIOR, WHOLE)
    for light in fit.point.lights:
        assert light.log_exposure[1] == pytest.approx(0, abs=0.5)
    ratio = fit.point.materials.diffuse[1] / fit.point.materials.diffuse[0]
    assert np.abs(np.log(ratio / (MATERIALS.diffuse[1] / MATERIALS.diffuse[0])).mean()) < 0.5


def test_a_solve_says_that_exposures_and_reflectances_look_alike():
    sentences = before_solving(["red", "white", "black"], ["a", "b"], lamps())
    assert any("brightness of red; white" in sentence and "known: {exposure" in sentence for sentence in sentences)
    known = msgspec.structs.replace(lamps(), known=KnownValues(exposures=("room0", "room1")))
    assert not any(
        "brightness of" in sentence for sentence in before_solving(["red", "white", "black"], ["a", "b"], known)
    )


def test_the_slope_of_the_priors_is_that_of_their_values():
    state, _ = state_of(lamps(), (1.2, 0.9), factor=0.3)
    likelihood = state.likelihoods[0]
    stiff = msgspec.structs.replace(likelihood, precision=likelihood.precision + np.eye(len(likelihood.precision)))
    term = ExposureTerms(stiff, np.array([0, 1, 2]))
    at, step = np.array([0.3, -0.2, 0.1]), 1e-5
    numeric = [(term.energy(at + d)[0] - term.energy(at - d)[0]) / (2 * step) for d in step * np.eye(3)]
    np.testing.assert_allclose(term.energy(at)[1], numeric, rtol=1e-5, atol=1e-4)
