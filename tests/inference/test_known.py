"""Unknowns that are known stay where they are and settle the scale of all others; standard errors, the lights' colour, and what is unexplained."""

import msgspec
import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.geometry.camera import rotation_of_vector
from factorlib.geometry.sphere import fibonacci_sphere, mirror_directions
from factorlib.inference.answer.identifiability import tinted_alike
from factorlib.inference.answer.uncertainty import (
    LARGEST_RELATIVE_ERROR,
    WIDTHS,
    Posterior,
    project_to_gauge,
)
from factorlib.inference.fit import optimizer
from factorlib.inference.fit.fit import FitSchedule, fit_problem, initial_fit
from factorlib.inference.fit.optimizer import Descent, step_light
from factorlib.inference.fit.start import insert_known
from factorlib.inference.model.gauge import BRIGHTEST, fix_gauge
from factorlib.inference.model.known import KnownValues, light_from_ball, light_from_map
from factorlib.inference.model.lights import Light
from factorlib.inference.model.material_prior import MaterialPrior, PriorTerms, material_unknowns
from factorlib.inference.model.materials import LEAST_REFLECTANCE, Point
from factorlib.inference.model.misfit import unexplained_shares
from factorlib.inference.model.problem import JointProblem
from factorlib.light.latlong import map_energy
from factorlib.reflection import reflection_operator
from factorlib.scenes.joint_problems import MATERIALS, factor_between, random_light, sphere_block, sphere_normals
from tests.inference.made import in_units_of, observations_from_front
from tests.inference.made_lights import (
    FEW,
    PRIOR,
    START,
    WHOLE,
    begun,
    drawn,
    likelihood,
    natural,
    on_even_cells,
    photographed,
    spheres,
)

LAMP, QUICK = np.array([0.48, -0.6, -0.64]), FitSchedule(2, (3,))
CARD = KnownValues({1: MATERIALS.rows()[1]})


@pytest.fixture(scope="module")
def solved():
    problem, _ = photographed(5, 3)
    problem = msgspec.structs.replace(problem, known=CARD)
    return problem, fit_problem(problem, initial_fit(insert_known(begun(problem).point, problem)), PRIOR, WHOLE)


def test_a_known_material_stays_and_gives_the_others_their_scale_and_colour(solved):
    problem, result = solved
    materials = result.point.materials
    np.testing.assert_allclose(materials.rows()[1], MATERIALS.rows()[1], rtol=1e-12)
    np.testing.assert_allclose(materials.diffuse, MATERIALS.diffuse, rtol=0.03)  # in absolute scale
    in_place, moved = (fix_gauge(result.point, problem.blocks, known).materials for known in (CARD, KnownValues()))
    assert (in_place.vector() == materials.vector()).all() and (moved.diffuse != materials.diffuse).any()


def test_a_descent_with_known_unknowns_is_that_of_a_prior_that_holds_them(monkeypatch):
    """Against the slow and obvious: a penalty of 1e7 on the unknowns that are known."""
    monkeypatch.setattr(optimizer, "TOLERANCE", 1e-9)
    monkeypatch.setattr(optimizer, "DECREMENT", 1e-6)
    monkeypatch.setattr(optimizer, "DECREMENT_SHARE", 1e-6)
    problem, _ = photographed(5, 1, cells=40, size=10)
    known = KnownValues({1: np.array([0.2, 0.4, 0.25, np.nan, np.nan, np.nan, 0.4])})
    free, theta = known.free(3), material_unknowns(START)
    stiffness = np.where(free, 0, 1e7)

    class Stiff(MaterialPrior):
        def evaluate(self, theta):
            value, gradient, hessian = super().evaluate(theta)
            off = (theta - self.mean).reshape(-1)
            return PriorTerms(value + stiffness @ off**2, gradient + stiffness * off, hessian + np.diag(stiffness))

    prior, stiff = (of(START, problem.blocks, known) for of in (MaterialPrior, Stiff))
    one, ends = likelihood(problem, begun(problem, 40).point.lights[0], START), []
    for of, moving in ((prior, free), (stiff, np.ones(21, bool))):
        descent = Descent(of, problem.spread, lambda loss: None, moving)
        ends.append(descent.descend_jointly(descent.linearise([one], theta), 40)[0])
    assert (ends[0].theta.reshape(-1)[~free] == theta.reshape(-1)[~free]).all() and (ends[0].theta != theta).any()
    np.testing.assert_allclose(ends[0].theta, ends[1].theta, atol=5e-3)


