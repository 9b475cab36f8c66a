"""Materials and lights fitted together: found in lights drawn from the prior, laws of the parts of a fit, and the paper's solver."""

import msgspec
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from factorlib.images import tone
from factorlib.inference.fit.fit import (
    DARK_NOISE,
    LIGHT_TEMPERATURE,
    Fit,
    FitSchedule,
    estimate_temperature,
    fit_problem,
    initial_fit,
    reliable_observations,
)
from factorlib.inference.fit.likelihood import cholesky_factor
from factorlib.inference.fit.optimizer import Arrow, Descent, descend_light, determinant_terms
from factorlib.inference.fit.start import constant_light
from factorlib.inference.joint_solver import LIGHTS
from factorlib.inference.model.blocks import Noise
from factorlib.inference.model.lights import TONE_RANGE, Light
from factorlib.inference.model.material_prior import (
    BRIGHTNESS_DEVIATION,
    MEDIAN_BRIGHTNESS,
    MaterialPrior,
    material_unknowns,
)
from factorlib.inference.model.materials import Materials, Point
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.paper_solver import PaperObjective, PaperOptions, draw_subset, solve_paper
from factorlib.reflection import reflection_operator
from factorlib.results.materials import FitStatus
from factorlib.scenes.joint_problems import MATERIALS, factor_between, random_light, sphere_block
from tests.inference.made_lights import (
    FEW,
    OPERATOR,
    PRIOR,
    START,
    WHOLE,
    begun,
    drawn,
    light_of,
    likelihood,
    natural,
    on_even_cells,
    photographed,
    spheres,
)


def materials_in(problem, cells=FEW, start=START, schedule=WHOLE) -> Fit:
    return fit_problem(problem, begun(problem, cells, start), PRIOR, schedule)


@pytest.fixture(scope="module")
def solved():
    return natural()


def test_materials_in_natural_lights(solved):
    _, _, result = solved
    factor = factor_between(result.point.materials, MATERIALS)
    assert np.abs(result.point.materials.roughness - MATERIALS.roughness).max() < 0.1
    whole = (result.point.materials.diffuse + result.point.materials.specular) * factor
    assert np.abs(whole / (MATERIALS.diffuse + MATERIALS.specular) - 1).max() < 0.15


def test_the_gauge_is_where_the_brightest_material_is_of_ordinary_brightness(solved):
    """Lights say nothing of it; without the determinant by the light it would run away."""
    problem, _, result = solved
    bright = Materials(10 * START.diffuse, START.specular, START.roughness)
    for one in (result, materials_in(problem, start=bright)):
        reflectance = (one.point.materials.diffuse + one.point.materials.specular).mean(1)
        assert abs(np.log(reflectance.max() / MEDIAN_BRIGHTNESS)) < 2 * BRIGHTNESS_DEVIATION


def test_a_fit_lowers_its_value(solved):
    """Of materials and lights together, and of lights alone.  The prior on k_d is about the start, so the value of a fit that goes on is
    another, by little."""
    problem, _, result = solved
    again = fit_problem(problem, result, PRIOR, FitSchedule(descents=(0,), estimate_first=False)).value
    value = fit_problem(problem, result, PRIOR, FitSchedule(materials_fixed=True)).value
    assert again == pytest.approx(result.value, rel=1e-3) and np.isfinite(result.value)
    for step, before in (
        (FitSchedule(descents=(3,), estimate_first=False), again),
        (FitSchedule(light_steps=3, materials_fixed=True), value),
    ):
        assert fit_problem(problem, result, PRIOR, step).value <= before + 1e-9 * abs(before)


def test_what_starts_nil_is_found_too():
    """By logarithms nothing would move it."""
    problem, _ = photographed(8, 2, size=12)
    nil = Materials(np.full((3, 3), 1e-5), np.full((3, 3), 0.1), np.full(3, 0.4))
    nil.diffuse[0] = 0.5
    result = materials_in(problem, start=nil).point.materials
    assert (result.diffuse[1] / result.diffuse[0] > 0.2 * MATERIALS.diffuse[1] / MATERIALS.diffuse[0]).all()


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


