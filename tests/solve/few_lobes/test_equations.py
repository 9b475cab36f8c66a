"""One light of few lobes: derivatives are those of the one forward model, fitted weights are the optimum of a convex problem."""

import msgspec
import numpy as np
import pytest

from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials, Point
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.solve.few_lobes import equations, unknowns
from factorlib.solve.few_lobes.equations import (
    energy_equations,
    linearise,
    nonnegative_minimum,
    normal_equations,
    responses,
    tint_prior,
    with_weights_fitted,
)
from factorlib.solve.few_lobes.insertion import candidates, lobes_inserted
from factorlib.solve.few_lobes.roughness import materials_of_best_roughness, reflectances
from studies.scenes.problems import MATERIALS, block, random_light
from tests.model.made import OPERATOR, bowls, photos_in_a_wrong_light, rough_light
from tests.solve.made import OPERATOR as NETWORK

LOSS = Loss(robust_scale=3.0, prior=0.05)
UNTINTED = Loss(robust_scale=3.0, prior=0.0)  # the tint prior takes Ē to be constant, so it is no part of a difference
SQUARES = Loss(robust_scale=1e6, prior=0.0)


def with_light(one, light):
    return msgspec.structs.replace(one, light=light)


def moved_light(one, step):
    return with_light(one, unknowns.moved_light(one.light, step, MATERIALS))


def moved_materials(one, step):
    return msgspec.structs.replace(one, materials=Materials.of_vector(MATERIALS.vector() + step))


def fit_loss(one, loss):
    """The loss of the observations that are not held out, with the prior."""
    residual = one.residuals()[~one.block.held_out]
    return float(np.sum(loss.of_residuals(residual))) + tint_prior(loss, one.block, one.light).value


def derivative(function, size, step=1e-6):
    """Central differences."""
    return np.array([(function(d) - function(-d)) / (2 * step) for d in np.eye(size) * step])


@pytest.fixture(scope="module")
def clipped():
    return photos_in_a_wrong_light("clipped")


@pytest.mark.parametrize("moved", [moved_light, moved_materials])
@pytest.mark.parametrize("kind", ["clipped", "bounced", "hidden"])
def test_gradients_are_finite_differences_of_the_loss(kind, moved):
    """Of shadows, by what moves none: weights, exposures, k_d and k_s.  Visibility is computed in single precision, so steps are long."""
    given = photos_in_a_wrong_light(kind)
    found, p = normal_equations(given, UNTINTED), len(given.light)
    gradient = found.light_gradient if moved is moved_light else found.material_gradient
    which, step, rtol, atol = np.ones(len(gradient), bool), 1e-6, 2e-4, 1e-4
    if kind == "hidden":
        which = np.arange(len(gradient)) >= 3 * p if moved is moved_light else np.arange(len(gradient)) % 7 < 6
        step, rtol, atol = 2e-3, 0.02, 2e-3
    expected = derivative(lambda d: fit_loss(moved(given, d), UNTINTED), len(gradient), step)[which] / 2
    np.testing.assert_allclose(gradient[which], expected, rtol=rtol, atol=atol * np.abs(expected).max())


@pytest.mark.parametrize("moved", [moved_light, moved_materials])
def test_the_jacobian_is_the_finite_difference_of_the_one_forward_model(clipped, moved):
    """Row by row, of whitened residuals that nothing weighs down."""
    plain, first = Loss(robust_scale=1e9, prior=0.0), 7 * len(MATERIALS)
    whole = np.zeros((*clipped.block.radiance.shape, first + unknowns.unknowns(clipped.light)))
    for part in linearise(clipped, plain):
        of_channel = whole[part.rows, part.channel]
        of_channel[:, part.places] = part.jacobian.numpy()
    jacobian = whole[..., first:] if moved is moved_light else whole[..., :first]
    expected = np.moveaxis(derivative(lambda d: moved(clipped, d).residuals(), jacobian.shape[-1]), 0, -1)
    compared = ~clipped.block.held_out[:, None] & (
        np.abs(clipped.residuals()) > 1e-3
    )  # a clipped channel just satisfied has two slopes
    np.testing.assert_allclose(jacobian[compared], expected[compared], atol=1e-5 * np.abs(expected).max())


def test_loss_of_the_normal_equations_is_the_loss_and_held_out_observations_do_not_pull(clipped):
    np.testing.assert_allclose(normal_equations(clipped, LOSS).loss, fit_loss(clipped, LOSS))
    radiance = np.where(clipped.block.held_out[:, None], clipped.block.radiance + 1, clipped.block.radiance)
    other = msgspec.structs.replace(clipped, block=msgspec.structs.replace(clipped.block, radiance=radiance))
    a, b = (normal_equations(one, LOSS) for one in (clipped, other))
    np.testing.assert_array_equal(a.light_gradient, b.light_gradient)


