"""The joint solve with a prior on lights: laws of its parts, and materials and lights found in lights drawn from the prior."""

import msgspec
import numpy as np
import pytest

from benchmarks.solve.problems import MATERIALS, block, factor_between, random_light
from factorlib.diagnose.posterior import MODEL_ERROR, Posterior
from factorlib.light.prior import MIX, read_light_prior
from factorlib.model.lights import UnitLobes
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.model.responses import unit_values
from factorlib.reflection import reflection_operator
from factorlib.solve.lattice import NODES, Lattice, Reflections
from factorlib.solve.marginal import Field, marginal
from factorlib.solve.marginal_descent import LEVEL, TINT, MaterialPrior, materials_of, unknowns_of
from factorlib.solve.natural import DARK, LOBES, lights_from_all, naturally, sure_ones, temperature

FEW = 120  # lobes of a lattice, so that tests are quick
OPERATOR, PRIOR, NOBODY = reflection_operator("network"), read_light_prior(), np.zeros(3, bool)


def drawn(seed: int, lattice: Lattice) -> np.ndarray:
    """Log radiance [3, p] drawn from the prior, without the level of its exposure."""
    rng, fields = np.random.default_rng(seed), []
    for k in range(3):
        covariance = PRIOR.covariance(k, lattice.axis) - (PRIOR.level[0] if k == 0 else 0.0)
        fields.append(np.linalg.cholesky(covariance + 1e-9 * np.eye(len(lattice))) @ rng.normal(size=len(lattice)))
    return np.linalg.solve(MIX, fields)


def photographed(
    seed: int, lights: int, lobes: int = FEW, size: int = 16, noise: float = 0.3, materials: Materials = MATERIALS
) -> tuple[JointProblem, list[np.ndarray]]:
    """Spheres of three materials in lights drawn from the prior, with noise, and the log radiances in the blocks' units."""
    lattice, blocks, true = Lattice.of(lobes), [], []
    rng = np.random.default_rng(seed)
    for k in range(lights):
        log_radiance = drawn(100 * seed + k, lattice)
        light = lattice.light(log_radiance, random_light(rng, 1))
        clean = block(f"room{k}", light, materials, [0, 1, 2], OPERATOR, size=size, seed=k)
        noisy = clean.radiance + noise * rng.normal(size=clean.radiance.shape) / clean.precision
        blocks.append(msgspec.structs.replace(clean, radiance=np.maximum(noisy, 0.0)))
        true.append(log_radiance - np.log(clean.unit))
    return JointProblem(blocks, OPERATOR, Loss()), true


def field_of(problem: JointProblem, lobes: int, temperature: float = 2.0) -> Field:
    """Of the first illumination, without outliers."""
    lattice, one = Lattice.of(lobes), problem.blocks[0]
    like = random_light(np.random.default_rng(0), 1, len(one.photos))
    precision = PRIOR.precision(lattice.axis)
    return Field(one, like, lattice, Reflections(one, lattice, OPERATOR), precision, temperature, 1e3)


