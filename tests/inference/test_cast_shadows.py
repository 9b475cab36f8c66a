"""Shadows on the ground as observations of a light: their slopes, what they tell, and when they are not used."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.blocks import FIT_LOSS, Block, Noise
from factorlib.inference.cast_shadows import CastShadows, cast_shadows
from factorlib.inference.fit import Hyperparameters, initial_fit, light_likelihood
from factorlib.inference.forward import Illumination
from factorlib.inference.joint_solver import solve
from factorlib.inference.materials import Point
from factorlib.inference.model_selection import select_grounds
from factorlib.inference.observed import blocks_of_observations, read_grounds
from factorlib.inference.optimizer import descend_light, step_light
from factorlib.inference.options import SolveOptions
from factorlib.inference.start import constant_light, start_from_photos
from factorlib.scenes.joint_problems import MATERIALS, observations_from_front, sphere_normals
from factorlib.urm.observations import concatenate, write_observations
from tests.inference.made_lights import OPERATOR, PRIOR, drawn, on_even_cells, photographed

K, CELLS = 512, 120
QUICK = SolveOptions(cells=60, splittings=0, observations=300, tone="off", distance="off", self_shadowing="on")
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


def test_shadows_tell_of_a_light_what_a_flat_thing_does_not():
    """Of a light behind the camera, a matt patch that faces aside says how bright it is, and its floor where."""
    problem, true = photographed(7, 1, cells=CELLS)
    block = problem.blocks[0].take(np.abs(problem.blocks[0].normal[:, 0]) > 0.9)
    errors = []
    for ground in (None, floor(true[0])):
        shown = msgspec.structs.replace(block, ground=ground)
        start = constant_light(shown, MATERIALS, CELLS)
        own = true[0].log_radiance
        start = msgspec.structs.replace(start, axis=true[0].axis, log_sharpness=true[0].log_sharpness)
        one = light_likelihood(Illumination(shown, start, MATERIALS, OPERATOR), Hyperparameters(2.0), PRIOR, True)
        found = descend_light(one, 6)[0].light.log_radiance
        upper = true[0].axis @ UP > 0.2
        errors.append(np.std((found - own)[:, upper], axis=1).mean())
    assert errors[1] < 0.85 * errors[0], errors


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
    solution = solve(problem.with_blocks(blocks), start_from_photos(3), QUICK)
    assert [decision.accepted for decision in solution.grounds] == [True, False]
    assert solution.grounds[0].correlation > 0.5 > 0 > solution.grounds[1].correlation
    used = solution.effective_problem(problem.with_blocks(blocks)).blocks
    assert used[0].ground is not None and used[1].ground is None
