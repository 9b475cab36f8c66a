import msgspec
import numpy as np
import pytest

from factorlib.reflection import reflection_operator
from factorlib.solve.normal_equations import Loss, fit_loss, predicted_radiance, residuals, system
from factorlib.solve.unknowns import Light, Materials
from tests.solve.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("closed_form", dtype="float64")


@pytest.fixture(scope="module", params=["linear", "toned"])
def problem(request):
    rng = np.random.default_rng(1)
    true = random_light(rng, 5, photos=2)
    data = block("room", true, MATERIALS, [0, 1, 2], OPERATOR, size=16)
    clipped = data.radiance > np.quantile(data.radiance, 0.9)
    data = msgspec.structs.replace(data, clipped=clipped, radiance=np.minimum(data.radiance, 2.0))
    guess = random_light(rng, 4, photos=2)
    tone = np.log([1.3, 0.8]) if request.param == "toned" else np.zeros(0)
    return data, Light(guess.axis, guess.log_sharpness, guess.weight / 10, guess.log_exposure, tone)


def derivative(function, size, step=1e-6):
    """Central differences of half the loss, whose gradient the systems hold."""
    moves = np.eye(size) * step
    return np.array([(function(d) - function(-d)) / (4 * step) for d in moves])


LOSS = Loss(robust_scale=3.0, prior=0.05)


def test_gradient_by_light_is_the_finite_difference(problem):
    data, light = problem
    found = system(data, light, MATERIALS, OPERATOR, LOSS)
    # the prior holds Ē, so it is left out of the difference and tested on its own below
    loss = Loss(robust_scale=3.0, prior=0.0)
    found = system(data, light, MATERIALS, OPERATOR, loss)
    expected = derivative(lambda d: fit_loss(data, light.moved(d, MATERIALS.blur), MATERIALS, OPERATOR, loss), light.unknowns)
    np.testing.assert_allclose(found.light_gradient, expected, rtol=2e-4, atol=1e-4 * np.abs(expected).max())


def test_gradient_by_material_is_the_finite_difference(problem):
    data, light = problem
    found = system(data, light, MATERIALS, OPERATOR, LOSS)
    vector = MATERIALS.vector()
    expected = derivative(lambda d: fit_loss(data, light, Materials.of_vector(vector + d), OPERATOR, LOSS), len(vector))
    np.testing.assert_allclose(found.material_gradient, expected, rtol=2e-4, atol=1e-4 * np.abs(expected).max())


def test_loss_of_the_system_is_the_loss(problem):
    data, light = problem
    np.testing.assert_allclose(system(data, light, MATERIALS, OPERATOR, LOSS).loss, fit_loss(data, light, MATERIALS, OPERATOR, LOSS))


def test_radiance_is_linear_in_light(problem):
    data, light = problem
    light = msgspec.structs.replace(light, log_tone=np.zeros(0))
    twice = msgspec.structs.replace(light, weight=2 * light.weight)
    np.testing.assert_allclose(
        predicted_radiance(data, twice, MATERIALS, OPERATOR), 2 * predicted_radiance(data, light, MATERIALS, OPERATOR)
    )


def test_a_clipped_channel_pulls_only_from_below(problem):
    data, _ = problem
    above, below = residuals(data, data.radiance + 1), residuals(data, data.radiance - 1)
    assert (above[data.clipped] == 0).all()
    assert (below[data.clipped] < 0).all()


def test_hidden_observations_do_not_pull(problem):
    data, light = problem
    changed = np.where(data.held_out[:, None], data.radiance + 1, data.radiance)
    a, b = (system(x, light, MATERIALS, OPERATOR, LOSS) for x in (data, msgspec.structs.replace(data, radiance=changed)))
    np.testing.assert_array_equal(a.light_gradient, b.light_gradient)


def test_the_prior_pulls_a_tinted_light_toward_grey(problem):
    data, light = problem
    red = msgspec.structs.replace(light, weight=light.weight * [2.0, 1.0, 1.0])
    p = len(light)
    with_prior, without = (system(data, red, MATERIALS, OPERATOR, Loss(3.0, prior)) for prior in (1e3, 0.0))
    pull = (with_prior.light_gradient - without.light_gradient)[3 * p :]
    assert (pull[:p] > 0).all()  # less red
    assert (pull[p : 3 * p] < 0).all()  # more green and blue
    np.testing.assert_allclose(pull[: 3 * p].sum(), 0, atol=1e-9 * np.abs(pull).max())


def dimmed(block, light):
    """A prior that knows lights to be dark: ρ = 0.3 Σ e²."""
    first, last = 3 * len(light), 6 * len(light)
    gradient, hessian = np.zeros(light.unknowns), np.zeros((light.unknowns, light.unknowns))
    gradient[first:last] = 0.3 * light.energy.T.reshape(-1)
    hessian[range(first, last), range(first, last)] = 0.3
    return 0.3 * float(np.sum(light.energy**2)), gradient, hessian


def test_a_prior_on_light_is_part_of_loss_and_gradient(problem):
    data, light = problem
    loss = Loss(robust_scale=3.0, prior=0.0, light_prior=dimmed)
    found = system(data, light, MATERIALS, OPERATOR, loss)
    expected = derivative(lambda d: fit_loss(data, light.moved(d, MATERIALS.blur), MATERIALS, OPERATOR, loss), light.unknowns)
    np.testing.assert_allclose(found.light_gradient, expected, rtol=2e-4, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(found.loss, fit_loss(data, light, MATERIALS, OPERATOR, loss))
    without = system(data, light, MATERIALS, OPERATOR, Loss(robust_scale=3.0, prior=0.0))
    assert found.loss > without.loss and (found.light_hessian - without.light_hessian).trace() == pytest.approx(0.9 * len(light))
