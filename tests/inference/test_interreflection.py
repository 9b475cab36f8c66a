"""Interreflection: G of radiances that are known by hand, and the forward model with it."""

import msgspec
import numpy as np
import pytest

from factorlib.geometry.occluder_codes import NO_OCCLUDER, occluder_codes
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.blocks import Noise
from factorlib.inference.forward import Illumination
from factorlib.inference.gauge import fix_gauge
from factorlib.inference.interreflection import bounced_light
from factorlib.inference.materials import Point
from factorlib.inference.observed import blocks_of_observations
from factorlib.inference.problem import JointProblem
from factorlib.scenes.joint_problems import MATERIALS
from factorlib.urm.observations import Observations
from tests.inference.made import OPERATOR, observations_from_front, photos_in_a_wrong_light


@pytest.fixture(scope="module", params=["linear", "toned"])
def given(request):
    return photos_in_a_wrong_light("bounced", request.param == "toned")


def test_bounces_add_a_known_radiance(given):
    light = msgspec.structs.replace(given.light, log_tone=np.zeros(0))
    data, kd, ks = given.block, MATERIALS.diffuse[given.block.material], MATERIALS.specular[given.block.material]
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
        "met": np.where(hidden, codes, NO_OCCLUDER).astype(np.uint16),
    }
    return observations_from_front(n, radiance, np.zeros(len(n), int), ("white",), **how)


@pytest.mark.parametrize(("albedo", "depth"), [(0.3, 0.5), (0.9, 0.5), (0.9, 0.9)])
def test_a_bowl_in_constant_light_has_the_analytic_radiosity(albedo, depth):
    """k_d (V̄ · 1 + G) is L, all bounces with it, with V̄ and G from directions that are hidden."""
    seen = bowl(albedo, depth)
    sent = bounced_light(seen, seen.radiance)[:, :3]
    cosine = np.maximum(seen.normal @ fibonacci_sphere(1024).T, 0)
    open_share = (cosine * (seen.visibility / 255)).sum(1) / cosine.sum(1)
    np.testing.assert_allclose(albedo * (open_share[:, None] + sent), seen.radiance, rtol=0.03)


def test_nothing_hidden_sends_nothing_and_brighter_photos_send_more_in_their_own_unit_alike():
    seen, factor = bowl(0.5, size=20, count=256), 1e4
    open_ = msgspec.structs.replace(seen, visibility=np.full_like(seen.visibility, 255))
    for none in (open_, msgspec.structs.replace(seen, met=None)):
        assert blocks_of_observations(none, Noise())[0].bounced is None
    brighter = msgspec.structs.replace(seen, radiance=factor * seen.radiance)
    sent, more = (bounced_light(photo, photo.radiance) for photo in (seen, brighter))
    np.testing.assert_allclose(more, factor * sent, rtol=1e-5)
    one, other = (blocks_of_observations(photo, Noise())[0].bounced for photo in (seen, brighter))
    np.testing.assert_allclose(one, other, rtol=1e-5)


def test_what_interreflection_determines_the_gauge_leaves(given):
    point = Point(MATERIALS, [given.light])
    np.testing.assert_array_equal(fix_gauge(point, [given.block]).materials.diffuse, MATERIALS.diffuse)
    assert (fix_gauge(point, [given.block.with_effects(True, False)]).materials.diffuse != MATERIALS.diffuse).any()
