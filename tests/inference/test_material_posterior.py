"""Laws of the posterior of a material: observations decide where they are exact, the prior where they are silent."""

import numpy as np
import pytest
from scipy.optimize import minimize

from factorlib.inference.answer.material_posterior import BOUNDS, material_posterior
from factorlib.inference.model.material_prior import Mixture, shipped_classes

ENAMEL = np.array([*np.log([0.3, 0.2, 0.1]), *np.log([0.2, 0.2, 0.2]), 0.12])
ALL = np.ones(7, bool)
CLASSES = Mixture(shipped_classes().classes, one_tint=False)

NO_ERROR = np.zeros((7, 7))
WRONG = np.diag([0.0] * 3 + [900.0] * 4)  # errors of the model that leave k_s and roughness unknown


def covariance(deviation, correlation: float = 0.0) -> np.ndarray:
    """Equal correlation of k_d and k_s in each channel, and no other."""
    deviations = np.broadcast_to(deviation, 7)
    result = np.diag(deviations**2)
    for c in range(3):
        result[c, c + 3] = result[c + 3, c] = correlation * deviations[c] * deviations[c + 3]
    return result


def random_covariance(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(7, 7)) * np.array([0.3] * 6 + [0.1])[:, None]
    return root @ root.T + np.diag([0.01] * 7)


def posterior_of(fitted, sigma, *others):
    """Where errors of the observations are as the fit assumes."""
    return material_posterior(fitted, sigma, sigma, *others)


@pytest.mark.parametrize("deviation", [1e-3, 0.0])
def test_exact_observations_decide(deviation):
    posterior = posterior_of(ENAMEL, covariance(deviation), NO_ERROR, ALL)
    np.testing.assert_allclose(posterior.theta, ENAMEL, atol=1e-4)
    assert (posterior.prior_share < 1e-3).all()
    np.testing.assert_allclose(posterior.deviation, deviation, rtol=1e-3, atol=1e-6)


def least(precision: np.ndarray, start: np.ndarray):
    """Return the minimum of (θ − θ₀)ᵀ P (θ − θ₀) − 2 log p from a start."""

    def energy(x: np.ndarray) -> float:
        return (x - ENAMEL) @ precision @ (x - ENAMEL) + CLASSES.evaluate(x)[0]

    return minimize(energy, start, bounds=BOUNDS, tol=1e-12)


MODEL_ERRORS = {"none": NO_ERROR, "few": covariance([0.0] * 3 + [0.3] * 3 + [0.1]), "many": covariance([0.1] * 3 + [1.0] * 3 + [0.3])}  # fmt: skip


@pytest.mark.parametrize("errors", MODEL_ERRORS.values(), ids=MODEL_ERRORS)
@pytest.mark.parametrize("seed", range(6))
def test_a_fit_under_the_prior_stays_unless_errors_of_the_model_give_the_prior_its_say(seed, errors):
    """A wider covariance than the fit weighs widens errors and moves nothing: the fit weighed its prior against its own."""
    sigma, random = random_covariance(seed), np.random.default_rng(seed)
    fit = least(np.linalg.inv(sigma), ENAMEL).x
    starts = [fit, ENAMEL, *(np.append(ENAMEL[:3], mean) for mean in CLASSES.mean)]
    starts += [np.clip(random.normal(ENAMEL, 1.0), *np.transpose(BOUNDS)) for _ in range(5)]
    expected = min((least(np.linalg.inv(sigma + errors), start) for start in starts), key=lambda one: one.fun)
    posterior = material_posterior(fit, sigma, 4 * sigma, errors, ALL)
    np.testing.assert_allclose(
        posterior.theta, expected.x if errors.any() else fit, atol=5e-3 if errors.any() else 1e-3
    )
    assert (posterior.deviation > posterior_of(fit, sigma, errors, ALL).deviation).all()


def test_where_the_model_is_wrong_the_material_is_a_likely_one():
    posterior = posterior_of(ENAMEL, covariance([0.1] * 3 + [0.01] * 4), WRONG, ALL)
    starts = [np.append(ENAMEL[:3], mean) for mean in CLASSES.mean]
    modes = [minimize(lambda x: CLASSES.evaluate(x)[0], start, tol=1e-10).fun for start in starts]
    assert CLASSES.evaluate(posterior.theta)[0] == pytest.approx(min(modes), abs=1.0)
    assert (posterior.prior_share[3:] > 0.8).all() and (posterior.prior_share[:3] < 0.01).all()
    np.testing.assert_allclose(posterior.theta[:3], ENAMEL[:3], atol=1e-6)


def test_the_diffuse_part_takes_what_the_specular_part_loses():
    """Errors of the model give the prior its say, and k_d follows by the observations' correlation."""
    sigma = covariance([0.3] * 3 + [0.5] * 3 + [0.1], correlation=-0.9)
    center = ENAMEL + sigma @ CLASSES.evaluate(ENAMEL)[1]
    off = posterior_of(ENAMEL, sigma, covariance([0.0] * 3 + [1.0] * 3 + [0.5]), ALL).theta - center
    share = sigma[0, 3] / (sigma[3, 3] + 1.0)
    assert (off[3:6] < -0.2).all()
    np.testing.assert_allclose(off[:3], share * off[3:6], rtol=1e-3)


def test_known_unknowns_stay():
    free = np.array([True] * 3 + [False] * 4)
    errors = covariance(0.3)
    posterior = posterior_of(ENAMEL, np.where(np.outer(free, free), covariance(0.2), 0.0), errors, free)
    np.testing.assert_array_equal(posterior.theta, ENAMEL)
    assert (posterior.deviation[3:] == 0).all() and (posterior.prior_share == 0).all()
    free[3:] = [True] * 3 + [False]
    partly = posterior_of(ENAMEL, np.where(np.outer(free, free), covariance(0.5), 0.0), errors, free)
    assert partly.theta[6] == ENAMEL[6] and partly.deviation[6] == 0 and (partly.theta[3:6] != ENAMEL[3:6]).any()


def test_a_reflectance_near_zero_does_not_look_exactly_known():
    """Its logarithm has no limit, and its error is that of the observations."""
    black = np.array([*np.log([1e-5] * 3), *ENAMEL[3:]])
    posterior = posterior_of(black, covariance([2000.0] * 3 + [0.1] * 3 + [0.05]), NO_ERROR, ALL)
    np.testing.assert_allclose(posterior.deviation[:3] * 1e-5, 0.02, rtol=0.05)


@pytest.mark.parametrize(("name", "least", "most"), [("dielectric", 0.01, 0.06), ("metal", 0.06, 0.3)])
def test_a_named_class_decides_where_the_model_is_wrong(name, least, most):
    posterior = posterior_of(ENAMEL, covariance(0.01), WRONG, ALL, name)
    assert least < np.exp(posterior.theta[3:6].mean()) < most
