"""Laws of the one forward model and of the joint problem: light, clipping, shadows, interreflection, cells, what is linked, and the gauge."""

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import NO_OCCLUDER, fibonacci_sphere, occluder_codes
from factorlib.inference.choices.splitting import LEAST_SPACING_DEG, SPLIT_CELLS
from factorlib.inference.model.blocks import Noise
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.gauge import (
    BOUNCE_DEVIATION,
    BRIGHTEST,
    BRIGHTNESS_DEVIATION,
    MEDIAN_BRIGHTNESS,
    TINT_DEVIATION,
    connected_components,
    fix_gauge,
)
from factorlib.inference.model.interreflection import bounced_light
from factorlib.inference.model.lights import Light, UnitLobes, fibonacci_cells
from factorlib.inference.model.materials import Materials, Point
from factorlib.inference.model.observed import blocks_of_observations
from factorlib.inference.model.problem import JointProblem
from factorlib.light.lobes import lobe_energy
from factorlib.scenes.joint_problems import MATERIALS, random_light, sphere_block
from factorlib.urm.observations import Observations
from tests.inference.made import (
    OPERATOR,
    bowls,
    observations_from_front,
    photos_in_a_wrong_light,
    rough_light,
    three_rooms,
)
from tests.inference.made_lights import OPERATOR as NETWORK
from tests.inference.made_lights import drawn, on_even_cells


def with_light(one: Illumination, **changes) -> Illumination:
    return msgspec.structs.replace(one, light=msgspec.structs.replace(one.light, **changes))


@pytest.fixture(scope="module", params=["linear", "toned"])
def clipped(request):
    return photos_in_a_wrong_light("clipped", request.param == "toned")


def test_radiance_is_linear_in_light_and_atoms_are_what_a_lobe_adds_to_the_residual(clipped):
    straight = with_light(clipped, log_tone=np.zeros(0))
    twice = with_light(straight, weight=2 * straight.light.weight)
    np.testing.assert_allclose(twice.radiance(), 2 * straight.radiance())
    lobe, weight = UnitLobes(np.array([[0.6, 0.0, -0.8]]), np.array([20.0])), np.array([[0.3, 0.2, 0.1]])
    rows = np.flatnonzero(~clipped.block.clipped.any(1))
    more = msgspec.structs.replace(straight, light=straight.light.with_lobes(lobe, weight))
    added = (more.residuals() - straight.residuals())[rows]
    atoms = straight.unit_responses(rows, lobe)[:, :, 0].T
    np.testing.assert_allclose(atoms * weight, added, atol=1e-9 * np.abs(added).max())


def test_a_clipped_channel_pulls_only_from_below(clipped):
    block = clipped.block
    above, below = block.residuals(block.radiance + 1), block.residuals(block.radiance - 1)
    assert (above[block.clipped] == 0).all() and (below[block.clipped] < 0).all()


def test_places_turn_into_the_frame_of_the_light_as_normals_do():
    observed, turn = bowls("room", rough_light(20)), np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    observed = msgspec.structs.replace(observed, place=2 * observed.normal)
    (data,) = blocks_of_observations(observed, Noise(), world_from_camera={observed.photos[0]: turn})
    (camera,) = blocks_of_observations(observed, Noise())
    np.testing.assert_allclose(data.place, camera.place @ turn.T, atol=1e-6)
    np.testing.assert_allclose(data.place, 2 * data.normal, atol=1e-6)


@pytest.mark.parametrize("seed", [20, 21])
def test_model_in_shadow_is_the_radiance_traced_in_bowls_by_brute_force(seed):
    """Whose visibility is known by hand."""
    (data,) = blocks_of_observations(bowls("room", rough_light(seed)), Noise(0.02, 0.02))
    light = rough_light(seed)
    light = msgspec.structs.replace(light, weight=light.weight / data.unit)
    both = (Illumination(b, light, MATERIALS, NETWORK).radiance() for b in (data, data.with_effects(False, False)))
    error, ignored = (np.sqrt(np.mean((result - data.radiance) ** 2)) for result in both)
    assert ignored > 0.15 * data.radiance.mean() and error < 0.2 * ignored


