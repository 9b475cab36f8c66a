"""Self-shadowing in the solve: hemispherical bowls, whose visibility is known by hand, traced by brute force."""

import msgspec
import numpy as np
import pytest

from benchmarks.solve.problems import MATERIALS, block, factor_between, random_light, sphere_normals
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.bundle import solve
from factorlib.solve.history import Run
from factorlib.solve.insertion import candidates, lobes_inserted
from factorlib.solve.normal_equations import normal_equations
from factorlib.solve.options import Bundle
from factorlib.solve.rounds import from_nothing
from factorlib.urm.observations import Observations

OPERATOR = reflection_operator("closed_form", dtype="float64")
NAMES = ("red", "green", "blue")
LOSS = Loss(robust_scale=3.0, prior=0.0)


def bowl_sees(normals, directions):
    """A ray from −n leaves the sphere at −n + 2(n·d)d; it is free where that lies before the rim."""
    exit_z = -normals[:, 2:] + 2 * (normals @ directions.T) * directions[:, 2]
    return (exit_z < 0) | (normals @ directions.T <= 0)


def traced(normals, sees, light: Light, material, materials: Materials, count=12_000):
    """Radiance toward (0, 0, −1) by summing the light over `count` directions: no operator, no lobes."""
    d = fibonacci_sphere(count)
    view = np.array([0.0, 0.0, -1.0])
    incoming = np.exp(light.sharpness * (d @ light.axis.T - 1)) @ light.weight
    half = (d + view) / np.maximum(np.linalg.norm(d + view, axis=1, keepdims=True), 1e-9)
    ni, no, nh = (np.maximum(normals @ v.T, 0) for v in (d, view[None], half))
    square = materials.roughness[material] ** 4

    def smith(c):
        return 2 * c / (c + np.sqrt(square + (1 - square) * c * c) + 1e-12)

    highlight = square / (np.pi * (nh**2 * (square - 1) + 1) ** 2) * smith(ni) * smith(no) / (4 * no)
    weight = sees(normals, d) * 4 * np.pi / count
    return (weight * ni / np.pi) @ incoming * materials.diffuse[material] + (weight * highlight) @ incoming * materials.specular[material]


def bowls(name, light, size=16, count=512) -> Observations:
    """A bowl and a ball of each material in one light."""
    normals, directions, parts, sees = sphere_normals(size), fibonacci_sphere(count), [], []
    for m in range(3):
        for seen in (bowl_sees, lambda n, d: np.ones((len(n), len(d)), bool)):
            parts.append(traced(normals, seen, light, m, MATERIALS))
            sees.append(seen(normals, directions))
    n = len(normals) * 6
    return Observations(
        normal=np.tile(normals, (6, 1)), view=np.tile([0.0, 0.0, -1.0], (n, 1)), radiance=np.vstack(parts), clipped=np.zeros((n, 3), bool),
        material=np.repeat([0, 0, 1, 1, 2, 2], len(normals)), photo=np.zeros(n, int), illumination=np.zeros(n, int),
        x=np.arange(n), y=np.zeros(n, int), weight=np.ones(n), materials=NAMES, photos=(name,), illuminations=(name,),
        visibility=255 * np.vstack(sees).astype(np.uint8),
    )  # fmt: skip


def rough_light(seed):
    light = random_light(np.random.default_rng(seed), 5)
    return msgspec.structs.replace(light, log_sharpness=np.minimum(light.log_sharpness, 3.5))


@pytest.fixture(scope="module")
def rooms():
    return [blocks_of_observations(bowls(f"room{i}", rough_light(20 + i)), Noise(0.02, 0.02))[0] for i in range(2)]