def test_what_is_known_has_no_error_and_nothing_else_is_held_fixed(solved):
    """Without it the sum of each channel is fixed; where a light is known but for a factor, the sum over channels."""
    problem, result = solved
    errors = Posterior(problem, result, PRIOR).standard_errors().materials
    assert (errors.rows()[1] == 0).all() and (errors.rows()[[0, 2]] > 0).all()
    light = msgspec.structs.replace(result.point.lights[0], fixed=np.ones(FEW, bool), scale_free=True)
    root = np.random.default_rng(0).normal(size=(21, 21))
    for known, fixed in (
        (CARD, [False, False]),
        (KnownValues(), [True, True]),
        (KnownValues(lights={"room0": light}), [False, True]),
    ):
        covariance = project_to_gauge(root @ root.T, MATERIALS, msgspec.structs.replace(problem, known=known))
        one, all_ = (np.tile(np.isin(np.arange(7), list(of)), 3) for of in ([0, 3], range(6)))  # a channel; all
        assert [abs(of @ covariance @ of) < 1e-9 for of in (one, all_)] == fixed


def test_a_known_reflectance_of_nil_stays_nil_and_nothing_is_expected_of_brightness_beside_it(solved):
    problem, _ = solved
    known = KnownValues({1: np.array([0.2, 0.4, 0.25, 0, 0, 0, np.nan])})
    problem = msgspec.structs.replace(problem, known=known)
    result = fit_problem(
        problem, initial_fit(insert_known(begun(problem).point, problem)), PRIOR, QUICK
    ).point.materials
    assert result.specular[1].max() <= LEAST_REFLECTANCE * (1 + 1e-9)
    assert not MaterialPrior(MATERIALS, problem.blocks, known).members
    assert MaterialPrior(MATERIALS, problem.blocks).members


