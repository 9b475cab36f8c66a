"""Laws of the one forward model and of the joint problem: light, clipping, shadows, what is linked, and the gauge."""

import msgspec
import numpy as np
import pytest

from factorlib.inference.blocks import Noise
from factorlib.inference.forward import Illumination
from factorlib.inference.gauge import BRIGHTEST, connected_components, fix_gauge
from factorlib.inference.lights import UnitLobes
from factorlib.inference.materials import Materials, Point
from factorlib.inference.observed import blocks_of_observations
from factorlib.light.lobes import lobe_integral
from factorlib.reflection import reflection_operator
from factorlib.scenes.joint_problems import MATERIALS, block, random_light
from tests.inference.made import OPERATOR, bowls, photos_in_a_wrong_light, rough_light, three_rooms


def with_light(one: Illumination, **changes) -> Illumination:
    return msgspec.structs.replace(one, light=msgspec.structs.replace(one.light, **changes))


@pytest.fixture(scope="module", params=["linear", "toned"])
def clipped(request):
    return photos_in_a_wrong_light("clipped", request.param == "toned")


@pytest.fixture(scope="module")
def rooms():
    return three_rooms()


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
    seen, turn = bowls("room", rough_light(20)), np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    seen = msgspec.structs.replace(seen, place=2 * seen.normal)
    (data,) = blocks_of_observations(seen, Noise(), world_from_camera={seen.photos[0]: turn})
    (camera,) = blocks_of_observations(seen, Noise())
    np.testing.assert_allclose(data.place, camera.place @ turn.T, atol=1e-6)
    np.testing.assert_allclose(data.place, 2 * data.normal, atol=1e-6)


@pytest.mark.parametrize("seed", [20, 21])
def test_model_in_shadow_is_the_radiance_traced_in_bowls_by_brute_force(seed):
    """Whose visibility is known by hand."""
    (data,) = blocks_of_observations(bowls("room", rough_light(seed)), Noise(0.02, 0.02))
    light = rough_light(seed)
    light = msgspec.structs.replace(light, weight=light.weight / data.unit)
    network = reflection_operator("network")
    both = (Illumination(b, light, MATERIALS, network).radiance() for b in (data, data.with_effects(False, False)))
    error, ignored = (np.sqrt(np.mean((found - data.radiance) ** 2)) for found in both)
    assert ignored > 0.15 * data.radiance.mean() and error < 0.2 * ignored


# ── what is linked, and the gauge ────────────────────────────────────────────────────────────────────────────────────


def test_components_of_unlinked_photos():
    rng = np.random.default_rng(6)
    pairs = (("a", [0, 1]), ("b", [2]))
    blocks = [block(name, random_light(rng, 1), MATERIALS, shown, OPERATOR, size=8) for name, shown in pairs]
    assert connected_components(blocks, 4) == [((0, 1), ("a",)), ((2,), ("b",)), ((3,), ())]


def test_the_gauge_changes_no_radiance_and_a_shifted_point_comes_to_the_same_one(rooms):
    problem, point = rooms
    factor = np.array([2.0, 0.5, 1.3])
    materials = Materials(point.materials.diffuse * factor, point.materials.specular * factor, MATERIALS.roughness)
    lights = [msgspec.structs.replace(light, weight=light.weight / factor) for light in point.lights]
    shifted = Point(materials, lights)
    settled = [fix_gauge(p, problem.blocks) for p in (point, shifted)]
    np.testing.assert_allclose(settled[0].materials.vector(), settled[1].materials.vector(), rtol=1e-12)
    for at in (*settled, shifted):
        for found, expected in zip(problem.radiance(at), problem.radiance(point), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_single_light_comes_out_grey_and_a_lobe_made_sharper_at_its_energy_moves_no_tint():
    """The gauge depends on what lights send, not on how lobes make it up."""
    light = random_light(np.random.default_rng(2), 4)
    data = block("room", light, MATERIALS, [0, 1, 2], OPERATOR, size=8)
    sharper = light.log_sharpness + np.array([2.0, 0, 0, 0])
    kept = lobe_integral(light.sharpness) / lobe_integral(np.exp(sharper))
    other = msgspec.structs.replace(light, log_sharpness=sharper, weight=light.weight * kept[:, None])
    first, second = (fix_gauge(Point(MATERIALS, [li]), [data]) for li in (light, other))
    np.testing.assert_allclose(first.materials.vector(), second.materials.vector(), rtol=1e-12)
    assert abs((first.materials.diffuse + first.materials.specular).max() - BRIGHTEST) < 1e-12
    (grey,) = first.lights
    np.testing.assert_allclose(grey.energy.sum(0) / grey.energy.sum(), 1 / 3, rtol=1e-9)


def test_a_sample_has_of_every_material_and_region_of_the_light_its_share():
    light = random_light(np.random.default_rng(4), 3)
    data = block("room1", light, MATERIALS, [0, 1, 2], OPERATOR, size=60)
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