def errors_of_lights(factor: float, seed: int) -> np.ndarray:
    """RMS error of log radiance of each light, and estimated over true radiance of the cells that are darkest in truth, where normals are
    wrong by some degrees."""
    problem, true = photographed(seed, 3)
    bent = []
    for k, block in enumerate(problem.blocks):
        turn = Rotation.from_rotvec(np.radians(3) * np.random.default_rng(seed + k).normal(size=3)).as_matrix()
        bent.append(msgspec.structs.replace(block, normal=block.normal @ turn.T))
    start = initial_fit(Point(MATERIALS, [light.with_log_radiance(0 * light.log_radiance) for light in true]))
    schedule = msgspec.structs.replace(LIGHTS, light_steps=6, temperature_factor=factor)
    fit = fit_problem(problem.with_blocks(bent), start, PRIOR, schedule)
    errors = []
    for light, actual in zip(fit.point.lights, true, strict=True):
        darkest = np.argsort(actual.weight.mean(1))[: FEW // 5]
        logs = np.log(light.weight / actual.weight)
        errors.append([np.sqrt(np.mean(logs**2)), light.weight[darkest].sum() / actual.weight[darkest].sum()])
    return np.array(errors)


def test_lights_are_nearest_to_the_truth_with_the_factor_in_use_where_normals_are_wrong():
    """It makes directions that are dark in truth hardly brighter: sorted by the estimate, they would look better the less a light varies."""
    trusting, used, doubting = (
        np.vstack([errors_of_lights(factor, seed) for seed in (1, 2)]).mean(0)
        for factor in (1.0, LIGHT_TEMPERATURE, 4 * LIGHT_TEMPERATURE)
    )
    assert used[0] < 0.95 * trusting[0] and used[0] < 0.97 * doubting[0]
    assert used[1] < 1.1 * trusting[1]


def test_the_contrast_of_a_light_is_found(solved):
    """Of one that has four times the variance the factor of the prior is larger."""
    problem, true, result = solved
    more = [light.with_log_radiance(2 * light.log_radiance) for light in true]
    other = materials_in(spheres(more, size=16), schedule=FitSchedule(4, (8, 4, 4, 4)))
    for one, larger in zip(result.hyperparameters, other.hyperparameters, strict=True):
        assert 0.3 < one.factors[0] < 2.5 and larger.factors[0] > 1.5 * one.factors[0]
        assert FitSchedule().least_temperature <= one.temperature < 3  # noise is less than the noise model says


# ── sure normals ─────────────────────────────────────────────────────────────────────────────────────────────────────


def test_materials_are_found_from_sure_normals_with_less_noise_in_the_dark():
    one = photographed(9, 1, cells=40, size=10)[0].blocks[0]
    one = msgspec.structs.replace(one, inverse_sigma=one.noise.inverse_sigma(one.radiance, np.ones(len(one))))
    unsure = np.arange(len(one)) % 3 == 0
    rated = msgspec.structs.replace(one, confidence=np.where(unsure, 0.3, 0.9))
    (reliable,) = reliable_observations(JointProblem([rated], OPERATOR)).blocks
    assert np.array_equal(reliable.normal, one.normal[~unsure]) and np.array_equal(
        reliable.radiance, one.radiance[~unsure]
    )
    noise = Noise(DARK_NOISE * one.noise.absolute, one.noise.relative)
    assert reliable.inverse_sigma == pytest.approx(noise.inverse_sigma(reliable.radiance, np.ones(len(reliable))))


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


@pytest.mark.parametrize("exponents", [(3.0, 1.0), (0.4, 2.5)])
def test_an_unknown_at_its_bound_stops_no_other(exponents):
    """Photos through tone curves beyond the bounds.  The light is at its minimum, given the exponents at their bounds."""
    light = on_even_cells(drawn(30, 60), (0.0, 0.3))
    (block,) = spheres([light], size=12, noise=0.05).blocks
    toned = tone.curve(block.radiance, np.array(exponents)[block.photo][:, None])
    block = msgspec.structs.replace(block, radiance=toned, inverse_sigma=1 / np.hypot(0.05, 0.05 * toned))
    start = msgspec.structs.replace(constant_light(block, MATERIALS, 60), log_tone=np.zeros(2))
    end, system, status = descend_light(likelihood(JointProblem([block], OPERATOR), start), 8)
    low, high = np.log(TONE_RANGE)
    inside = np.append(
        np.ones(start.unknowns - 2, bool), np.abs(end.light.log_tone - (low + high) / 2) < 0.999 * (high - low) / 2
    )
    slope = system.light_gradient[inside]
    assert not inside.all() and slope @ np.linalg.solve(system.light_hessian[np.ix_(inside, inside)], slope) < 1
    # its status says so, and that one step is too few
    assert status.outcome == "converged" and 1 < status.steps < 8
    *_, early = descend_light(likelihood(JointProblem([block], OPERATOR), start), 1)
    assert early == FitStatus("limit", 1)


def test_a_descent_that_no_step_improves_says_that_it_failed(monkeypatch):
    problem, _ = photographed(5, 1, cells=40, size=10)
    start = begun(problem, 40)
    monkeypatch.setattr(
        Descent, "_step", lambda self, state, damping: (state.likelihoods, state.theta + np.array([5.0] * 6 + [0.0]))
    )
    result = fit_problem(problem, start, PRIOR, FitSchedule(descents=(3,)))
    assert result.status == [FitStatus("failed", 3)]


def test_where_a_descent_ends_the_likelihood_has_no_slope_left():
    """Of (1) of the optimizer, in directions that matter: by far less than at the start."""
    problem, _ = photographed(5, 2, cells=40, size=10)
    start = begun(problem, 40)
    result = fit_problem(problem, start, PRIOR, WHOLE)
    prior = MaterialPrior(start.point.materials, problem.blocks)
    descent = Descent(prior, problem.spread, lambda loss: None, np.ones(21, bool))
    sizes = []
    for fit in (start, result):
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
    assert [end.outcome for end in result.status] == ["converged"]
    early = fit_problem(problem, start, PRIOR, FitSchedule(descents=(1,)))
    assert early.status == [FitStatus("limit", 1)]


# ──  ────────────────────────────────────────────────────────────────────────────────────────────────────────────────


EXACT = reflection_operator("closed_form", dtype="float64")
BRIEF = PaperOptions(lobes=8, samplings=200)


def rooms(photos=1, size=16):
    rng = np.random.default_rng(3)
    return [
        sphere_block(f"room{i}", random_light(rng, 3, photos), MATERIALS, [0, 1, 2], OPERATOR, size=size)
        for i in range(2)
    ]


def paper_fit(blocks, paper=BRIEF):
    return solve_paper(JointProblem(blocks, OPERATOR), 3, paper)


@pytest.fixture(scope="module")
def paper_solved():
    blocks = rooms()
    return blocks, paper_fit(blocks)


@pytest.mark.long
def test_roughly_recovers_the_materials_and_the_radiance_it_was_rendered_with(paper_solved):
    blocks, result = paper_solved[0], paper_solved[1].point
    factor, rough = factor_between(result.materials, MATERIALS), result.materials.roughness
    np.testing.assert_allclose(rough[1:], MATERIALS.roughness[1:], atol=0.15)  # the first is all but Lambertian
    # the glossy one is split badly
    np.testing.assert_allclose(result.materials.diffuse * factor, MATERIALS.diffuse, rtol=0.3, atol=0.05)
    for data, radiance in zip(blocks, JointProblem(blocks, OPERATOR).radiance(result), strict=True):
        assert np.sqrt(np.mean((radiance - data.radiance) ** 2)) < 0.05 * np.quantile(data.radiance, 0.99)
    for light in result.lights:
        assert len(light) == BRIEF.lobes and (light.weight >= 0).all()
        assert np.isfinite(light.weight).all() and np.isfinite(light.sharpness).all()
        np.testing.assert_allclose(np.linalg.norm(light.axis, axis=1), 1)


def test_the_same_seed_gives_the_same_answer_and_scaling_a_photo_scales_its_light_alone():
    short, blocks = msgspec.structs.replace(BRIEF, samplings=3), rooms(size=10)
    brighter = [msgspec.structs.replace(blocks[0], unit=7 * blocks[0].unit), blocks[1]]
    one, *others = (paper_fit(of, short).point for of in (blocks, blocks, brighter))
    for other in others:
        np.testing.assert_array_equal(one.materials.vector(), other.materials.vector())
        np.testing.assert_array_equal(one.lights[0].weight, other.lights[0].weight)  # in units of the block


def test_gradient_is_the_finite_difference():
    """Along random directions, each of which moves every unknown."""
    blocks, random = rooms(photos=2, size=8), torch.Generator().manual_seed(0)
    objective = PaperObjective(JointProblem(blocks, EXACT), 3, PaperOptions(lobes=3))
    subset = draw_subset([np.arange(len(b)) for b in blocks], 60, np.random.default_rng(0))
    start = objective.start()
    x = start + 0.3 * torch.randn(len(start), generator=random, dtype=torch.float64)
    _, gradient = objective.objective_on(x, subset)
    for move in torch.randn(6, len(start), generator=random, dtype=torch.float64):
        slope = (
            objective.objective_on(x + 1e-6 * move, subset)[0] - objective.objective_on(x - 1e-6 * move, subset)[0]
        ) / 2e-6
        assert float(gradient @ move) == pytest.approx(float(slope), rel=1e-4)
