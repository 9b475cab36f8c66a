"""Interreflection: G of radiances that are known by hand, and the forward model with it."""

import msgspec
import numpy as np
import pytest

from benchmarks.solve.problems import MATERIALS, block, random_light, sphere_normals
from factorlib.geometry.met import UNMET, met_codes
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.model.gauge import in_gauge
from factorlib.model.illumination import Illumination
from factorlib.model.interreflection import bounced_light
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.bundle import solve
from factorlib.solve.history import Run
from factorlib.solve.normal_equations import energy_equations, normal_equations
from factorlib.solve.options import Bundle
from factorlib.solve.rounds import from_nothing
from factorlib.solve.weights import fitted_illumination
from factorlib.urm.observations import Observations, concatenate
from tests.model.test_shadowing import bowls, rough_light

OPERATOR = reflection_operator("closed_form", dtype="float64")
LOSS = Loss(robust_scale=3.0, prior=0.0)


@pytest.fixture(scope="module", params=["linear", "toned"])
def given(request):
    """Observations of two photos in a light fixed to the world, half of them reached by light from other surfaces, and a wrong light."""
    rng = np.random.default_rng(1)
    data = block("room", random_light(rng, 5, photos=2), MATERIALS, [0, 1, 2], OPERATOR, size=14)
    data = msgspec.structs.replace(data, bounced=rng.random((len(data), 6)) * (rng.random((len(data), 1)) < 0.5))
    guess = random_light(rng, 4, photos=2)
    tone = np.log([1.3, 0.8]) if request.param == "toned" else np.zeros(0)
    return Illumination(data, Light(guess.axis, guess.log_sharpness, guess.weight / 10, guess.log_exposure, tone), MATERIALS, OPERATOR)


def moved_light(given, step):
    return given.with_light(given.light.moved(step, MATERIALS.blur))


def moved_materials(given, step):
    return msgspec.structs.replace(given, materials=Materials.of_vector(MATERIALS.vector() + step))


@pytest.mark.parametrize("moved", [moved_light, moved_materials])
def test_gradients_are_finite_differences_of_the_loss(given, moved):
    found, step = normal_equations(given, LOSS), 1e-6
    gradient = found.light_gradient if moved is moved_light else found.material_gradient
    expected = [(moved(given, d).fit_loss(LOSS) - moved(given, -d).fit_loss(LOSS)) / (4 * step) for d in np.eye(len(gradient)) * step]
    np.testing.assert_allclose(gradient, expected, rtol=2e-4, atol=1e-4 * np.abs(expected).max())


def test_weights_are_fitted_to_what_bounces_leave(given):
    """Energies have the same equations alone; observations of a light and of bounces give that light back."""
    light = msgspec.structs.replace(given.light, log_tone=np.zeros(0))
    lit, p = given.with_light(light), len(light)
    part, whole = energy_equations(lit, lit.responses(), LOSS), normal_equations(lit, LOSS)
    np.testing.assert_allclose(part.loss, whole.loss)
    np.testing.assert_allclose(part.gradients.reshape(-1), whole.light_gradient[3 * p : 6 * p], rtol=1e-9)
    data = msgspec.structs.replace(given.block, radiance=lit.radiance(), precision=np.ones_like(given.block.precision))
    dark = msgspec.structs.replace(light, weight=light.weight / 3)
    found = fitted_illumination(Illumination(data, dark, MATERIALS, OPERATOR), Loss(robust_scale=1e6, prior=0.0)).light
    np.testing.assert_allclose(found.weight, light.weight, rtol=1e-5, atol=1e-6 * light.weight.max())


def test_bounces_add_a_known_radiance(given):
    light = msgspec.structs.replace(given.light, log_tone=np.zeros(0))
    data, kd, ks = given.block, MATERIALS.diffuse[given.block.material], MATERIALS.specular[given.block.material]
    with_, without = (Illumination(b, light, MATERIALS, OPERATOR).radiance() for b in (data, data.without_bounces()))
    np.testing.assert_allclose(with_ - without, kd * data.bounced[:, :3] + ks * data.bounced[:, 3:])
    assert JointProblem([data], OPERATOR).without_shadows().blocks[0].bounced is None


