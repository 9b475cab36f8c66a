"""One light of few lobes: derivatives are those of the one forward model, fitted weights are the optimum of a convex problem."""

import msgspec
import numpy as np
import pytest

from factorlib.model.illumination import Illumination
from factorlib.model.materials import Materials
from factorlib.model.noise import Loss
from factorlib.solve.few_lobes import unknowns
from factorlib.solve.few_lobes.equations import (
    energy_equations,
    nonnegative_minimum,
    normal_equations,
    tabulated,
    tint_prior,
    with_weights_fitted,
)
from studies.scenes.problems import MATERIALS, block, random_light
from tests.model.made import OPERATOR, photos_in_a_wrong_light

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


def test_loss_of_the_normal_equations_is_the_loss_and_held_out_observations_do_not_pull(clipped):
    np.testing.assert_allclose(normal_equations(clipped, LOSS).value, fit_loss(clipped, LOSS))
    radiance = np.where(clipped.block.held_out[:, None], clipped.block.radiance + 1, clipped.block.radiance)
    other = msgspec.structs.replace(clipped, block=msgspec.structs.replace(clipped.block, radiance=radiance))
    a, b = (normal_equations(one, LOSS) for one in (clipped, other))
    np.testing.assert_array_equal(a.light_gradient, b.light_gradient)


# ── weights ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def data():
    """A noisy block in a wrong light of more lobes than it was made in."""
    light = random_light(np.random.default_rng(3), 6)
    shown = block("a", light, MATERIALS, [0, 1, 2], OPERATOR, size=10, seed=1)
    noisy = shown.radiance * (1 + 0.05 * np.random.default_rng(4).normal(size=shown.radiance.shape))
    guess = random_light(np.random.default_rng(5), 9)
    return Illumination(msgspec.structs.replace(shown, radiance=noisy), guess, MATERIALS, OPERATOR)


def by_energy(light, gradient):
    return gradient[3 * len(light) : 6 * len(light)].reshape(3, -1)


@pytest.mark.parametrize("bounced", [False, True])
def test_energy_equations_are_those_parts_of_the_normal_equations(data, bounced):
    given, loss = photos_in_a_wrong_light("bounced") if bounced else data, Loss(1.0, 1e-2)
    part = energy_equations(given.fitted(), tabulated(given.fitted()), loss)
    whole = normal_equations(given, loss)
    p = len(given.light)
    np.testing.assert_allclose(part.value, whole.value, rtol=1e-12)
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
