"""x"""

import msgspec
import numpy as np
import pytest

from factorlib.inference.blocks import Noise
from factorlib.inference.fit import (
    DARK_NOISE,
    Fit,
    FitSchedule,
    estimate_temperature,
    fit_problem,
    reliable_observations,
)
from factorlib.inference.lights import Light, fibonacci_cells
from factorlib.inference.likelihood import cholesky_factor, cholesky_inverse
from factorlib.inference.materials import Materials
from factorlib.inference.optimizer import Arrow, Descent, determinant_terms, minimise_lbfgs
from factorlib.inference.priors import BRIGHTNESS_DEVIATION, MEDIAN_BRIGHTNESS, MaterialPrior, material_unknowns
from factorlib.inference.problem import JointProblem
from factorlib.scenes.joint_problems import MATERIALS, factor_between
from tests.inference.made_lights import (
    FEW,
    OPERATOR,
    PRIOR,
    START,
    WHOLE,
    begun,
    light_of,
    likelihood,
    natural,
    on_even_cells,
    photographed,
    spheres,
)

QUICK, LIGHTS = FitSchedule(4, (8, 6)), FitSchedule(joint_steps=(0, 10, 10), materials_fixed=True)


def materials_in(problem, cells=FEW, start=START, schedule=WHOLE) -> Fit:
    return fit_problem(problem, begun(problem, cells, start), PRIOR, schedule)


@pytest.fixture(scope="module")
def solved():
    return natural()


def test_materials_in_natural_lights(solved):
    _, _, found = solved
    factor = factor_between(found.point.materials, MATERIALS)
    assert np.abs(found.point.materials.roughness - MATERIALS.roughness).max() < 0.1
    whole = (found.point.materials.diffuse + found.point.materials.specular) * factor
    assert np.abs(whole / (MATERIALS.diffuse + MATERIALS.specular) - 1).max() < 0.15


def test_the_gauge_is_where_the_brightest_material_is_of_ordinary_brightness(solved):
    """Lights say nothing of it; without the determinant by the light it would run away."""
    problem, _, found = solved
    bright = Materials(10 * START.diffuse, START.specular, START.roughness)
    for one in (found, materials_in(problem, start=bright)):
        reflectance = (one.point.materials.diffuse + one.point.materials.specular).mean(1)
        assert abs(np.log(reflectance.max() / MEDIAN_BRIGHTNESS)) < 2 * BRIGHTNESS_DEVIATION


def test_a_fit_lowers_its_value(solved):
    """Of materials and lights together, and of lights alone.  The prior on k_d is about the start, so the value of a fit that goes on is
    another, by little."""
    problem, _, found = solved
    again = fit_problem(problem, found, PRIOR, FitSchedule(joint_steps=(0,), estimate_first=False)).value
    given = fit_problem(problem, found, PRIOR, FitSchedule(materials_fixed=True)).value
    assert again == pytest.approx(found.value, rel=1e-3) and np.isfinite(found.value)
    for step, before in (
        (FitSchedule(joint_steps=(3,), estimate_first=False), again),
        (FitSchedule(light_steps=3, materials_fixed=True), given),
    ):
        assert fit_problem(problem, found, PRIOR, step).value <= before + 1e-9 * abs(before)


def test_what_starts_nil_is_found_too():
    """By logarithms nothing would move it."""
    problem, _ = photographed(8, 2, size=12)
    nil = Materials(np.full((3, 3), 1e-5), np.full((3, 3), 0.1), np.full(3, 0.4))
    nil.diffuse[0] = 0.5
    found = materials_in(problem, start=nil).point.materials
    assert (found.diffuse[1] / found.diffuse[0] > 0.2 * MATERIALS.diffuse[1] / MATERIALS.diffuse[0]).all()