def bowl(albedo, depth=0.5, size=40, count=1024, name="bowl") -> Observations:
    """The inside of a sphere open to constant light 1 from beyond a cap: radiosity is constant there, for form factors are.

    depth: share of the sphere that is bowl.  Radiance L = albedo (1 − depth + depth L) everywhere.
    """
    n = fibonacci_sphere(size * size)
    n = n[n[:, 2] > 2 * (1 - depth) - 1 + 1e-9] * [1, 1, -1]  # inward normals of the points −n, away from the opening
    d = fibonacci_sphere(count)
    out = -n[:, None] + 2 * (n @ d.T)[..., None] * d  # where a ray from −n leaves the sphere
    hidden = (out[..., 2] > 1 - 2 * depth) & (n @ d.T > 0)
    met = np.where(hidden, met_codes(np.zeros(out.shape[:2], int).reshape(-1), -out.reshape(-1, 3)).reshape(hidden.shape), UNMET)
    radiance = np.full((len(n), 3), albedo * (1 - depth) / (1 - albedo * depth))
    return Observations(
        normal=n, view=np.tile([0.0, 0.0, -1.0], (len(n), 1)), radiance=radiance, clipped=np.zeros((len(n), 3), bool),
        material=np.zeros(len(n), int), photo=np.zeros(len(n), int), illumination=np.zeros(len(n), int), x=np.arange(len(n)),
        y=np.zeros(len(n), int), weight=np.ones(len(n)), materials=("white",), photos=(name,), illuminations=(name,),
        visibility=np.where(hidden, 0, 255).astype(np.uint8), met=met.astype(np.uint16),
    )  # fmt: skip


@pytest.mark.parametrize(("albedo", "depth"), [(0.3, 0.5), (0.9, 0.5), (0.9, 0.9)])
def test_a_bowl_in_constant_light_has_the_analytic_radiosity(albedo, depth):
    """k_d (V̄ · 1 + G) is L, all bounces with it, with V̄ and G from directions that are hidden."""
    seen = bowl(albedo, depth)
    sent = bounced_light(seen, seen.radiance)[:, :3]
    cosine = np.maximum(seen.normal @ fibonacci_sphere(1024).T, 0)
    open_share = (cosine * (seen.visibility / 255)).sum(1) / cosine.sum(1)
    np.testing.assert_allclose(albedo * (open_share[:, None] + sent), seen.radiance, rtol=0.03)


def test_facing_plates_of_red_and_white_bleed_and_keep_their_colours():
    """Two plates that hide three quarters of the light from each other, in constant light 1, with all bounces."""
    albedo, count, each = np.array([[0.8, 0.8, 0.8], [0.8, 0.1, 0.05]]), 1024, 30
    open_, hidden = 0.25, 0.75  # of the cosine-weighted hemisphere: what lies within 60° of a plate's normal is the other plate
    radiance = np.stack([np.linalg.solve([[1, -hidden * w], [-hidden * r, 1]], [w * open_, r * open_]) for w, r in albedo.T], axis=1)
    material, normal = np.repeat([0, 1], each), np.repeat([[1.0, 0, 0], [-1.0, 0, 0]], each, axis=0)
    facing = normal @ fibonacci_sphere(count).T > 0.5
    met = np.where(facing, np.repeat(met_codes(np.array([1, 0]), np.array([[-1.0, 0, 0], [1.0, 0, 0]])), each)[:, None], UNMET)
    n = len(material)
    seen = Observations(
        normal=normal, view=np.tile([0.0, 0.0, -1.0], (n, 1)), radiance=radiance[material], clipped=np.zeros((n, 3), bool),
        material=material, photo=np.zeros(n, int), illumination=np.zeros(n, int), x=np.arange(n), y=np.zeros(n, int), weight=np.ones(n),
        materials=("white", "red"), photos=("plates",), illuminations=("plates",),
        visibility=np.where(facing, 0, 255).astype(np.uint8), met=met.astype(np.uint16),
    )  # fmt: skip
    assert radiance[0, 0] > 1.2 * radiance[0, 1]  # the white plate looks red
    sent = bounced_light(seen, seen.radiance)[:, :3]
    np.testing.assert_allclose(seen.radiance / (open_ + sent), albedo[material], rtol=0.05)


def test_nothing_hidden_sends_nothing():
    seen = bowl(0.5)
    open_ = msgspec.structs.replace(seen, visibility=np.full_like(seen.visibility, 255))
    assert blocks_of_observations(open_, Noise())[0].bounced is None
    assert blocks_of_observations(msgspec.structs.replace(seen, met=None), Noise())[0].bounced is None


def test_brighter_photos_send_more_in_their_own_unit_alike():
    seen, factor = bowl(0.5), 1e4
    brighter = msgspec.structs.replace(seen, radiance=factor * seen.radiance)
    np.testing.assert_allclose(bounced_light(brighter, brighter.radiance), factor * bounced_light(seen, seen.radiance), rtol=1e-5)
    one, other = (blocks_of_observations(photo, Noise())[0].bounced for photo in (seen, brighter))
    np.testing.assert_allclose(one, other, rtol=1e-5)


def test_the_order_of_photos_changes_nothing():
    photos = [bowl(albedo, name=name) for albedo, name in ((0.3, "a"), (0.8, "b"))]
    one, other = (blocks_of_observations(concatenate(order), Noise()) for order in (photos, photos[::-1]))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.bounced, b.bounced)