@pytest.mark.parametrize("seed", range(4))
def test_no_cluster_is_both_held_out_and_fitted_and_every_material_is_fitted(seed):
    """Else a fit would know the errors of what it is judged by."""
    observed = bowls("room", rough_light(20))
    rare = (observed.material == 2) & (observed.normal[:, 0] < 0.8)  # a material that few cells show
    (data,) = blocks_of_observations(observed.take(~rare), Noise(), held_out=0.3, seed=seed)
    assert not set(data.clusters()[data.held_out]) & set(data.clusters()[~data.held_out]) and data.held_out.any()
    assert set(data.material[~data.held_out]) == {0, 1, 2}


# ── what is linked, and the gauge ────────────────────────────────────────────────────────────────────────────────────


def test_components_of_unlinked_photos():
    rng = np.random.default_rng(6)
    pairs = (("a", [0, 1]), ("b", [2]))
    blocks = [sphere_block(name, random_light(rng, 1), MATERIALS, shown, OPERATOR, size=8) for name, shown in pairs]
    assert connected_components(blocks, 4) == [((0, 1), ("a",)), ((2,), ("b",)), ((3,), ())]


def test_the_gauge_changes_no_radiance_and_a_shifted_point_comes_to_the_same_one():
    problem, point = three_rooms()
    factor = np.array([2.0, 0.5, 1.3])
    materials = Materials(point.materials.diffuse * factor, point.materials.specular * factor, MATERIALS.roughness)
    lights = [msgspec.structs.replace(light, weight=light.weight / factor) for light in point.lights]
    shifted = Point(materials, lights)
    settled = [fix_gauge(p, problem.blocks) for p in (point, shifted)]
    np.testing.assert_allclose(settled[0].materials.vector(), settled[1].materials.vector(), rtol=1e-12)
    for at in (*settled, shifted):
        for result, expected in zip(problem.radiance(at), problem.radiance(point), strict=True):
            np.testing.assert_allclose(result, expected, rtol=1e-12)


def test_a_single_light_comes_out_grey_and_a_lobe_made_sharper_at_its_energy_moves_no_tint():
    """The gauge depends on what lights send, not on how lobes make it up."""
    light = random_light(np.random.default_rng(2), 4)
    data = sphere_block("room", light, MATERIALS, [0, 1, 2], OPERATOR, size=8)
    sharper = light.log_sharpness + np.array([2.0, 0, 0, 0])
    kept = lobe_energy(light.sharpness) / lobe_energy(np.exp(sharper))
    other = msgspec.structs.replace(light, log_sharpness=sharper, weight=light.weight * kept[:, None])
    first, second = (fix_gauge(Point(MATERIALS, [li]), [data]) for li in (light, other))
    np.testing.assert_allclose(first.materials.vector(), second.materials.vector(), rtol=1e-12)
    assert abs((first.materials.diffuse + first.materials.specular).max() - BRIGHTEST) < 1e-12
    (grey,) = first.lights
    np.testing.assert_allclose(grey.energy.sum(0) / grey.energy.sum(), 1 / 3, rtol=1e-9)


def test_a_sample_has_of_every_material_and_region_of_the_light_its_share():
    data = sphere_block("room1", random_light(np.random.default_rng(4), 3), MATERIALS, [0, 1, 2], OPERATOR, size=60)
    data = msgspec.structs.replace(data, row=np.arange(len(data)))
    every = list(zip(data.held_out.tolist(), data.material.tolist(), data.clusters().tolist(), strict=True))
    for count in (1, 40, 900):
        sample = data.subsample(count, 0)
        drawn = [every[i] for i in sample.row]
        assert (np.diff(sample.row) > 0).all()
        for held_out in (False, True):
            size = sum(group[0] == held_out for group in every)
            share = min(count / size, 1.0)
            assert sum(group[0] == held_out for group in drawn) == min(count, size) > 0
            for group in {group for group in every if group[0] == held_out}:
                assert abs(drawn.count(group) - share * every.count(group)) < 1, (count, group)
    assert len(data.subsample(len(data), 0)) == len(data)
    assert (data.subsample(40, 0).row[:40] != data.subsample(40, 1).row[:40]).any()


# ── Interreflection: G of radiances that are known by hand, and the forward model with it ───────────────────────────


@pytest.fixture(scope="module", params=["linear", "toned"])
def illumination(request):
    return photos_in_a_wrong_light("bounced", request.param == "toned")