def test_a_start_comes_to_the_scale_of_what_is_known_and_shows_the_same(solved):
    problem, _ = solved
    known = KnownValues({0: np.array([*(3 * START.diffuse[0]), *(3 * START.specular[0]), np.nan])})
    point = begun(problem).point
    there = insert_known(point, msgspec.structs.replace(problem, known=known))
    np.testing.assert_allclose(there.materials.diffuse, 3 * START.diffuse)
    for one, other in zip(problem.radiance(there), problem.radiance(point), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


# ── lights ───────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("scale_free", [True, False])
def test_the_slope_of_a_light_that_is_known_in_part_is_that_of_its_value(scale_free):
    """Against finite differences along a step of its unknowns, of which known cells have at most their common factor."""
    problem, (true,) = photographed(5, 1, cells=30, size=10)
    fixed, curves = true.axis[:, 2] < 0, {"log_tone": np.array([0.1])}
    one = likelihood(problem, msgspec.structs.replace(true, fixed=fixed, scale_free=scale_free, **curves))
    system = one.normal_equations(determinants=False)
    step = np.random.default_rng(0).normal(size=one.light.unknowns)
    assert len(step) == 3 * (~fixed).sum() + 1 + scale_free == len(system.light_gradient)
    lights = [step_light(one.light, s * step) for s in (1e-3, -1e-3)]
    ahead, behind = (one.with_point(light).normal_equations(determinants=False).value for light in lights)
    assert (ahead - behind) / 4e-3 == pytest.approx(system.light_gradient @ step, rel=1e-3)
    nothing = msgspec.structs.replace(problem, blocks=[problem.blocks[0].take(slice(0))])
    prior = likelihood(nothing, one.light)  # which is quadratic, so that its Hessian is no approximation
    ahead, behind = (prior.with_point(light).normal_equations(determinants=False).light_gradient for light in lights)
    hessian = prior.normal_equations(determinants=False).light_hessian
    np.testing.assert_allclose((ahead - behind) / 2e-3, hessian @ step, rtol=1e-6, atol=1e-8)
    free = np.tile(~fixed, 3)
    assert one.log_determinant == pytest.approx(np.linalg.slogdet(one.precision[np.ix_(free, free)])[1])
    after = step_light(one.light, 1e-3 * step).weight[fixed] / true.weight[fixed]
    assert np.ptp(after) < 1e-12 and (after[0, 0] != 1) == scale_free


def test_a_light_that_is_known_gives_materials_their_absolute_scale_and_one_up_to_a_factor_their_tint():
    """Of the other light nothing is known; in the second, cells toward the viewer are not either."""
    problem, true = photographed(5, 2)
    tint = MATERIALS.diffuse / MATERIALS.diffuse.mean(1, keepdims=True)
    for scale_free, fixed in ((False, np.ones(FEW, bool)), (True, true[0].axis[:, 2] > -0.8)):
        weight = true[0].weight * (7.0 if scale_free else problem.blocks[0].unit)  # the photo's, or units of their own
        light = msgspec.structs.replace(true[0], weight=weight, fixed=fixed, scale_free=scale_free)
        one = msgspec.structs.replace(problem, known=KnownValues(lights={"room0": light}))
        start = insert_known(begun(one).point, one)
        change = np.log(start.materials.diffuse / START.diffuse)
        assert (abs(change.mean()) < 1e-9) == scale_free and np.abs(change).max() > 0.01
        result = fit_problem(one, initial_fit(start), PRIOR, WHOLE).point
        answer = fix_gauge(result, one.blocks, one.known)
        np.testing.assert_allclose(
            answer.materials.diffuse / answer.materials.diffuse.mean(1, keepdims=True), tint, rtol=0.05
        )
        factor = result.lights[0].weight[fixed] / true[0].weight[fixed]
        assert np.ptp(factor) < 1e-9 * factor.mean()
        if scale_free:
            assert (answer.materials.diffuse + answer.materials.specular).max() == pytest.approx(BRIGHTEST)
            assert (result.lights[0].weight[~fixed] != begun(one).point.lights[0].weight[~fixed]).all()
        else:
            assert factor[0, 0] == pytest.approx(1) and (answer.materials.vector() == result.materials.vector()).all()
            np.testing.assert_allclose(answer.materials.diffuse, MATERIALS.diffuse, rtol=0.05)


def test_exposures_that_are_known_stay_and_have_no_unknowns():
    light = on_even_cells(drawn(3, 40), (0.0, 0.0))
    problem = msgspec.structs.replace(spheres([light], size=10), known=KnownValues(exposures=("room0",)))
    result = fit_problem(
        problem, initial_fit(insert_known(begun(problem, 40).point, problem)), PRIOR, QUICK
    ).point.lights[0]
    assert (result.log_exposure == 0).all() and result.unknowns == 3 * 40
    free = fit_problem(problem, begun(problem, 40), PRIOR, QUICK).point.lights[0]
    assert free.log_exposure[1] != 0 and free.unknowns == 3 * 40 + 1


def lamp(directions: np.ndarray) -> np.ndarray:
    """Radiance of a coloured sky with a lamp of 6° in direction LAMP."""
    near = np.exp(np.minimum(400.0 * (directions @ LAMP - 1), 0))[:, None]
    return (1 + 0.5 * directions[:, 1:2]) * [0.8, 1.0, 1.2] + 300 * near * [1.0, 0.9, 0.7]


def off_lamp(light: Light) -> float:
    """Degrees between the directions, on average, of what comes from within 15° of the lamp and should."""
    near = (everywhere := fibonacci_sphere(20000))[everywhere @ LAMP > np.cos(np.radians(15))]
    radiance = light.lobes.radiance(near)
    one, other = (of.sum(1) @ near / np.linalg.norm(of.sum(1) @ near) for of in (radiance, lamp(near)))
    return float(np.degrees(np.arccos(one @ other)))


def test_a_map_becomes_a_light_of_its_energy_in_its_directions(monkeypatch):
    monkeypatch.setattr("factorlib.inference.model.known.MAP_ROWS", 40)
    radiance = lamp((lat_long_directions(40, 80) @ YUP_FROM_CAMERA).reshape(-1, 3)).reshape(40, 80, 3)
    light = light_from_map(radiance)
    np.testing.assert_allclose(light.energy.sum(0), map_energy(radiance), rtol=1e-3)
    assert light.fixed.all() and light.scale_free and off_lamp(light) < 0.3
    larger = light_from_map(np.repeat(np.repeat(radiance, 6, 0), 6, 1))  # more rows than are used
    np.testing.assert_allclose(larger.energy.sum(0), light.energy.sum(0), rtol=1e-2)


def test_what_a_mirror_ball_shows_is_the_light_but_behind_it_where_another_object_stands_and_where_it_is_clipped():
    normals, turn = sphere_normals(60), rotation_of_vector(np.array([0.2, -0.5, 0.1]))
    view = np.tile([0.0, 0.0, -1.0], (len(normals), 1))
    mirror = mirror_directions(normals, view)
    sphere = fibonacci_sphere(512)
    hidden = sphere[:, 0] > 0.9
    clipped, sees = np.tile(mirror[:, 1:2] > 0.9, 3), np.tile(np.where(hidden, 0, 255).astype(np.uint8), (len(view), 1))
    radiance, zero = 0.5 * lamp(mirror @ turn.T), np.zeros(len(view), int)
    observed = observations_from_front(normals, radiance, zero, ("chrome",), clipped=clipped, visibility=sees)
    observed.radiance[mirror[:, 0] > 0.88] = 1e3  # of the other object
    light = light_from_ball(observed, np.full(3, 0.5), turn)
    out = {"behind": [0, 0, 1], "object": [1, 0, 0], "clipped": [0, 1, 0]}
    assert not any(light.fixed[np.argmax(light.axis @ turn @ axis)] for axis in out.values())

    def far(directions: np.ndarray) -> np.ndarray:
        return np.all([directions @ turn @ axis < np.cos(np.radians(45)) for axis in out.values()], axis=0)

    assert light.fixed[far(light.axis)].all() and not light.scale_free
    there = (everywhere := fibonacci_sphere(4000))[far(everywhere)]
    radiance = light.lobes.radiance(there)
    np.testing.assert_allclose(radiance.mean(0), lamp(there).mean(0), rtol=0.02)
    assert off_lamp(light) < 1


# ── Standard errors of materials and lights, what is said of the lights' colour, and what is unexplained ────────────


OPERATOR = reflection_operator("network")


# ── they cover the truth, and nothing is known for sure that is not ─────────────────────────────────


@pytest.fixture(scope="module")
def fit():
    """The problem, the true lights, the fit, and the errors of its materials."""
    problem, true, result = natural()
    return problem, true, result, Posterior(problem, result, PRIOR).standard_errors()


def test_materials_lie_within_a_few_standard_errors(fit):
    errors, m = fit[3].materials.rows(), fit[2].point.materials
    factor = np.concatenate([np.tile(factor_between(m, MATERIALS), 2), [1.0]])
    off = (m.rows() * factor - MATERIALS.rows()) / (errors * factor)
    assert np.mean(np.abs(off) < 1) > 0.5 and np.mean(np.abs(off) < 3) > 0.95, np.round(off, 1)


def test_lights_lie_within_their_standard_errors(fit):
    """Log radiance of cells, after the factor per channel that is free: about 68 % within one posterior standard deviation."""
    problem, true, result, _ = fit
    made, within = [], []
    posterior = Posterior(problem, result, PRIOR, lambda: made.append(1))
    for system, light, true_light in zip(posterior.systems(with_scores=False), result.point.lights, true, strict=True):
        deviation = np.sqrt(np.diag(np.linalg.inv(system.light_hessian))[: (3 * len(light))]).reshape(3, -1)
        off = light.log_radiance - np.log(true_light.lobes.radiance(light.axis)).T
        within.append(np.abs(off - np.median(off, axis=1, keepdims=True)) < deviation)
    assert 0.5 < np.mean(within) < 0.9 and len(made) == len(true)  # a tick a light
    maps = posterior.relative_standard_errors()
    assert set(maps) == {"room0", "room1", "room2"}
    assert all(((m > 0) & (m <= LARGEST_RELATIVE_ERROR)).all() and np.isfinite(m).all() for m in maps.values())


@pytest.mark.parametrize(
    ("tints", "bounced", "said"),
    [
        ([[1, 3, 3], [1, 4, 3]], True, True),  # red is what surfaces are then
        ([[1, 3, 3], [1, 4, 3]], False, False),  # the rule of the gauge makes lights grey
        ([[1, 3, 3], [4, 1, 1]], True, False),  # one light is blue-green, another red: not alike
        ([[1, 1.3, 1.2], [1, 1.2, 1.5]], True, False),  # as natural lights are
    ],
)
def test_a_colour_that_all_lights_have_is_named_where_interreflection_fixes_it(tints, bounced, said):
    rng, operator = np.random.default_rng(0), reflection_operator("closed_form", dtype="float64")
    replaced, lights = msgspec.structs.replace, [random_light(rng, 3) for _ in tints]
    grey = [replaced(one, weight=np.repeat(one.weight.mean(1, keepdims=True), 3, axis=1)) for one in lights]
    blocks = [sphere_block(f"room{k}", light, MATERIALS, [0, 1, 2], operator, size=6) for k, light in enumerate(grey)]
    if bounced:
        blocks = [replaced(one, bounced=np.zeros((len(one), 6))) for one in blocks]
    pairs = enumerate(zip(grey, tints, strict=True))
    lights = [replaced(light, weight=10.0**k * light.weight * tint) for k, (light, tint) in pairs]
    sentences = list(tinted_alike(JointProblem(blocks, operator), Point(MATERIALS, lights)))
    assert len(sentences) == said
    if said:
        for words in ("room0, room1", "R : G : B = 0.4", "solve.interreflection=off"):
            assert words in sentences[0]


# ── what is unexplained: what neighbours leave alike ──────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def exact():
    """Two lights, two photos of the second, each showing three balls, at the truth."""
    rng = np.random.default_rng(3)
    lights = [random_light(rng, 3), random_light(rng, 3, photos=2)]
    blocks = [sphere_block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR) for k, light in enumerate(lights)]
    return JointProblem(blocks, OPERATOR), Point(MATERIALS, in_units_of(blocks, lights))