def test_the_prior_pulls_a_tinted_light_toward_grey(clipped):
    red = with_light(clipped, msgspec.structs.replace(clipped.light, weight=clipped.light.weight * [2.0, 1.0, 1.0]))
    p = len(clipped.light)
    with_prior, without = (normal_equations(red, Loss(3.0, prior)) for prior in (1e3, 0.0))
    pull = (with_prior.light_gradient - without.light_gradient)[3 * p :]
    assert (pull[:p] > 0).all() and (pull[p : 3 * p] < 0).all()  # less red, more green and blue
    np.testing.assert_allclose(pull[: 3 * p].sum(), 0, atol=1e-9 * np.abs(pull).max())


# ── weights ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def data():
    """A noisy block in a wrong light of more lobes than it was made in."""
    light = random_light(np.random.default_rng(3), 6)
    shown = block("a", light, MATERIALS, [0, 1, 2], OPERATOR, size=10, seed=1)
    noisy = shown.radiance * (1 + 0.05 * np.random.default_rng(4).normal(size=shown.radiance.shape))
    guess = random_light(np.random.default_rng(5), 9)
    return Illumination(msgspec.structs.replace(shown, radiance=noisy), guess, MATERIALS, OPERATOR)


def changed(one, **block):
    return msgspec.structs.replace(one, block=msgspec.structs.replace(one.block, **block))


def by_energy(light, gradient):
    return gradient[3 * len(light) : 6 * len(light)].reshape(3, -1)


@pytest.mark.parametrize("bounced", [False, True])
def test_energy_equations_are_those_parts_of_the_normal_equations(data, bounced):
    given, loss = photos_in_a_wrong_light("bounced") if bounced else data, Loss(1.0, 1e-2)
    part, whole, p = (
        energy_equations(given.fitted(), responses(given.fitted()), loss),
        normal_equations(given, loss),
        len(given.light),
    )
    np.testing.assert_allclose(part.value, whole.loss, rtol=1e-12)
    largest = np.abs(part.gradient).max()
    np.testing.assert_allclose(
        part.gradient, by_energy(given.light, whole.light_gradient), rtol=1e-9, atol=1e-9 * largest
    )
    for c in range(3):
        own = slice((3 + c) * p, (4 + c) * p)
        np.testing.assert_allclose(
            part.hessian[c], whole.light_hessian[own, own], rtol=1e-9, atol=1e-12 * part.hessian.max()
        )


def test_fitted_weights_are_the_optimum_and_everything_else_stays(data):
    """Karush, Kuhn and Tucker: no gradient where there is weight, none that asks for less than nothing elsewhere."""
    found, at = with_weights_fitted(data, SQUARES)
    before = np.abs(by_energy(data.light, normal_equations(data, SQUARES).light_gradient)).max()
    gradient, energy = by_energy(found, at.light_gradient), found.energy.T
    assert (energy == 0).any() and (energy > 0).any()
    assert np.abs(gradient[energy > 0]).max() < 1e-6 * before and gradient[energy == 0].min() > -1e-6 * before
    for name in ("axis", "log_sharpness", "log_exposure"):
        np.testing.assert_array_equal(getattr(found, name), getattr(data.light, name))
    again = normal_equations(with_light(data, found), SQUARES).light_hessian
    np.testing.assert_allclose(at.light_hessian, again, rtol=1e-12, atol=1e-12 * again.max())


def test_fitted_weights_never_raise_a_robust_loss_with_clipped_channels(data):
    rng, radiance = np.random.default_rng(6), data.block.radiance
    wrong = radiance * np.where(rng.random(radiance.shape) < 0.2, 20.0, 1.0)
    harmed = changed(data, radiance=wrong, clipped=wrong > np.quantile(wrong, 0.6))
    for scale in (0.1, 1.0, 10.0):
        loss = Loss(robust_scale=scale, prior=0.0)
        found, at = with_weights_fitted(harmed, loss)
        assert at.loss <= fit_loss(harmed, loss) * (1 + 1e-12)
        np.testing.assert_allclose(at.loss, fit_loss(with_light(harmed, found), loss), rtol=1e-5)


def test_weights_that_would_raise_the_loss_are_not_taken(data, monkeypatch):
    nine = lambda light, _: msgspec.structs.replace(light, weight=9 * light.weight)  # noqa: E731
    monkeypatch.setattr(equations, "of_least_loss", nine)
    found, at = with_weights_fitted(data, SQUARES)
    np.testing.assert_array_equal(found.weight, data.light.weight)
    assert at.loss == normal_equations(data, SQUARES).loss


def test_responses_computed_twice_give_the_same_bits(data, monkeypatch):
    kept, at = with_weights_fitted(data, SQUARES)
    monkeypatch.setattr(equations, "KEPT", 0)
    again, other = with_weights_fitted(data, SQUARES)
    np.testing.assert_array_equal(kept.weight, again.weight)
    np.testing.assert_array_equal(at.light_hessian, other.light_hessian)