def test_bounces_add_a_known_radiance(illumination):
    light = msgspec.structs.replace(illumination.light, log_tone=np.zeros(0))
    data, kd, ks = (
        illumination.block,
        MATERIALS.diffuse[illumination.block.material],
        MATERIALS.specular[illumination.block.material],
    )
    with_, without = (
        Illumination(b, light, MATERIALS, OPERATOR).radiance() for b in (data, data.with_effects(True, False))
    )
    np.testing.assert_allclose(with_ - without, kd * data.bounced[:, :3] + ks * data.bounced[:, 3:])
    assert JointProblem([data], OPERATOR).with_effects(shadows=False, bounces=True).blocks[0].bounced is None


def bowl(albedo, depth=0.5, size=40, count=1024) -> Observations:
    """The inside of a sphere open to constant light 1 from beyond a cap: radiosity is constant there, for form factors are.

    depth: share of the sphere that is bowl.  Radiance L = albedo (1 − depth + depth L) everywhere.
    """
    n = fibonacci_sphere(size * size)
    n = n[n[:, 2] > 2 * (1 - depth) - 1 + 1e-9] * [1, 1, -1]  # inward normals of the points −n, away from the opening
    d = fibonacci_sphere(count)
    out = -n[:, None] + 2 * (n @ d.T)[..., None] * d  # where a ray from −n leaves the sphere
    hidden = (out[..., 2] > 1 - 2 * depth) & (n @ d.T > 0)
    codes = occluder_codes(np.zeros(hidden.size, int), -out.reshape(-1, 3)).reshape(hidden.shape)
    radiance = np.full((len(n), 3), albedo * (1 - depth) / (1 - albedo * depth))
    how = {
        "visibility": np.where(hidden, 0, 255).astype(np.uint8),
        "occluder": np.where(hidden, codes, NO_OCCLUDER).astype(np.uint16),
    }
    return observations_from_front(n, radiance, np.zeros(len(n), int), ("white",), **how)


@pytest.mark.parametrize(("albedo", "depth"), [(0.3, 0.5), (0.9, 0.5), (0.9, 0.9)])
def test_a_bowl_in_constant_light_has_the_analytic_radiosity(albedo, depth):
    """k_d (V̄ · 1 + G) is L, all bounces with it, with V̄ and G from directions that are hidden."""
    observed = bowl(albedo, depth)
    bounced = bounced_light(observed, observed.radiance)[:, :3]
    cosine = np.maximum(observed.normal @ fibonacci_sphere(1024).T, 0)
    open_share = (cosine * (observed.visibility / 255)).sum(1) / cosine.sum(1)
    np.testing.assert_allclose(albedo * (open_share[:, None] + bounced), observed.radiance, rtol=0.03)


def test_nothing_hidden_sends_nothing_and_brighter_photos_send_more_in_their_own_unit_alike():
    observed, factor = bowl(0.5, size=20, count=256), 1e4
    open_ = msgspec.structs.replace(observed, visibility=np.full_like(observed.visibility, 255))
    for none in (open_, msgspec.structs.replace(observed, occluder=None)):
        assert blocks_of_observations(none, Noise())[0].bounced is None
    brighter = msgspec.structs.replace(observed, radiance=factor * observed.radiance)
    bounced, more = (bounced_light(photo, photo.radiance) for photo in (observed, brighter))
    np.testing.assert_allclose(more, factor * bounced, rtol=1e-5)
    one, other = (blocks_of_observations(photo, Noise())[0].bounced for photo in (observed, brighter))
    np.testing.assert_allclose(one, other, rtol=1e-5)


def test_surroundings_determine_the_gauge_and_interreflection_alone_is_weighed_with_priors(illumination):
    """Logarithms of the factors are the most probable ones under both, each with its own deviation."""
    block, light = illumination.block, illumination.light
    point = Point(MATERIALS, [light])
    seen = msgspec.structs.replace(block, background=True)
    np.testing.assert_array_equal(fix_gauge(point, [seen]).materials.diffuse, MATERIALS.diffuse)
    settled = fix_gauge(point, [block]).materials
    factor = settled.diffuse[0] / MATERIALS.diffuse[0]
    trials = np.linspace(-3, 3, 60001)

    def likeliest(by_prior: float, deviation: float) -> float:
        return trials[np.argmin((trials / BOUNCE_DEVIATION) ** 2 + ((trials - by_prior) / deviation) ** 2)]

    level = np.log(light.energy.sum(0))
    tint = np.array([likeliest(each, TINT_DEVIATION) for each in level - level.mean()])
    np.testing.assert_allclose(np.log(factor) - np.log(factor).mean(), tint - tint.mean(), atol=2e-4)
    brightness = (np.exp(tint) * (MATERIALS.diffuse + MATERIALS.specular)).mean(1).max()
    scale = likeliest(np.log(MEDIAN_BRIGHTNESS / brightness), BRIGHTNESS_DEVIATION)
    np.testing.assert_allclose(np.log(factor), tint + scale, atol=4e-4)