def test_lights_from_the_observations_that_they_were_found_from_stay(solved):
    problem, _, found = solved
    again = fit_problem(problem, found, PRIOR, LIGHTS)
    assert np.array_equal(again.point.materials.vector(), found.point.materials.vector())
    for one, how, light, after in zip(
        problem.without_held_out().blocks, found.hyperparameters, found.point.lights, again.point.lights, strict=True
    ):
        alone = likelihood(JointProblem([one], OPERATOR), light, found.point.materials, how.temperature)
        deviation = np.sqrt(np.diag(np.linalg.inv(alone.normal_equations(materials_given=True).light_hessian))).reshape(
            3, -1
        )
        assert np.mean(np.abs(after.log_radiance - light.log_radiance) < deviation) > 0.95


# ── hyperparameters ──────────────────────────────────────────────────────────────────────────────────────────────────


def test_correlated_residuals_count_less():
    one, rng = photographed(4, 1, cells=50, size=16)[0].blocks[0], np.random.default_rng(0)
    independent = rng.normal(size=one.radiance.shape)
    assert estimate_temperature(one, independent) == pytest.approx(1.0, abs=0.35)
    assert estimate_temperature(one, np.ones_like(independent)) > 5
    assert estimate_temperature(one, 0.1 * independent) == FitSchedule().least_temperature
    assert estimate_temperature(one, 1e9 * np.ones_like(independent)) == estimate_temperature(
        one, 3 * np.ones_like(independent)
    )  # outliers
    assert 2 < estimate_temperature(one, 2 * independent) < 4


def test_the_contrast_of_a_light_is_found(solved):
    """Of one that has four times the variance the factor of the prior is larger."""
    problem, true, found = solved
    more = [light.with_log_radiance(2 * light.log_radiance) for light in true]
    other = materials_in(spheres(more, size=16), schedule=FitSchedule(4, (8, 4, 4, 4)))
    for one, larger in zip(found.hyperparameters, other.hyperparameters, strict=True):
        assert 0.3 < one.factors[0] < 2.5 and larger.factors[0] > 1.5 * one.factors[0]
        assert FitSchedule().least_temperature <= one.temperature < 3  # noise is less than the noise model says


# ── sure normals ─────────────────────────────────────────────────────────────────────────────────────────────────────


def test_materials_are_found_from_sure_normals_with_less_noise_in_the_dark():
    one = photographed(9, 1, cells=40, size=10)[0].blocks[0]
    one = msgspec.structs.replace(one, precision=one.noise.precision(one.radiance, np.ones(len(one))))
    unsure = np.arange(len(one)) % 3 == 0
    rated = msgspec.structs.replace(one, confidence=np.where(unsure, 0.3, 0.9))
    (kept,) = reliable_observations(JointProblem([rated], OPERATOR)).blocks
    assert np.array_equal(kept.normal, one.normal[~unsure]) and np.array_equal(kept.radiance, one.radiance[~unsure])
    noise = Noise(DARK_NOISE * one.noise.absolute, one.noise.relative)
    assert kept.precision == pytest.approx(noise.precision(kept.radiance, np.ones(len(kept))))


# ── lights unlike most: a fit says what the photographs say, not what is usual ───────────────────────────────────────


def found_in(lights: list[Light], shown=(0, 1, 2)) -> Fit:
    """The fit of noisy spheres of `shown` materials, one photo a light."""
    return materials_in(spheres(lights, shown=shown))


def contrast(light: Light) -> float:
    """Standard deviation over the cells of the log radiance, the mean of the channels."""
    return float(light.log_radiance.mean(0).std())


def test_a_constant_light_stays_nearly_constant():
    constant = light_of([[0, 0, 1.0]], 1e-4, [[1.0, 1.0, 1.0]])
    assert contrast(found_in([constant]).point.lights[0]) < 0.3  # natural light has 1.2


def test_one_photo_of_one_material():
    light = on_even_cells(np.tile(1.5 * np.sin(3 * fibonacci_cells(FEW).axis[:, 0] + 1), (3, 1)))
    found = found_in([light], (2,)).point
    assert all(np.isfinite(part).all() for part in (found.materials.vector(), found.lights[0].weight))
    assert contrast(found.lights[0]) < 3