def test_weights_are_fitted_to_what_bounces_leave():
    """Observations of a light and of bounces give that light back."""
    given = photos_in_a_wrong_light("bounced")
    exact = changed(given, radiance=given.radiance(), precision=np.ones_like(given.block.precision))
    dark = msgspec.structs.replace(given.light, weight=given.light.weight / 3)
    found, _ = with_weights_fitted(with_light(exact, dark), SQUARES)
    np.testing.assert_allclose(found.weight, given.light.weight, rtol=1e-5, atol=1e-6 * given.light.weight.max())


def test_nonnegative_minimum_against_every_active_set():
    def solved_on(hessian, target, free):
        w = np.zeros(len(target))
        w[free] = np.linalg.solve(hessian[np.ix_(free, free)], target[free])
        return w

    rng = np.random.default_rng(8)
    for _ in range(5):
        a = rng.normal(size=(12, 4))
        hessian, target = a.T @ a, rng.normal(size=4) * 3
        tried = [solved_on(hessian, target, np.array(free, bool)) for free in np.ndindex(2, 2, 2, 2)]
        best = min((0.5 * w @ hessian @ w - target @ w, w.tolist()) for w in tried if (w >= 0).all())
        np.testing.assert_allclose(nonnegative_minimum(hessian, target), best[1], atol=1e-6)


# ── the search for another roughness, the lights as they are, and for lobes ──────────────────────────────────────────


def shown(materials: int, size: int = 24):
    """Blocks, materials and lights that explain them."""
    rng = np.random.default_rng(3)
    truth = Materials.of_rows(MATERIALS.rows()[:materials])
    lights = [random_light(rng, 5) for _ in range(2)]
    blocks = [block(f"light_{k}", light, truth, range(materials), NETWORK, size) for k, light in enumerate(lights)]
    units = [one.unit for one in blocks]
    return blocks, truth, [msgspec.structs.replace(li, weight=li.weight / u) for li, u in zip(lights, units)]


def searched(blocks, materials, lights):
    return materials_of_best_roughness(JointProblem(blocks, NETWORK), Point(materials, lights))


def test_a_roughness_far_off_is_found_again():
    blocks, truth, lights = shown(3)
    wrong = Materials(truth.diffuse * 1.3, truth.specular * 0.5, np.array([0.95, *truth.roughness[1:]]))
    found = searched(blocks, wrong, lights)
    assert abs(found.roughness[0] - truth.roughness[0]) < 0.1  # the grid's own spacing
    np.testing.assert_array_equal(found.roughness[1:], wrong.roughness[1:])  # what is right stays


def test_a_material_that_nothing_shows_stays_and_clipped_channels_do_not_vote():
    blocks, truth, lights = shown(2)
    more = Materials.of_rows(truth.rows()[[0, 1, 0]])
    np.testing.assert_array_equal(searched(blocks, more, lights).vector()[14:], more.vector()[14:])
    half = [(np.arange(len(b)) % 2 == 0)[:, None] for b in blocks]
    dark = [
        msgspec.structs.replace(b, clipped=b.clipped | h, radiance=np.where(h, 0.01, b.radiance))
        for b, h in zip(blocks, half)
    ]
    wrong = Materials(truth.diffuse, truth.specular, np.array([1.0, truth.roughness[1]]))
    assert abs(searched(dark, wrong, lights).roughness[0] - truth.roughness[0]) < 0.1


def test_reflectances_are_those_that_made_the_radiance():
    diffuse, specular = np.random.default_rng(0).uniform(0.1, 1, (2, 50, 3))
    kd, ks = np.array([0.3, 0.2, 0.1]), np.array([0.05, 0.1, 0.2])
    loss, found_kd, found_ks = reflectances(diffuse, specular, kd * diffuse + ks * specular, np.ones((50, 3)))
    assert loss == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose([found_kd, found_ks], [kd, ks], rtol=1e-6)


def test_no_lobe_is_inserted_where_its_light_cannot_arrive():
    """One observation's worth of light from the side that everything is hidden from explains nothing."""
    data = blocks_of_observations(bowls("room", rough_light(3), size=8), Noise())[0]
    visibility = np.where(data.directions[0, :, 0] > 0.2, 0, data.visibility).astype(np.uint8)
    dark = Light(np.array([[0.0, 0.0, -1.0]]), np.zeros(1), np.full((1, 3), 1e-6), np.zeros(1))
    illumination = Illumination(msgspec.structs.replace(data, visibility=visibility), dark, MATERIALS, OPERATOR)
    assert (lobes_inserted(illumination, 8, candidates(illumination, 0)).axis[1:, 0] < 0.35).all()
