"""A light is known better, and in absolute terms, where its photos show the surroundings."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.choices.model_selection import select_grounds
from factorlib.inference.fit.fit import Hyperparameters, initial_fit, light_likelihood
from factorlib.inference.fit.fit_runner import FitRunner
from factorlib.inference.fit.optimizer import step_light
from factorlib.inference.fit.start import start_from_photos
from factorlib.inference.held_out_photos import fit_lights_given_materials
from factorlib.inference.joint_solver import LIGHTS, solve
from factorlib.inference.model.background import (
    DEVIATION,
    SCALE_DEVIATION,
    SHARED_COVARIANCE,
    Background,
    concatenate_backgrounds,
    condition_on_background,
)
from factorlib.inference.model.blocks import FIT_LOSS, Block, Noise
from factorlib.inference.model.cast_shadows import CastShadows, cast_shadows
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.materials import Point
from factorlib.inference.model.observed import blocks_of_observations, read_grounds
from factorlib.inference.options import SolveOptions
from factorlib.inference.paper_solver import PaperOptions, solve_paper
from factorlib.scenes.joint_problems import MATERIALS, observations_from_front, sphere_normals
from factorlib.urm.observations import concatenate, write_observations
from tests.inference.made_lights import OPERATOR, PRIOR, drawn, on_even_cells, photographed

QUICK = SolveOptions(cells=60, splittings=0, observations=300, tone="off", distance="off")


def lower_half(light, unit=1.0, factor=1.0) -> Background:
    """What a camera that looks down at the objects shows of their light."""
    directions = lat_long_directions(24, 48)
    radiance = light.lobes.radiance((directions @ YUP_FROM_CAMERA).reshape(-1, 3)).reshape(24, 48, 3)
    return Background.from_map(factor * radiance * (directions[..., 1:2] < 0), np.eye(3), unit)


@pytest.mark.parametrize("width", [1.0, 2.0])
def test_the_prior_given_a_background_is_that_of_gaussian_regression(width):
    light = on_even_cells(drawn(3, 80))
    Q, _ = PRIOR.precision(light.axis)
    background = msgspec.structs.replace(lower_half(light), width=width)
    mean, P, log_determinant = condition_on_background(Q, background, light)
    # the slow way, by covariances: K = Q⁻¹, m = K_s (K_ss + N)⁻¹ b, P⁻¹ = K − K_s (K_ss + N)⁻¹ K_sᵀ over seen cells s
    coverage, b = background.observe(light)
    s = np.flatnonzero(np.tile(coverage, 3) > 1e-9)
    K, D = np.linalg.inv(Q), np.tile(coverage, 3) / DEVIATION**2
    errors = width**2 * (np.diag(1 / D[s]) + np.kron(SHARED_COVARIANCE, np.ones((80, 80)))[np.ix_(s, s)])
    gain = K[:, s] @ np.linalg.inv(K[np.ix_(s, s)] + errors)
    np.testing.assert_allclose(mean, gain @ b.T.reshape(-1)[s], atol=1e-6)
    np.testing.assert_allclose(np.linalg.inv(P), K - gain @ K[s], atol=1e-6)
    assert log_determinant == pytest.approx(np.linalg.slogdet(P)[1])
    # the scale of the whole light, which many cells observe, is known as well as one background's
    assert np.linalg.inv(P).mean() > 0.9 * SCALE_DEVIATION**2


def test_a_cell_sees_the_mean_of_its_own_part_of_the_surroundings():
    light = on_even_cells(drawn(4, 300))
    coverage, b = lower_half(light, unit=2.0).observe(light)
    below = light.axis[:, 1] > 0.3  # y points down
    assert coverage[below].min() > 0.95 and coverage[light.axis[:, 1] < -0.3].max() < 0.05
    error = b[below] - (light.log_radiance.T[below] - np.log(2))
    assert abs(np.median(error)) < 0.2 and error.std() < 0.5 * light.log_radiance.std()


def test_a_background_turns_with_the_camera_of_a_light_that_is_fixed_to_the_world():
    turn = Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix()
    lat_long = np.zeros((24, 48, 3))
    lat_long[15, 7] = 1.0
    still, turned = (Background.from_map(lat_long, rotation, 1.0) for rotation in (np.eye(3), turn))
    np.testing.assert_allclose(turned.direction, still.direction @ turn.T)


def test_a_narrow_view_is_no_background():
    """Of a telephoto lens, straight behind the objects; beside a wide one it says nothing either."""
    wide = lower_half(on_even_cells(drawn(3, 80)))
    narrow = Background(wide.direction[:20], 0.01 * wide.radiance[:20], wide.solid_angle[:20])
    assert concatenate_backgrounds([narrow]) is None and concatenate_backgrounds([]) is None
    np.testing.assert_array_equal(concatenate_backgrounds([narrow, wide]).radiance, wide.radiance)


@pytest.fixture(scope="module")
def lit():
    """Spheres in three lights, and the lights in the units of their blocks."""
    problem, true = photographed(6, 3, cells=60, size=12)
    blocks = [
        msgspec.structs.replace(block, background=lower_half(light)) for block, light in zip(problem.blocks, true)
    ]
    return problem.with_blocks(blocks)


def log_scale(solution) -> float:
    """Error of the log scale of all reflectances."""
    return abs(np.median(np.log(solution.point.materials.diffuse / MATERIALS.diffuse)))


def darkened(block):
    """The block with a black background."""
    background = msgspec.structs.replace(block.background, radiance=block.background.radiance * 2e-3)
    return msgspec.structs.replace(block, background=background)


def test_backgrounds_give_reflectances_without_a_gauge_and_one_that_is_wrong_is_left_out(lit):
    blocks = [lit.blocks[0], darkened(lit.blocks[1]), lit.blocks[2]]
    solution = solve(lit.with_blocks(blocks), start_from_photos(3), QUICK)
    assert [each.accepted for each in solution.backgrounds] == [True, False, True]
    error = log_scale(solution)
    assert error < 0.2
    off = solve(lit, start_from_photos(3), msgspec.structs.replace(QUICK, background="off"))
    assert not any(each.accepted for each in off.backgrounds) and log_scale(off) > error + 0.1


def test_a_background_that_objects_contradict_by_a_factor_of_three_is_trusted_less_and_not_left_out(lit):
    background = lit.blocks[1].background
    uneven = background.radiance * np.where(background.direction[:, :1] > 0, 3.0, 1 / 3)
    doubted = msgspec.structs.replace(lit.blocks[1], background=msgspec.structs.replace(background, radiance=uneven))
    solution = solve(lit.with_blocks([lit.blocks[0], doubted, lit.blocks[2]]), start_from_photos(3), QUICK)
    assert [each.accepted for each in solution.backgrounds] == [True] * 3
    assert solution.backgrounds[1].width > 1 == solution.backgrounds[0].width == solution.backgrounds[2].width


@pytest.mark.long
def test_where_no_background_is_kept_the_answer_is_that_without_backgrounds(lit):
    doubtful = lit.with_blocks([darkened(block) for block in lit.blocks]).keep_backgrounds([False, True, False])
    with_one, without = (solve(each, start_from_photos(3), QUICK) for each in (doubtful, lit.keep_backgrounds([])))
    assert with_one.backgrounds[1].log_bayes_factor < 0 and not with_one.backgrounds[1].accepted
    np.testing.assert_array_equal(with_one.point.materials.rows(), without.point.materials.rows())


def test_a_held_out_photo_gets_its_light_as_the_solve_does(lit, monkeypatch):
    """By the same schedule, and without a background that the objects are against."""
    solution = solve(lit.select_lights([0, 1]), start_from_photos(3), QUICK)
    fit, schedules = FitRunner.fit, []
    monkeypatch.setattr(FitRunner, "fit", lambda self, *how: schedules.append(how[-1]) or fit(self, *how))
    alone = lit.select_lights([2])
    dark = lit.with_blocks([darkened(lit.blocks[2])])
    given, without, doubtful = (
        fit_lights_given_materials(each, solution, QUICK)[0]["room2"].weight
        for each in (alone, alone.keep_backgrounds([]), dark)
    )
    np.testing.assert_allclose(doubtful, without, rtol=0.02)
    assert np.abs(np.log(given / without)).max() > 0.1 and any(each is LIGHTS for each in schedules)


def test_the_solver_of_the_paper_ignores_backgrounds_and_keeps_its_gauge(lit):
    quick = PaperOptions(lobes=4, samplings=0.5)
    with_them, without = (solve_paper(each, 3, quick) for each in (lit, lit.keep_backgrounds([])))
    np.testing.assert_array_equal(with_them.point.materials.rows(), without.point.materials.rows())


# ── Shadows on the ground as observations of a light: their slopes, what they tell, and when they are not used ──────────


K, CELLS = 512, 120
ON_GROUND = SolveOptions(cells=60, splittings=0, observations=300, tone="off", distance="off", self_shadowing="on")
UP = np.array([0.1, -0.9, -0.4]) / np.linalg.norm([0.1, -0.9, -0.4])


def floor(light, patches=150, seed=0) -> Block:
    """Patches about a ball of radius 1 that hides light from them, with what they show in a light."""
    rng = np.random.default_rng(seed)
    side = np.linalg.svd(UP[None])[2][1:]
    place = rng.uniform(-3, 3, (patches, 2)) @ side - UP
    place = place[np.linalg.norm(place + UP, axis=1) > 0.3]
    directions = fibonacci_sphere(K)
    to = -place @ directions.T
    hidden = (to > 0) & ((place**2).sum(1)[:, None] - to**2 < 1)
    n = len(place)
    shown = Block(
        "room0", ("room0",), 1.0, np.tile(UP, (n, 1)), np.tile([0.0, 0.0, -1.0], (n, 1)), np.ones((n, 3)),
        np.zeros((n, 3), bool), np.full((n, 3), 20.0), np.zeros(n, int), np.zeros(n, int), np.zeros(n, bool),
        np.where(hidden, 0, 255).astype(np.uint8), directions[None],
    )  # fmt: skip
    return shown if light is None else msgspec.structs.replace(shown, radiance=ratio(shown, light))


def ratio(block: Block, light) -> np.ndarray:
    """Light on patches over that without the ball."""
    shadows = cast_shadows(block, light.unit_lobes, OPERATOR)
    return shadows.shadowed @ light.weight / (shadows.open @ light.weight)


def with_floor(problem, light):
    block = msgspec.structs.replace(problem.blocks[0], ground=floor(light))
    return problem.with_blocks([block, *problem.blocks[1:]])


def test_slopes_are_those_of_the_forward_model():
    light, other = (on_even_cells(drawn(seed, CELLS)) for seed in (3, 4))
    shadows = cast_shadows(floor(other), light.unit_lobes, OPERATOR)
    w, step = light.weight, np.random.default_rng(0).normal(size=light.weight.shape)
    value, slope = shadows.gradient(w, FIT_LOSS, 2.0)
    after, before = (shadows.gradient(w * np.exp(h * step), FIT_LOSS, 2.0)[0] for h in (1e-4, -1e-4))
    assert value > 1 and (after - before) / 2e-4 == pytest.approx(2 * np.vdot(slope, step), rel=1e-5)
    for c, (jacobian, residual) in enumerate(shadows.linearise(w, FIT_LOSS, 2.0)):
        np.testing.assert_allclose(jacobian.T @ residual, slope[:, c], rtol=1e-3, atol=1e-4 * np.abs(slope).max())
    # whatever the brightness of the light in each channel
    assert shadows.gradient(w * [2.0, 0.5, 3.0], FIT_LOSS, 2.0)[0] == pytest.approx(value)


def test_the_likelihood_of_a_light_has_the_gradient_and_the_hessian_of_its_ground():
    problem, true = photographed(5, 1, cells=CELLS)
    problem = with_floor(problem, on_even_cells(drawn(4, CELLS)))
    one = light_likelihood(
        Illumination(problem.blocks[0], true[0], MATERIALS, OPERATOR), Hyperparameters(2.0), PRIOR, True
    )
    gradient, system = one.gradient(), one.normal_equations(determinants=False)
    assert gradient.value == pytest.approx(system.value)
    np.testing.assert_allclose(gradient.by_light, system.light_gradient, atol=2e-3 * np.abs(gradient.by_light).max())
    step = np.random.default_rng(1).normal(size=len(gradient.by_light))
    after, before = (one.with_point(step_light(true[0], h * step)).gradient().value for h in (1e-4, -1e-4))
    assert (after - before) / 2e-4 == pytest.approx(2 * gradient.by_light @ step, rel=1e-3)
    without = msgspec.structs.replace(one, ground=None).normal_equations(determinants=False)
    added = system.light_hessian - without.light_hessian
    blocks = [j.T.astype(float) @ j for j, _ in one.ground.linearise(true[0].weight, FIT_LOSS, 2.0)]
    for c, block in enumerate(blocks):
        np.testing.assert_allclose(added[c * CELLS :][:CELLS, c * CELLS :][:, :CELLS], block, atol=1e-3 * block.max())


def test_shadows_count_only_where_the_objects_expect_them():
    problem, true = photographed(5, 1, cells=CELLS)
    fit = initial_fit(Point(MATERIALS, true))
    flat = msgspec.structs.replace(floor(None), radiance=np.ones((len(floor(None)), 3)))
    opposite = msgspec.structs.replace(floor(None), radiance=2 - ratio(floor(None), true[0]))

    def chosen(shown, **options) -> list:
        blocks = [msgspec.structs.replace(problem.blocks[0], ground=shown)]
        return select_grounds(problem.with_blocks(blocks), fit, SolveOptions(**options))

    accepted = chosen(floor(true[0]))[0]
    assert accepted.accepted and accepted.correlation > 0.99
    assert not any(chosen(ground)[0].accepted for ground in (None, flat, opposite))
    assert not chosen(floor(true[0]), ground="off")[0].accepted
    kept = with_floor(problem, true[0])
    assert kept.keep_grounds([True]).blocks[0].ground is not None
    assert kept.keep_grounds([]).blocks[0].ground is None and kept.with_effects(False, False).blocks[0].ground is None


def test_a_ground_without_any_shadow_has_no_correlation():
    one = np.ones((5, 3))
    assert CastShadows(np.ones((5, 2)), np.ones((5, 2)), one, one).correlation(np.ones((2, 3))) == 0


def test_a_ground_is_read_and_turns_with_its_camera(tmp_path):
    light = on_even_cells(drawn(3, CELLS))
    shown, turn = floor(light), Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix()
    ground = observations_from_front(
        shown.normal, shown.radiance, shown.material, ("ground",), "a", visibility=shown.visibility
    )
    (tmp_path / "ground").mkdir()
    write_observations(tmp_path / "ground/a.parquet", ground)
    normals = sphere_normals(8)
    red = np.zeros(len(normals), int)
    objects = concatenate(
        [observations_from_front(normals, np.ones_like(normals), red, ("red",), name) for name in "ab"]
    )
    with_ground, without = blocks_of_observations(
        objects, Noise(), world_from_camera={"a": turn}, grounds=read_grounds(tmp_path)
    )
    assert without.ground is None
    np.testing.assert_allclose(with_ground.ground.normal, shown.normal @ turn.T, atol=1e-6)
    turned = msgspec.structs.replace(light, axis=light.axis @ turn.T)
    shadows = cast_shadows(with_ground.ground, turned.unit_lobes, OPERATOR)
    np.testing.assert_allclose(
        shadows.shadowed @ light.weight / (shadows.open @ light.weight), shadows.ratio, atol=1e-5
    )


def test_a_solve_uses_the_shadows_that_its_objects_expect():
    problem, true = photographed(5, 2, cells=60)
    right, wrong = floor(true[0]), floor(true[1])
    wrong = msgspec.structs.replace(wrong, radiance=2 - wrong.radiance)
    hiding = {
        "visibility": np.full((len(problem.blocks[0]), K), 255, np.uint8),
        "directions": fibonacci_sphere(K)[None],
    }
    blocks = [
        msgspec.structs.replace(block, ground=ground, **hiding)
        for block, ground in zip(problem.blocks, (right, wrong), strict=True)
    ]
    solution = solve(problem.with_blocks(blocks), start_from_photos(3), ON_GROUND)
    assert [decision.accepted for decision in solution.grounds] == [True, False]
    assert solution.grounds[0].correlation > 0.5 > 0 > solution.grounds[1].correlation
    used = solution.effective_problem(problem.with_blocks(blocks)).blocks
    assert used[0].ground is not None and used[1].ground is None