def test_no_reflectance_is_above_one_where_surroundings_determine_the_scale(illumination):
    """One factor for the whole component, so that tints stay."""
    light = illumination.light
    bright = Materials(3 * MATERIALS.diffuse * [1.0, 1.3, 0.8], 3 * MATERIALS.specular, MATERIALS.roughness)
    settled = fix_gauge(Point(bright, [light]), [msgspec.structs.replace(illumination.block, background=True)])
    assert (settled.materials.diffuse + settled.materials.specular).max() == pytest.approx(BRIGHTEST)
    factor = settled.materials.vector()[0] / bright.vector()[0]
    np.testing.assert_allclose(settled.materials.diffuse, factor * bright.diffuse)
    np.testing.assert_allclose(settled.lights[0].weight, light.weight / factor)


# ── Lights on cells: what equal ones show, and what splitting keeps ─────────────────────────────────────────────────


DIRECTIONS = np.random.default_rng(1).normal(size=(2000, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def shown(light: Light, directions=DIRECTIONS) -> np.ndarray:
    return light.lobes.radiance(directions)


def smooth(cells: int) -> Light:
    return on_even_cells(
        np.array([[0.5], [0.3], [0.4]]) * (fibonacci_cells(cells).axis @ np.array([0.6, 0.8, 0.0]) + 1)
    )


@pytest.mark.parametrize("count", [200, 400])
def test_cells_of_equal_radiance_are_a_constant_light_but_for_a_ripple(count):
    radiance = shown(on_even_cells(np.zeros((3, count))))
    ripple = np.abs(radiance - 1)  # largest at the poles, where cells are least even
    assert radiance.std() < 0.03 and np.quantile(ripple, 0.99) < 0.1 and abs(radiance.mean() - 1) < 0.005


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_a_smooth_light_stays_when_cells_split_and_when_theirs_split_again(share):
    """Its energy does, and what surfaces reflect of it, but for the ripple of cells that are not where even ones would be."""
    light = smooth(200)
    some = np.random.default_rng(0).random(200) < share
    once = light.split(some)
    twice = once.split(once.sharpness > light.sharpness.max())
    for one, more in ((once, 3), (twice, 15)):
        assert len(one) == pytest.approx(200 + more * some.sum(), rel=0.05)
    spheres = sphere_block("room", light, MATERIALS, [0, 1, 2], NETWORK, size=14)
    before = Illumination(spheres, light, MATERIALS, NETWORK).radiance()
    rough = MATERIALS.roughness[spheres.material] > 0.3
    for one, ripple in ((once, 0.04), (twice, 0.06)):
        np.testing.assert_allclose(one.energy.sum(0), light.energy.sum(0), rtol=0.02)
        np.testing.assert_allclose(np.linalg.norm(one.axis, axis=1), 1, rtol=1e-12)
        off = np.log(Illumination(spheres, one, MATERIALS, NETWORK).radiance() / before)
        assert off[rough].std() < 0.01 and off[~rough].std() < ripple, (off[rough].std(), off[~rough].std())


def test_the_brightest_split_but_none_that_is_too_small():
    light, how = on_even_cells(drawn(1, 200)), (SPLIT_CELLS, 2 * np.radians(LEAST_SPACING_DEG))
    which = light.brightest_cells(*how)
    assert which.sum() == SPLIT_CELLS and light.energy.sum(1)[which].min() >= light.energy.sum(1)[~which].max()
    for _ in range(8):
        light = light.split(light.brightest_cells(*how))
    assert np.degrees(2 / np.sqrt(light.sharpness)).min() > LEAST_SPACING_DEG
    assert on_even_cells(np.zeros((3, 12))).brightest_cells(*how).all()