def changed(exact, **columns):
    """The first block with other columns."""
    problem, point = exact
    return JointProblem([msgspec.structs.replace(problem.blocks[0], **columns), problem.blocks[1]], OPERATOR), point


def unexplained(problem, point):
    """The misfit of a point."""
    return unexplained_shares(problem, problem.radiance(point))


def test_the_truth_leaves_nothing_and_noise_next_to_nothing(exact):
    whole, photos = unexplained(*exact)
    assert whole < 1e-6 and set(photos) == {"room0_0", "room1_0", "room1_1"}
    assert {type(whole), *(type(photo.unexplained) for photo in photos.values())} == {float}  # as JSON takes it
    radiance = exact[0].blocks[0].radiance
    noisy = radiance + 0.1 * np.random.default_rng(0).normal(size=radiance.shape)
    assert unexplained(*changed(exact, radiance=noisy))[0] < 0.01


def test_what_neighbours_leave_alike_is_the_share_of_the_shading_that_it_is(exact):
    block = exact[0].blocks[0]
    means = np.array([block.radiance[block.material == m].mean(0) for m in block.material])
    flatter = means + 0.7 * (
        block.radiance - means
    )  # of the shading, 70 % is there: the model shows .3/.7 of it too much
    _, photos = unexplained(*changed(exact, radiance=flatter))
    assert photos["room0_0"].unexplained == pytest.approx((0.3 / 0.7) ** 2, rel=0.02)
    assert photos["room1_1"].unexplained < 1e-6


def test_errors_of_well_observed_materials_are_small(fit):
    assert (fit[3].materials.rows() < 0.2 * np.array(WIDTHS)).all()
