"""The marginal likelihood: its gradients, its gauge, and why the determinant is in it."""

import msgspec
import numpy as np
import pytest

from factorlib.inference.likelihood import EXPOSURE_DEVIATION, TONE_DEVIATION
from factorlib.inference.priors import material_unknowns, materials_from_unknowns
from factorlib.inference.problem import JointProblem
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made import none_held_out
from tests.inference.made_lights import OPERATOR, PRIOR, drawn, likelihood, on_even_cells, photographed, spheres

CELLS = 50
THETA = material_unknowns(MATERIALS)


def prior_of(light, precision) -> float:
    """uᵀQu and the Gaussians of exposures and tone exponents."""
    u = light.log_radiance.reshape(-1)
    return float(
        u @ precision @ u
        + np.sum((light.log_exposure / EXPOSURE_DEVIATION) ** 2)
        + np.sum((light.log_tone / TONE_DEVIATION) ** 2)
    )


def log_det(one) -> float:
    """log det H, of the value."""
    part = one.normal_equations()
    return part.value - part.loss / one.temperature - prior_of(one.light, one.precision) + one.log_determinant


def posterior(one) -> float:
    """φ."""
    return one.normal_equations(materials_given=True).loss / one.temperature + prior_of(one.light, one.precision)


def moved(light, step):
    """The light after a step of all its unknowns."""
    cells, exposures, tones = np.split(step, [3 * len(light), 3 * len(light) + len(light.log_exposure) - 1])
    light = light.with_log_radiance(light.log_radiance + cells.reshape(3, -1))
    exposure = light.log_exposure + np.concatenate([[0.0], exposures])
    return msgspec.structs.replace(light, log_exposure=exposure, log_tone=light.log_tone + tones)


@pytest.fixture(scope="module", params=["one photo", "three photos"])
def here(request):
    """The true light, off by a little, in the likelihood of what its photos show; tone curves are the identity for the determinant."""
    exposure = [0.0] if request.param == "one photo" else [0.0, 0.4, -0.5]
    light = on_even_cells(drawn(1, CELLS), exposure)
    problem = spheres([light], size=8)
    u = light.log_radiance - np.log(problem.blocks[0].unit)
    return likelihood(problem, light.with_log_radiance(u + 0.1 * np.random.default_rng(3).normal(size=u.shape)))


def test_the_gradient_by_materials_is_the_finite_difference_of_the_value(here):
    system = here.normal_equations()
    gradient = system.material_gradient + system.determinant_by_materials
    for place in range(THETA.size):
        change = 2e-3 * np.eye(THETA.size)[place].reshape(THETA.shape)
        high, low = (
            here.with_point(materials=materials_from_unknowns(THETA + sign * change)).normal_equations().value
            for sign in (1, -1)
        )
        assert gradient[place] == pytest.approx((high - low) / 4e-3 / 2, rel=0.02, abs=0.02 * np.abs(gradient).max()), (
            place
        )


@pytest.mark.parametrize("toned", [False, True])
def test_the_gradient_by_light_is_that_of_the_loss_and_the_prior(here, toned):
    light, rng = here.light, np.random.default_rng(2)
    light = msgspec.structs.replace(light, log_tone=0.1 * rng.normal(size=len(light.log_exposure))) if toned else light
    gradient = here.with_point(light).normal_equations().light_gradient
    for _ in range(4):
        change = rng.normal(size=light.unknowns)
        high, low = (posterior(here.with_point(moved(light, sign * 1e-3 * change))) for sign in (1, -1))
        assert gradient @ change == pytest.approx((high - low) / 2e-3 / 2, rel=0.02, abs=0.02 * np.abs(gradient).max())


def test_the_determinant_by_light_is_half_the_finite_difference_of_log_det(here):
    light, rng, by_light = here.light, np.random.default_rng(4), here.normal_equations().determinant_by_light
    for change in (np.ones(3 * CELLS), rng.normal(size=3 * CELLS), np.eye(3 * CELLS)[by_light[: 3 * CELLS].argmax()]):
        step = np.concatenate([change, np.zeros(light.unknowns - len(change))])
        high, low = (log_det(here.with_point(moved(light, sign * 5e-3 * step))) for sign in (1, -1))
        assert by_light @ step == pytest.approx((high - low) / 1e-2 / 2, rel=0.01, abs=0.01 * np.abs(by_light).max())


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_darker_materials_in_a_brighter_light_are_as_likely_but_for_the_prior(here, channel):
    """And the reduced gradient says so; without the determinant by the light, it would push reflectances far."""
    wide = msgspec.structs.replace(PRIOR, level=(1e4,) * 3)
    one = likelihood(JointProblem([here.illumination.block], OPERATOR), here.light, prior=wide)
    direction, cells = np.zeros((3, 7)), np.zeros((3, CELLS))
    direction[:, [channel, 3 + channel]], cells[channel] = 1.0, -1.0
    light, values = one.light, []
    for step in (0.0, np.log(3)):
        there = one.with_point(
            light.with_log_radiance(light.log_radiance + step * cells),
            materials_from_unknowns(THETA + step * direction),
        )
        values.append(there.normal_equations().value - prior_of(there.light, one.precision))
    assert values[0] == pytest.approx(values[1], abs=1e-3 * abs(values[0]))
    part = one.normal_equations()
    by_light = part.light_gradient, part.light_gradient + part.determinant_by_light
    alone, whole = (
        abs(
            direction.reshape(-1)
            @ (
                part.material_gradient
                + part.determinant_by_materials
                - part.cross_hessian @ np.linalg.solve(part.light_hessian, g)
            )
        )
        for g in by_light
    )
    assert alone > 10 and whole < 0.02 * alone, (alone, whole)


def settled(one, steps=15):
    """The likelihood at the light that lowers φ."""
    for _ in range(steps):
        part, light = one.normal_equations(materials_given=True), one.light
        one = one.with_point(moved(light, -np.linalg.solve(part.light_hessian, part.light_gradient).clip(-1, 1)))
    return one


@pytest.mark.parametrize("seed", range(2))
def test_the_determinant_is_needed_for_roughness(seed):
    """With it the likelihood of a roughness is highest at the true one; the loss and the prior alone prefer far smoother materials."""
    problem, true = photographed(seed, 1, cells=100, size=14, noise=1.0)
    block = none_held_out(problem.blocks[0].take(problem.blocks[0].material == 1))
    one = likelihood(JointProblem([block], OPERATOR), true[0], temperature=1.0)
    tried, found = (0.15, 0.25, 0.4, 0.55), []
    for roughness in tried:
        there = settled(one.with_point(materials=msgspec.structs.replace(MATERIALS, roughness=np.full(3, roughness))))
        found.append((there.normal_equations().value, posterior(there)))
    values, posteriors = np.array(found).T
    assert tried[values.argmin()] == MATERIALS.roughness[1] and np.sort(values)[1] - values.min() > 10
    assert tried[posteriors.argmin()] < MATERIALS.roughness[1] and posteriors[2] - posteriors.min() > 10
