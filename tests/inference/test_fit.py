"""Materials and lights fitted together: found in lights drawn from the prior, and laws of the parts of a fit."""

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
from factorlib.inference.priors import BRIGHTNESS_DEVIATION, MEDIAN_BRIGHTNESS
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
