"""Weights fitted to everything else: the optimum of a convex problem, from the very normal equations that a step uses."""

import msgspec
import numpy as np
import pytest

from factorlib.model.illumination import Illumination
from factorlib.model.loss import Loss
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes import normal_equations as equations
from factorlib.solve.few_lobes.jacobian import fit_loss, responses
from factorlib.solve.few_lobes.normal_equations import (
    energy_equations,
    nonnegative_minimum,
    normal_equations,
    with_weights_fitted,
)
from studies.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("closed_form", dtype="float64")
LOSS = Loss(robust_scale=1e6, prior=0.0)


@pytest.fixture
def data():
    light = random_light(np.random.default_rng(3), 6)
    shown = block("a", light, MATERIALS, [0, 1, 2], OPERATOR, size=10, seed=1)
    noisy = shown.radiance * (1 + 0.05 * np.random.default_rng(4).normal(size=shown.radiance.shape))
    guess = random_light(np.random.default_rng(5), 9)
    return msgspec.structs.replace(shown, radiance=noisy), guess


def lit(block, light):
    return Illumination(block, light, MATERIALS, OPERATOR)


def by_energy(light, gradient):
    p = len(light)
    return gradient[3 * p : 6 * p].reshape(3, p)


def test_energy_equations_are_those_parts_of_the_normal_equations(data):
    observed, light = data
    given, loss = lit(observed, light), Loss(1.0, 1e-2)
    part, whole, p = energy_equations(given, responses(given), loss), normal_equations(given, loss), len(light)
    gradients, hessians = part.gradients, part.hessians
    np.testing.assert_allclose(part.loss, whole.loss, rtol=1e-12)
    np.testing.assert_allclose(
        gradients, by_energy(light, whole.light_gradient), rtol=1e-9, atol=1e-9 * np.abs(gradients).max()
    )
    for c in range(3):
        own = slice((3 + c) * p, (4 + c) * p)
        np.testing.assert_allclose(hessians[c], whole.light_hessian[own, own], rtol=1e-9, atol=1e-12 * hessians.max())


def test_fitted_weights_are_the_optimum(data):
    """Karush, Kuhn and Tucker: no gradient where there is weight, none that asks for less than nothing elsewhere."""
    observed, light = data
    found, at = with_weights_fitted(lit(observed, light), LOSS)
    before = np.abs(by_energy(light, normal_equations(lit(observed, light), LOSS).light_gradient)).max()
    gradient, energy = by_energy(found, at.light_gradient), found.energy.T
    assert (energy == 0).any() and (energy > 0).any()
    assert np.abs(gradient[energy > 0]).max() < 1e-6 * before
    assert gradient[energy == 0].min() > -1e-6 * before


def test_everything_else_stays(data):
    observed, light = data
    found, at = with_weights_fitted(lit(observed, light), LOSS)
    for name in ("axis", "log_sharpness", "log_exposure"):
        np.testing.assert_array_equal(getattr(found, name), getattr(light, name))
    again = normal_equations(lit(observed, found), LOSS)
    np.testing.assert_allclose(
        at.light_hessian, again.light_hessian, rtol=1e-12, atol=1e-12 * again.light_hessian.max()
    )


def test_the_loss_falls_with_outliers_and_clipped_values_too(data):
    observed, light = data
    rng = np.random.default_rng(6)
    wrong = observed.radiance * np.where(rng.random(observed.radiance.shape) < 0.2, 20.0, 1.0)
    high = wrong > np.quantile(wrong, 0.6)
    harmed = msgspec.structs.replace(observed, radiance=wrong, clipped=high)
    for scale in (0.1, 1.0, 10.0):
        loss = Loss(robust_scale=scale, prior=0.0)
        found, at = with_weights_fitted(lit(harmed, light), loss)
        assert at.loss <= fit_loss(lit(harmed, light), loss) * (1 + 1e-12)
        np.testing.assert_allclose(at.loss, fit_loss(lit(harmed, found), loss), rtol=1e-5)


def test_weights_that_would_raise_the_loss_are_not_taken(data, monkeypatch):
    observed, light = data
    monkeypatch.setattr(
        equations, "of_least_loss", lambda light, _: msgspec.structs.replace(light, weight=9 * light.weight)
    )
    found, at = with_weights_fitted(lit(observed, light), LOSS)
    np.testing.assert_array_equal(found.weight, light.weight)
    assert at.loss == normal_equations(lit(observed, light), LOSS).loss


def test_responses_computed_twice_give_the_same_bits(data, monkeypatch):
    observed, light = data
    kept, at = with_weights_fitted(lit(observed, light), LOSS)
    monkeypatch.setattr(equations, "KEPT", 0)
    again, other = with_weights_fitted(lit(observed, light), LOSS)
    np.testing.assert_array_equal(kept.weight, again.weight)
    np.testing.assert_array_equal(at.light_hessian, other.light_hessian)


def test_what_is_held_out_changes_nothing(data):
    observed, light = data
    out = np.random.default_rng(7).random(len(observed)) < 0.3
    one = msgspec.structs.replace(observed, held_out=out)
    other = msgspec.structs.replace(one, radiance=np.where(out[:, None], 100.0, one.radiance))
    (a, at), (b, bt) = (with_weights_fitted(lit(x, light), LOSS) for x in (one, other))
    np.testing.assert_array_equal(a.weight, b.weight)
    assert at.loss == bt.loss


def test_nonnegative_minimum_against_every_active_set():
    rng = np.random.default_rng(8)
    for _ in range(5):
        a = rng.normal(size=(12, 4))
        hessian, target = a.T @ a, rng.normal(size=4) * 3
        best = min(
            (0.5 * w @ hessian @ w - target @ w, w.tolist())
            for free in np.ndindex(2, 2, 2, 2)
            for w in [_solved_on(hessian, target, np.array(free, bool))]
            if (w >= 0).all()
        )
        np.testing.assert_allclose(nonnegative_minimum(hessian, target), best[1], atol=1e-6)


def _solved_on(hessian, target, free):
    w = np.zeros(len(target))
    if free.any():
        w[free] = np.linalg.solve(hessian[np.ix_(free, free)], target[free])
    return w