def test_what_interreflection_determines_the_gauge_leaves(given):
    point = Point(MATERIALS, [given.light])
    np.testing.assert_array_equal(in_gauge(point, [given.block]).materials.diffuse, MATERIALS.diffuse)
    assert (in_gauge(point, [given.block.without_bounces()]).materials.diffuse != MATERIALS.diffuse).any()


def lit_bowls(name, seed) -> Observations:
    """A bowl and a ball of each material, all bounces within a bowl as (1) has them: the fixed point of what it sends itself."""
    seen, normals, d = bowls(name, rough_light(seed), size=12, count=256), sphere_normals(12), fibonacci_sphere(256)
    exits = -normals[:, None] + 2 * (normals @ d.T)[..., None] * d
    facing = met_codes(np.zeros(exits.shape[0] * 256, int), -exits.reshape(-1, 3)).reshape(-1, 256)
    met = np.vstack([facing + 64 * (k // 2) for k in range(6)])
    seen = msgspec.structs.replace(seen, met=np.where(seen.visibility == 0, met, UNMET).astype(np.uint16))
    shown = seen.radiance
    for _ in range(8):
        sent = bounced_light(seen, shown)
        shown = seen.radiance + MATERIALS.diffuse[seen.material] * sent[:, :3] + MATERIALS.specular[seen.material] * sent[:, 3:]
    return msgspec.structs.replace(seen, radiance=shown)


@pytest.fixture(scope="module")
def rooms():
    return [blocks_of_observations(lit_bowls(f"room{i}", 20 + i), Noise(0.02, 0.02))[0] for i in range(2)]


QUICK = Bundle(light_prior="none", lobes=8, insert=4, rounds=3, iterations=6, polish=8, tolerance=1e-3, self_shadowing="on")


def test_the_solve_finds_out_that_bowls_light_themselves_and_how_bright_they_are(rooms):
    error = {}
    for choice in ("off", "auto"):
        options = msgspec.structs.replace(QUICK, interreflection=choice)
        solution = solve(JointProblem(rooms, reflection_operator("network")), from_nothing(3), Run(options))
        error[choice] = np.abs(solution.point.materials.diffuse / MATERIALS.diffuse - 1).mean()  # absolute: no factor is taken out
    assert solution.interreflection.kept
    assert solution.interreflection.held_out_loss_with < solution.interreflection.held_out_loss_without
    assert error["auto"] < 0.5 * error["off"]


def tilted(seen, seed, degrees):
    """The same observations, their normals wrong by a smooth field of tilts of at most so many degrees an axis."""
    rng = np.random.default_rng(seed)
    waves = np.sin(seen.normal @ (2 * rng.normal(size=(3, 3))).T + rng.uniform(0, 6, 3))
    normal = seen.normal + np.radians(degrees) * waves
    return msgspec.structs.replace(seen, normal=(normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(seen.normal.dtype))


@pytest.mark.parametrize("bounced", [False, True])
def test_wrong_normals_are_no_evidence_of_bounces_and_do_not_hide_them(bounced):
    """Where the photos show no bounces, those computed from the mesh still explain a little of what wrong normals cause.  They fit best
    when they are weak, so a solve that kept them would make all reflectances ten times too small."""
    lit = [lit_bowls(f"room{i}", 40 + i) for i in range(2)]
    direct = [bowls(f"room{i}", rough_light(40 + i), size=12, count=256) for i in range(2)]
    shown = [one if bounced else msgspec.structs.replace(one, radiance=other.radiance) for one, other in zip(lit, direct, strict=True)]
    blocks = [blocks_of_observations(tilted(one, 10 + i, 12.0), Noise(0.02, 0.02))[0] for i, one in enumerate(shown)]
    solution = solve(JointProblem(blocks, reflection_operator("network")), from_nothing(3), Run(QUICK))
    assert solution.interreflection.kept == bounced
    assert solution.point.materials.diffuse.max() > 0.5 * MATERIALS.diffuse.max()


def test_off_is_the_solve_of_the_same_observations_without_codes(rooms):
    without, operator = [room.without_bounces() for room in rooms], reflection_operator("network")
    quick = msgspec.structs.replace(QUICK, lobes=3, insert=3, rounds=1, iterations=2, polish=1, sample=100)
    off = msgspec.structs.replace(quick, interreflection="off")
    one, other = (solve(JointProblem(b, operator), from_nothing(3), Run(options)) for b, options in ((rooms, off), (without, quick)))
    assert not one.interreflection.kept and not other.interreflection.kept
    np.testing.assert_array_equal(one.point.materials.vector(), other.point.materials.vector())