def test_an_inverse_is_numpys_and_exactly_symmetric():
    root = np.random.default_rng(0).normal(size=(60, 60))
    matrix = root @ root.T + np.eye(60)
    factor = cholesky_factor(matrix)
    inverse = cholesky_inverse(factor)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(factor @ factor.T, matrix, rtol=1e-12, atol=1e-12)
    assert (inverse == inverse.T).all()


@pytest.mark.parametrize("spoilt", [-1.0, np.nan])
def test_what_is_not_positive_definite_is_an_error(spoilt):
    matrix = np.eye(4)
    matrix[2, 2] = spoilt
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        cholesky_factor(matrix)


# ── The descent: the arrow's solution is the dense one, minima that are known are found, and where it ends the gradie


def test_the_arrow_is_solved_as_the_dense_system_is():
    problem, lights = photographed(5, 2, cells=20, size=8)
    systems = [likelihood(problem.select_lights([k]), lights[k]).normal_equations() for k in (0, 1)]
    size, prior = 21, np.eye(21)
    free = np.arange(size) != 3
    ends = np.cumsum([size, *(len(one.light_gradient) for one in systems)])
    dense, right = np.zeros((ends[-1],) * 2), np.random.default_rng(0).normal(size=ends[-1])
    dense[:size, :size] = prior
    for one, first, last in zip(systems, ends, ends[1:], strict=False):
        own = slice(first, last)
        dense[np.ix_(one.places, one.places)] += one.material_hessian
        dense[one.places, own] = one.cross_hessian
        dense[own, one.places] = one.cross_hessian.T
        dense[own, own] = one.light_hessian
    moving = np.append(free, np.ones(ends[-1] - size, bool))
    by_materials, *by_lights = np.split(right, ends[:-1])
    step, of_lights = Arrow(systems, prior, free).solve(by_materials, by_lights)
    expected = np.zeros(ends[-1])
    expected[moving] = np.linalg.solve(dense[np.ix_(moving, moving)], right[moving])
    np.testing.assert_allclose(np.concatenate([step, *of_lights]), expected, rtol=1e-4, atol=1e-5)


def quadratic(x):
    scale = np.array([1e4, 1.0, 1e-2])
    return float(scale @ (x - 1) ** 2), scale * (x - 1)


def valley(x):
    """Return 1e6 times the function of Rosenbrock (1960)."""
    off = np.array([1 - x[0], 10 * (x[1] - x[0] ** 2)])
    slope = np.array([-off[0] - 20 * x[0] * off[1], 10 * off[1]])
    return 1e6 * float(off @ off), 1e6 * slope


@pytest.mark.parametrize(
    ("objective", "size", "metric"),
    [(quadratic, 3, lambda g: g / np.array([1e4, 1.0, 1e-2])), (valley, 2, lambda g: g / 1e8)],
)
def test_minima_that_are_known_are_found(objective, size, metric):
    x = np.zeros(size)
    for _ in range(16):  # each begins at the end of the one before, as on a new factorisation
        x = x + minimise_lbfgs(lambda step, begun=x: objective(begun + step), size, metric)
    np.testing.assert_allclose(x, 1.0, atol=1e-2)


def test_where_a_descent_ends_the_likelihood_has_no_slope_left():
    """Of (1) of the optimizer, in directions that matter: by far less than at the start."""
    problem, _ = photographed(5, 2, cells=40, size=10)
    start = begun(problem, 40)
    found = fit_problem(problem, start, PRIOR, WHOLE)
    prior = MaterialPrior(start.point.materials, problem.blocks)
    descent = Descent(prior, problem.spread, lambda loss: None, np.ones(21, bool))
    sizes = []
    for fit in (start, found):
        lights = fit.point.lights
        ones = [
            likelihood(
                problem.without_held_out().select_lights([k]),
                lights[k],
                fit.point.materials,
                fit.hyperparameters[k].temperature,
            )
            for k in range(2)
        ]
        state = descent.linearise(ones, material_unknowns(fit.point.materials))
        slope = state.prior.gradient + determinant_terms(state.systems, 21)[0]
        for one in state.systems:
            slope[one.places] += one.material_gradient
        sizes.append(np.abs(slope).max())
    assert sizes[1] < 0.05 * sizes[0], sizes