@pytest.fixture(scope="module")
def problem():
    """Observations of two photos in a light fixed to the world, each hiding other directions, and a wrong light."""
    rng = np.random.default_rng(1)
    data = block("room", random_light(rng, 5, photos=2), MATERIALS, [0, 1, 2], OPERATOR, size=14)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    directions = np.stack([fibonacci_sphere(96), fibonacci_sphere(96) @ turn.T])
    visibility = (rng.random((len(data), 96)) * 255).astype(np.uint8)
    guess = random_light(rng, 4, photos=2)
    guess = Light(guess.axis, np.minimum(guess.log_sharpness, 3), guess.weight / 10, guess.log_exposure)
    return msgspec.structs.replace(data, visibility=visibility, directions=directions), guess


def test_model_in_shadow_is_the_traced_radiance(rooms):
    for data, seed in zip(rooms, (20, 21), strict=True):
        light = rough_light(seed)
        light = msgspec.structs.replace(light, weight=light.weight / data.unit)
        with_, without = (
            Illumination(b, light, MATERIALS, reflection_operator("network")).radiance() for b in (data, data.without_shadows())
        )
        error, ignored = (np.sqrt(np.mean((found - data.radiance) ** 2)) for found in (with_, without))
        assert ignored > 0.15 * data.radiance.mean()
        assert error < 0.2 * ignored


def test_gradients_are_finite_differences(problem):
    """Visibility is computed in single precision, so steps are long and the tolerance is wide."""
    data, light = problem
    found, step = normal_equations(Illumination(data, light, MATERIALS, OPERATOR), LOSS), 2e-3

    def by_light(move):
        return Illumination(data, light.moved(move, MATERIALS.blur), MATERIALS, OPERATOR).fit_loss(LOSS)

    def by_material(move):
        return Illumination(data, light, Materials.of_vector(MATERIALS.vector() + move), OPERATOR).fit_loss(LOSS)

    for function, gradient in ((by_light, found.light_gradient), (by_material, found.material_gradient)):
        moves = np.eye(len(gradient)) * step
        expected = np.array([(function(d) - function(-d)) / (4 * step) for d in moves])
        np.testing.assert_allclose(gradient, expected, rtol=0.02, atol=2e-3 * np.abs(expected).max())


def test_nothing_hidden_is_nothing_computed():
    seen = bowls("room", rough_light(3), size=8)
    open_ = msgspec.structs.replace(seen, visibility=np.full_like(seen.visibility, 255))
    assert blocks_of_observations(open_, Noise())[0].visibility is None


def test_no_lobe_is_inserted_where_its_light_cannot_arrive():
    """One observation's worth of light from the side that everything is hidden from explains nothing."""
    data = blocks_of_observations(bowls("room", rough_light(3), size=8), Noise())[0]
    hidden = data.directions[0, :, 0] > 0.2
    visibility = np.where(hidden, 0, data.visibility).astype(np.uint8)
    dark = Light(np.array([[0.0, 0.0, -1.0]]), np.zeros(1), np.full((1, 3), 1e-6), np.zeros(1))
    hidden_from = msgspec.structs.replace(data, visibility=visibility)
    illumination = Illumination(hidden_from, dark, MATERIALS, OPERATOR)
    grown = lobes_inserted(illumination, 8, candidates(illumination, 0))
    assert (grown.axis[1:, 0] < 0.35).all()


def test_materials_of_bowls_are_better_with_self_shadowing_and_the_solve_finds_that_out(rooms):
    quick, error = Bundle(light_prior="none", lobes=8, insert=4, rounds=3, iterations=10, polish=20, tolerance=1e-3), {}
    for choice in ("off", "auto"):
        problem = JointProblem(rooms, reflection_operator("network"))
        solution = solve(problem, from_nothing(3), Run(msgspec.structs.replace(quick, self_shadowing=choice)))
        found = solution.point.materials
        factor = factor_between(found, MATERIALS)
        error[choice] = np.abs(found.diffuse * factor / MATERIALS.diffuse - 1).mean(), np.abs(found.roughness - MATERIALS.roughness).mean()
    assert solution.shadows.kept and solution.shadows.held_out_loss_with < 0.5 * solution.shadows.held_out_loss_without
    assert error["auto"][0] < 0.5 * error["off"][0]
    assert error["auto"][1] < error["off"][1] + 0.01
