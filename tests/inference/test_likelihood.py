"""The marginal likelihood: gradients, gauge, why the determinant is in it; tabulated responses and their derivatives; the prior on materials."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.fit.likelihood import EXPOSURE_DEVIATION, TONE_DEVIATION
from factorlib.inference.model.blocks import RobustLoss
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.material_prior import (
    MaterialPrior,
    Mixture,
    likeliest_class,
    material_unknowns,
    materials_from_unknowns,
    shipped_classes,
)
from factorlib.inference.model.materials import Materials, Point
from factorlib.inference.model.normal_errors import with_normal_errors
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.model.responses import ResponseTable
from factorlib.scenes.joint_problems import MATERIALS, sphere_block
from tests.inference.made import none_held_out
from tests.inference.made_lights import OPERATOR, PRIOR, drawn, likelihood, on_even_cells, photographed, spheres

CELLS = 50
THETA = material_unknowns(MATERIALS)


def prior_of(light, precision) -> float:
    """uᵀQu and the Gaussians of turns, exposures and tone exponents."""
    u = light.log_radiance.reshape(-1)
    return float(
        u @ precision @ u
        + light.turns @ light.turns
        + np.sum((light.log_exposure / EXPOSURE_DEVIATION) ** 2)
        + np.sum((light.log_tone / TONE_DEVIATION) ** 2)
    )


def log_det(one) -> float:
    """log det H, of the value."""
    part = one.normal_equations()
    return part.value - part.loss / one.temperature - prior_of(one.light, one.precision) + one.log_determinant


def posterior(one) -> float:
    """φ."""
    return one.normal_equations(determinants=False).loss / one.temperature + prior_of(one.light, one.precision)


def moved(light, step):
    """The light after a step of all its unknowns."""
    counts = [3 * len(light), len(light.turns), len(light.log_exposure) - 1]
    cells, turns, exposures, tones = np.split(step, np.cumsum(counts))
    light = light.with_log_radiance(light.log_radiance + cells.reshape(3, -1))
    exposure = light.log_exposure + np.concatenate([[0.0], exposures])
    return msgspec.structs.replace(
        light, turns=light.turns + turns, log_exposure=exposure, log_tone=light.log_tone + tones
    )


@pytest.fixture(scope="module", params=["one photo", "three photos", "three turned photos"])
def here(request):
    """The true light, off by a little, in the likelihood of what its photos show; tone curves are the identity for the determinant."""
    exposure = [0.0] if request.param == "one photo" else [0.0, 0.4, -0.5]
    light = on_even_cells(drawn(1, CELLS), exposure)
    problem = spheres([light], size=8)
    if request.param == "three turned photos":
        block = msgspec.structs.replace(problem.blocks[0], confidence=np.ones(len(problem.blocks[0])))
        problem = with_normal_errors(problem.with_blocks([block]), Point(MATERIALS, [light]))
        light = light.with_turns(9)
        light.turns[:] = np.random.default_rng(6).normal(size=9)
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
    """By cells and by exposures."""
    light, rng, by_light = here.light, np.random.default_rng(4), here.normal_equations().determinant_by_light
    unit = np.eye(light.unknowns)
    all_cells, one_cell = unit[: 3 * CELLS].sum(0), unit[by_light[: 3 * CELLS].argmax()]
    for step in (all_cells, one_cell, rng.normal(size=light.unknowns), *unit[light.integrated :]):
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
        part, light = one.normal_equations(determinants=False), one.light
        one = one.with_point(moved(light, -np.linalg.solve(part.light_hessian, part.light_gradient).clip(-1, 1)))
    return one


@pytest.mark.parametrize("seed", range(2))
def test_the_determinant_is_needed_for_roughness(seed):
    """With it the likelihood of a roughness is highest at the true one; the loss and the prior alone prefer far smoother materials."""
    problem, true = photographed(seed, 1, cells=100, size=14, noise=1.0)
    block = none_held_out(problem.blocks[0].take(problem.blocks[0].material == 1))
    one = likelihood(JointProblem([block], OPERATOR), true[0], temperature=1.0)
    tried, result = (0.15, 0.25, 0.4, 0.55), []
    for roughness in tried:
        there = settled(one.with_point(materials=msgspec.structs.replace(MATERIALS, roughness=np.full(3, roughness))))
        result.append((there.normal_equations().value, posterior(there)))
    values, posteriors = np.array(result).T
    assert tried[values.argmin()] == MATERIALS.roughness[1] and np.sort(values)[1] - values.min() > 10
    assert tried[posteriors.argmin()] < MATERIALS.roughness[1] and posteriors[2] - posteriors.min() > 10


# ── Tabulated responses, and the derivatives of the forward model that come of them ─────────────────────────────────


TABLE_CELLS, ALL = 60, RobustLoss(1e6)  # no outliers


def made(seed, photos=1, toned=False, hidden=False, bounced=False, clipped=False, near=False) -> Illumination:
    """Two materials of random reflectances in one light of several photos, with its table; what the photos show is of another light."""
    rng = np.random.default_rng(seed)
    exposure = [0.0, *rng.normal(0, 0.5, photos - 1)]
    light = on_even_cells(drawn(seed, TABLE_CELLS) * 0.6, exposure, rng.uniform(-0.25, 0.25, photos) if toned else ())
    materials = Materials(rng.uniform(0.05, 0.6, (2, 3)), rng.uniform(0.03, 0.4, (2, 3)), rng.uniform(0.12, 0.9, 2))
    data = sphere_block(f"room{seed}", light, materials, [0, 1], OPERATOR, size=8)
    light = light.with_log_radiance(light.log_radiance - np.log(data.unit))
    n = len(data)
    if hidden:
        turned = [fibonacci_sphere(96) @ np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(photos)]
        visibility = (255 * (rng.random((n, 96)) < 0.8)).astype(np.uint8)
        data = msgspec.structs.replace(data, visibility=visibility, directions=np.stack(turned))
    if bounced:
        data = msgspec.structs.replace(data, bounced=rng.random((n, 6)) * (rng.random((n, 1)) < 0.5))
    if near:
        data = msgspec.structs.replace(data, place=rng.normal(size=(n, 3)) / 3**0.5)
        light = msgspec.structs.replace(light, curvature=0.2)
    if clipped:
        data = msgspec.structs.replace(data, clipped=rng.random((n, 3)) < 0.3)
    off = np.exp(rng.normal(0, 0.2, data.radiance.shape))
    one = Illumination(msgspec.structs.replace(data, radiance=data.radiance * off), light, materials, OPERATOR)
    return msgspec.structs.replace(one, table=ResponseTable(one.block, light.unit_lobes, OPERATOR))


ANY = {
    "seed": st.integers(0, 10_000),
    "photos": st.integers(1, 3),
    "toned": st.booleans(),
    "hidden": st.booleans(),
    "bounced": st.booleans(),
    "near": st.booleans(),
    "clipped": st.booleans(),
}
FEW_EXAMPLES = settings(max_examples=8, deadline=None, derandomize=True)


@FEW_EXAMPLES
@given(**ANY)
def test_the_table_shows_what_the_operator_shows(**how):
    one = made(**how)
    by_operator = msgspec.structs.replace(one, table=None)
    np.testing.assert_allclose(one.radiance(), by_operator.radiance(), atol=0.01)  # a block's mean is 1
    assert one.predict().responses and not by_operator.predict().responses


def linear(one: Illumination, of, change) -> np.ndarray:
    """What `of` (a part of a Linearised) says of a change, for all residuals."""
    result = np.zeros((len(one.block), 3))
    for part in one.linearise(one.predict(), ALL):
        result[part.rows, part.channel] = of(part, change)
    return result


def check_against_differences(one: Illumination, moved, found: np.ndarray, step: float) -> None:
    """moved: the illumination at a multiple of a change; what is held out or where a bound of the residual is passed is left out."""
    high, low = (moved(sign * step).residuals() for sign in (1, -1))
    difference = (high - low) / (2 * step)
    counts = ~one.block.held_out[:, None] & ~(
        one.block.clipped & (np.minimum(high, low) < 0) & (np.maximum(high, low) >= 0)
    )
    np.testing.assert_allclose(found[counts], difference[counts], rtol=0.01, atol=0.003 * np.abs(difference).max())
    assert not found[np.broadcast_to(one.block.held_out[:, None], found.shape)].any()


def check_derivatives(one: Illumination) -> None:
    """Of the residuals by every unknown."""
    replaced, light, materials = msgspec.structs.replace, one.light, one.materials
    rng, m, k = np.random.default_rng(0), len(one.materials), len(one.block.photos)

    def with_u(change):
        return replaced(one, light=light.with_log_radiance(light.log_radiance + change))

    def with_materials(change):
        kd, ks = materials.diffuse * np.exp(change[:, :3]), materials.specular * np.exp(change[:, 3:6])
        return replaced(one, materials=Materials(kd, ks, materials.roughness + change[:, 6]))

    def with_photos(change):
        exposure = light.log_exposure + np.concatenate([[0.0], change[: k - 1]])
        return replaced(one, light=replaced(light, log_exposure=exposure, log_tone=light.log_tone + change[k - 1 :]))

    def by_material(part, by):
        return part.by_material @ by.reshape(-1)[part.places]

    du, dm = rng.normal(size=light.log_radiance.shape), rng.normal(size=(m, 7)) * np.array([1.0] * 6 + [0.05])
    dp = rng.normal(size=k - 1 + len(light.log_tone))
    kinds = np.repeat([0, 1, 2], [3, 3, 1])  # k_d, k_s, roughness
    exposures = np.arange(len(dp)) < k - 1
    changes = [(with_u, lambda part, by: (part.diffuse + part.specular) @ by[part.channel], du, 5e-3)]
    changes += [(with_materials, by_material, dm * (kinds == kind), 1e-2) for kind in range(3)]
    changes += [(with_photos, lambda part, by: part.by_photo @ by, dp * own, 5e-3) for own in (exposures, ~exposures)]
    for moved, of, by, step in changes:
        if by.any():
            check_against_differences(one, lambda s, moved=moved, by=by: moved(s * by), linear(one, of, by), step)


@FEW_EXAMPLES
@given(**ANY)
def test_derivatives_are_finite_differences(**how):
    check_derivatives(made(**how))


def test_outliers_and_temperature_are_factors_on_residual_and_derivatives():
    one = made(4)
    plain, weighed = (list(one.linearise(one.predict(), loss, T)) for loss, T in ((ALL, 1.0), (RobustLoss(0.5), 4.0)))
    trust = np.sqrt(RobustLoss(0.5).weights(one.residuals()))
    for a, b in zip(plain, weighed, strict=True):
        factor = trust[a.rows, a.channel] / 2
        for name in ("diffuse", "by_roughness", "by_material"):
            np.testing.assert_allclose(getattr(b, name), factor[:, None] * getattr(a, name), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(b.residual, factor * a.residual, rtol=1e-4, atol=1e-6)


# ── The prior on materials: what classes it knows, what they cost, and how they are fitted ──────────────────────────


PLASTIC, GOLD, FELT = ([0.03] * 3, 0.2), ([0.3, 0.21, 0.09], 0.2), ([0.22] * 3, 0.9)


@pytest.mark.parametrize("seed", range(2))
def test_the_gradient_is_the_finite_difference_of_the_value(seed):
    problem, rng = photographed(6, 1, cells=50, size=10)[0], np.random.default_rng(seed)
    prior, theta = MaterialPrior(MATERIALS, problem.blocks), material_unknowns(MATERIALS)
    at = theta + np.array([0.3] * 6 + [0.1]) * rng.normal(size=theta.shape)
    change = rng.normal(size=theta.shape) * 1e-4
    difference = (prior.evaluate(at + change).value - prior.evaluate(at - change).value) / 4
    assert prior.evaluate(at).gradient @ change.reshape(-1) == pytest.approx(difference, rel=1e-4)
    assert np.linalg.eigvalsh(prior.evaluate(at).hessian).min() > 0


def test_the_density_is_one_altogether():
    """Over the level of k_s, its tint and the roughness, where k_d is 0: the sum on a grid."""
    level, roughness, tint = np.arange(-9, 4, 1.0), np.arange(-1.5, 3, 0.35), np.arange(-1.6, 1.61, 0.2)
    mixture, across = Mixture(shipped_classes().classes), np.array([[1, -1, 0], [1, 1, -2]]) / np.sqrt([[2], [6]])
    grid = np.array(np.meshgrid(level, tint, tint, roughness)).reshape(4, -1).T
    black = np.full((len(grid), 3), -30.0)
    points = np.column_stack([black, grid[:, :1] + grid[:, 1:3] @ across, grid[:, 3]])
    total = sum(np.exp(-mixture.evaluate(point)[0] / 2) for point in points)
    assert total * 1.0 * 0.35 * 0.2**2 / (2 * np.pi) ** 2 == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("material, name", [(PLASTIC, "dielectric"), (GOLD, "metal"), (FELT, "fabric")])
def test_materials_are_of_the_class_that_they_look_like(material, name):
    theta = np.log([0.01] * 3 + material[0])
    result, probability = likeliest_class(np.append(theta, material[1]), 0.05, 0.02)
    assert result == name and probability > 0.8


def test_the_tints_of_both_parts_differ_as_measured():
    """White balance is the same for both, and widens nothing."""
    tint = np.array([0.3, 0.0, -0.3])
    for one in shipped_classes().classes[1:]:
        mixture, grey = Mixture([one]), np.array([*[20.0] * 3, *[one.mean[0]] * 3, one.mean[1]])  # e is the tint of k_d
        cost = mixture.evaluate(grey + np.append(tint, [0.0] * 4))[0] - mixture.evaluate(grey)[0]
        assert cost == pytest.approx(tint @ tint / one.tint_difference**2, rel=1e-6)


def test_a_rough_specular_part_of_the_complementary_tint_is_no_fabric():
    """Measured fabrics have one tint in both parts; a set's orange wood once got a blue specular part."""
    mixture = Mixture(shipped_classes().classes)

    def cost(specular):
        return mixture.evaluate(np.array([*np.log([0.4, 0.2, 0.1]), *np.log(specular), 0.8]))[0]

    assert cost([0.3, 0.15, 0.075]) + 40 < cost([0.075, 0.15, 0.3])