def test_equal_weights_of_a_lattice_are_a_constant_light_but_for_a_ripple():
    for count in (200, LOBES):
        lattice = Lattice.of(count)
        light = lattice.light(np.zeros((3, count)), random_light(np.random.default_rng(0), 1))
        directions = np.random.default_rng(1).normal(size=(2000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        shown = np.exp(light.sharpness * (directions @ light.axis.T - 1)) @ light.weight
        ripple = np.abs(shown - 1)  # largest at the poles, where the lattice is least even
        assert shown.std() < 0.03 and np.quantile(ripple, 0.99) < 0.1 and abs(shown.mean() - 1) < 0.005, (shown.std(), ripple.max())


def test_responses_between_nodes_are_those_of_the_operator():
    problem, _ = photographed(0, 1, lobes=60, size=10)
    lattice, one = Lattice.of(60), problem.blocks[0]
    table = Reflections(one, lattice, OPERATOR)
    for roughness in (0.1, 0.28, 0.55, float(NODES[3]), 1.0):
        found, rows = table.at(1, roughness), table.rows(1)
        diffuse, specular = unit_values(one, np.arange(rows.start, rows.stop), UnitLobes(lattice.axis, lattice.unit_lobes.sharpness), roughness, OPERATOR)
        assert np.allclose(found.diffuse, diffuse, rtol=1e-5, atol=1e-7)
        assert np.abs(found.specular - specular).max() < 0.01 * specular.max()
    step = 1e-3
    slope = (table.at(1, 0.28 + step).specular - table.at(1, 0.28 - step).specular) / (2 * step)
    assert np.allclose(table.at(1, 0.28).by_roughness, slope, rtol=0.02, atol=1e-3 * np.abs(slope).max())


def test_gradients_are_finite_differences():
    problem, true = photographed(1, 1, lobes=50, size=10)
    field, log_radiance, theta = field_of(problem, 50), true[0], unknowns_of(MATERIALS)
    here = marginal(field, log_radiance, MATERIALS)

    def at(change, step):
        return marginal(field, log_radiance, materials_of(theta + step * change)).value

    for place in range(theta.size):
        change = np.eye(theta.size)[place].reshape(theta.shape)
        difference = (at(change, 2e-3) - at(change, -2e-3)) / 4e-3 / 2
        assert here.material_gradient[place] == pytest.approx(difference, rel=0.02, abs=0.02 * np.abs(here.material_gradient).max()), place
    rng = np.random.default_rng(2)

    def posterior(u):
        part = marginal(field, u, MATERIALS)
        return part.loss / field.temperature + u.reshape(-1) @ field.precision @ u.reshape(-1)

    for _ in range(3):
        change = rng.normal(size=log_radiance.shape)
        difference = (posterior(log_radiance + 1e-3 * change) - posterior(log_radiance - 1e-3 * change)) / 2e-3 / 2
        assert here.light_gradient @ change.reshape(-1) == pytest.approx(difference, rel=0.02, abs=0.02 * np.abs(here.light_gradient).max())


def test_given_materials_the_system_of_the_light_is_the_same():
    problem, true = photographed(1, 1, lobes=50, size=10)
    field = field_of(problem, 50)
    one, other = (marginal(field, true[0], MATERIALS, materials_given=given) for given in (False, True))
    for name in ("value", "loss", "light_gradient", "light_hessian"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_the_determinant_is_needed_for_roughness():
    """With it the likelihood of a roughness is highest near the true one; the loss and the prior alone prefer smoother materials."""
    problem, true = photographed(3, 1, lobes=100, size=14, noise=1.0)
    one = problem.blocks[0].take(problem.blocks[0].material == 1)
    alone = JointProblem([one], OPERATOR, Loss())
    field, start = field_of(alone, 100, temperature=1.0), true[0]

    def best(u, roughness):
        materials = msgspec.structs.replace(MATERIALS, roughness=np.array([0.7, roughness, 0.25]))
        for _ in range(12):
            part = marginal(field, u, materials)
            u = u - np.linalg.solve(part.light_hessian, part.light_gradient).clip(-1, 1).reshape(u.shape)
        part = marginal(field, u, materials)
        off = u.reshape(-1)
        return part.value, part.loss / field.temperature + off @ field.precision @ off

    tried = (0.15, 0.25, 0.4, 0.55)
    marginals, posteriors = zip(*(best(start, roughness) for roughness in tried), strict=True)
    assert tried[int(np.argmin(marginals))] == pytest.approx(0.4, abs=0.16)
    assert np.argmin(posteriors) <= np.argmin(marginals)


def test_correlated_residuals_count_less():
    problem, true = photographed(4, 1, lobes=50, size=16)
    field, rng = field_of(problem, 50), np.random.default_rng(0)
    independent = rng.normal(size=problem.blocks[0].radiance.shape)
    field = msgspec.structs.replace(field, robust_scale=10.0)
    assert temperature(field, independent) == pytest.approx(1.0, abs=0.35)
    assert temperature(field, 2 * independent) == pytest.approx(4.0, rel=0.35)
    assert temperature(field, np.ones_like(independent)) > 5


@pytest.fixture(scope="module")
def solved():
    problem, true = photographed(5, 3)
    start = Point(msgspec.structs.replace(MATERIALS, diffuse=np.full((3, 3), 0.3), specular=np.full((3, 3), 0.1), roughness=np.full(3, 0.4)), [])
    start = Point(start.materials, [random_light(np.random.default_rng(k), 1) for k in range(3)])
    return problem, true, naturally(problem, start, PRIOR, NOBODY, lobes=FEW)


def test_materials_in_natural_lights(solved):
    problem, _, found = solved
    factor = factor_between(found.point.materials, MATERIALS)
    assert np.abs(found.point.materials.roughness - MATERIALS.roughness).max() < 0.1
    whole = (found.point.materials.diffuse + found.point.materials.specular) * factor
    assert np.abs(whole / (MATERIALS.diffuse + MATERIALS.specular) - 1).max() < 0.15


def test_what_starts_nil_is_found_too():
    """By logarithms nothing would move it."""
    problem, _ = photographed(8, 2, size=12)
    nil = Materials(np.full((3, 3), 1e-5), np.full((3, 3), 0.1), np.full(3, 0.4))
    nil.diffuse[0] = 0.5
    lights = [random_light(np.random.default_rng(k), 1) for k in range(2)]
    found = naturally(problem, Point(nil, lights), PRIOR, NOBODY, lobes=FEW).point.materials
    assert (found.diffuse[1] / found.diffuse[0] > 0.2 * MATERIALS.diffuse[1] / MATERIALS.diffuse[0]).all()


def test_a_nil_reflectance_is_not_known_for_sure(solved):
    problem, _, found = solved
    materials = found.point.materials
    nil = msgspec.structs.replace(materials, diffuse=np.where([[False], [False], [True]], 0.0, materials.diffuse))
    there = msgspec.structs.replace(found, point=Point(nil, found.point.lights))
    errors, at_nil = (Posterior(problem, one, PRIOR).standard_errors().materials for one in (found, there))
    assert (at_nil.diffuse[2] > 0.3 * errors.diffuse[2]).all()
    assert (errors.vector() > 0).all()


def test_no_observation_mends_what_the_model_has_wrong(solved):
    """k_s and roughness are never known better than the model is right."""
    problem, _, found = solved
    errors, materials = Posterior(problem, found, PRIOR).standard_errors().materials, found.point.materials
    assert (errors.roughness >= MODEL_ERROR[6]).all() and (errors.specular >= MODEL_ERROR[3:6] * materials.specular).all()
    assert (errors.diffuse >= MODEL_ERROR[:3] * materials.diffuse).all() and (MODEL_ERROR > 0).all()


def test_lights_lie_within_their_standard_errors(solved):
    """Log radiance of cells, after the factor per channel that is free: about 68 % within one posterior standard deviation."""
    problem, true, found = solved
    posterior = Posterior(problem, found, PRIOR)
    within = []
    for system, u, u_true in zip(posterior.systems(with_scores=False), found.log_radiance, true, strict=True):
        deviation = np.sqrt(np.diag(np.linalg.inv(system.light_hessian))).reshape(u.shape)
        off = u - u_true
        within.append(np.abs(off - np.median(off, axis=1, keepdims=True)) < deviation)
    assert 0.5 < np.mean(within) < 0.9
    maps = posterior.relative_standard_errors()
    assert set(maps) == {"room0", "room1", "room2"} and all((m > 0).all() and np.isfinite(m).all() for m in maps.values())


def test_materials_are_found_from_sure_normals_with_less_noise_in_the_dark():
    problem, _ = photographed(9, 1, lobes=40, size=10)
    one = problem.blocks[0]
    one = msgspec.structs.replace(one, precision=one.noise.precision(one.radiance, np.ones(len(one))))
    unsure = np.arange(len(one)) % 3 == 0
    rated = msgspec.structs.replace(one, confidence=np.where(unsure, 0.3, 0.9))
    (kept,) = sure_ones(JointProblem([rated], OPERATOR, Loss())).blocks
    assert np.array_equal(kept.normal, one.normal[~unsure]) and np.array_equal(kept.radiance, one.radiance[~unsure])
    noise = Noise(DARK * one.noise.absolute, one.noise.relative)
    assert kept.precision == pytest.approx(noise.precision(kept.radiance, np.ones(len(kept))))


def test_what_is_alike_unsure_is_used():
    """Legs of few pixels are all a material has: sure is what is as sure as the rest of the same material."""
    problem, _ = photographed(9, 1, lobes=40, size=10)
    one = problem.blocks[0]
    rated = msgspec.structs.replace(one, confidence=np.where(one.material == 1, 0.1, 0.9))
    for given in (rated, one):
        assert len(sure_ones(JointProblem([given], OPERATOR, Loss())).blocks[0]) == len(one)


def test_lights_from_the_observations_that_they_were_found_from_stay(solved):
    problem, _, found = solved
    again = lights_from_all(problem, found, PRIOR)
    assert np.array_equal(again.point.materials.vector(), found.point.materials.vector())
    systems = Posterior(problem, found, PRIOR).systems(with_scores=False)
    for system, u, u_again in zip(systems, found.log_radiance, again.log_radiance, strict=True):
        deviation = np.sqrt(np.diag(np.linalg.inv(system.light_hessian))).reshape(u.shape)
        assert np.mean(np.abs(u_again - u) < deviation) > 0.95


def test_lights_from_all_show_what_the_others_alone_see(solved):
    """Found from a half of the observations, given the true materials, lights explain the other half better afterwards."""
    problem, _, found = solved
    half = [msgspec.structs.replace(b, confidence=np.where(b.normal[:, 0] > 0, 0.9, 0.1)) for b in problem.blocks]
    start = Point(found.point.materials, found.point.lights)
    of_half = naturally(sure_ones(msgspec.structs.replace(problem, blocks=half)), start, PRIOR, NOBODY, lobes=FEW)
    others = msgspec.structs.replace(problem, blocks=[b.take(b.normal[:, 0] <= 0).with_none_held_out() for b in problem.blocks])
    assert others.held_out_loss(lights_from_all(problem, of_half, PRIOR).point) < 0.5 * others.held_out_loss(of_half.point)


def test_order_of_lights_changes_nothing():
    problem, _ = photographed(7, 2, lobes=40, size=10)
    start, found = Materials(np.full((3, 3), 0.3), np.full((3, 3), 0.1), np.full(3, 0.4)), []
    for order in (slice(None), slice(None, None, -1)):
        lights = [random_light(np.random.default_rng(k), 1) for k in range(2)][order]
        turned = JointProblem(problem.blocks[order], OPERATOR, Loss())
        found.append(naturally(turned, Point(start, lights), PRIOR, NOBODY, lobes=40).point.materials.vector())
    assert np.allclose(*found, rtol=1e-3, atol=1e-4)


def test_the_gauge_is_held_by_the_prior_of_materials():
    problem, _ = photographed(6, 1, lobes=50, size=10)
    prior, theta = MaterialPrior(MATERIALS, problem.blocks), unknowns_of(MATERIALS)
    brighter = theta.copy()
    brighter[:, [0, 3]] += 0.05
    assert prior.at(brighter).value - prior.at(theta).value > 20
    rng = np.random.default_rng(0)
    change = rng.normal(size=theta.shape) * 1e-4
    at = theta + 0.01 * rng.normal(size=theta.shape)
    difference = (prior.at(at + change).value - prior.at(at - change).value) / 4
    assert prior.at(at).gradient @ change.reshape(-1) == pytest.approx(difference, rel=1e-2)


def test_a_grey_specular_part_of_a_few_hundredths_is_expected():
    """A dielectric costs nothing, twice its reflectance little, gold less than a few hundred observations say; a Lambertian material nothing."""

    def costs(specular):
        materials = Materials(np.full((1, 3), 0.4), np.array([specular]), np.array([0.3]))
        return MaterialPrior(materials, []).at(unknowns_of(materials)).value

    assert costs([0.05] * 3) == pytest.approx(0, abs=1e-12) and costs([0.0] * 3) == pytest.approx(0, abs=1e-3)
    assert costs([0.1] * 3) == pytest.approx((np.log(2) / LEVEL) ** 2)
    assert costs([0.05 * np.exp(0.1), 0.05, 0.05 * np.exp(-0.1)]) == pytest.approx(2 * (0.1 / TINT) ** 2)
    assert 30 < costs([1, 0.8, 0.3]) < 60


def test_gold_among_paints_is_not_taken_for_a_paint():
    """Up to the factor per channel that is free."""
    gold = Materials(
        np.vstack([MATERIALS.diffuse[:2], [0.01] * 3]),
        np.array([[0.05] * 3, [0.04] * 3, [0.7, 0.55, 0.25]]),
        MATERIALS.roughness,
    )
    problem, _ = photographed(10, 2, materials=gold)
    start = Materials(np.full((3, 3), 0.3), np.full((3, 3), 0.1), np.full(3, 0.4))
    lights = [random_light(np.random.default_rng(k), 1) for k in range(2)]
    found = naturally(problem, Point(start, lights), PRIOR, NOBODY, lobes=FEW).point.materials
    assert found.specular[2] * factor_between(found, gold) == pytest.approx(gold.specular[2], rel=0.15)