def test_gloss_ten_times_too_strong_at_roughness_1_is_not_expected():
    """It is possible, for fabrics look so, but evidence has to pay for it; and a smooth surface with a strong highlight is metal or nothing."""

    def cost(specular, roughness):
        materials = Materials(np.full((1, 3), 0.3), np.array([specular]), np.array([roughness]))
        return MaterialPrior(materials, []).evaluate(material_unknowns(materials)).value

    assert cost([0.3] * 3, 1.0) > cost(*PLASTIC) + 6
    assert cost([0.03] * 3, 1.0) > cost(*PLASTIC) + 6
    assert cost(*PLASTIC) + 3 < cost([0.3] * 3, 0.2) < cost([0.3] * 3, 1.0)


def test_the_gradient_without_a_jacobian_is_that_of_the_normal_equations(here):
    gradient, system = here.gradient(), here.normal_equations(determinants=False)
    assert gradient.value == pytest.approx(system.value, rel=1e-6)
    np.testing.assert_allclose(gradient.by_light, system.light_gradient, atol=1e-4 * np.abs(gradient.by_light).max())


def test_the_determinant_is_that_of_cells_and_turns(here):
    system = here.normal_equations(determinants=False)
    count = here.light.integrated
    assert count == 3 * CELLS + len(here.light.turns)
    log_det = np.linalg.slogdet(system.light_hessian[:count, :count])[1] - here.log_determinant
    assert here.marginal(system) - system.value == pytest.approx(log_det)
