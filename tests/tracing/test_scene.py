"""Mitsuba's scenes agree with the project's frames and reflectance model."""

import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.geometry.camera import Camera
from factorlib.light.latlong import sample_map
from factorlib.results.materials import Reflectance
from factorlib.tracing import scene as tracing
from tests.integral import reflected

pytest.importorskip("mitsuba")
GREEN = Reflectance((0.1, 0.4, 0.15), (0.25, 0.25, 0.2), 0.35)
RED = Reflectance((0.5, 0.12, 0.1), (0.08, 0.08, 0.08), 0.6)
PIXEL = Camera(1, 1, 400.0, (0.5, 0.5))
BALL = np.array([0.6, -0.3, 4.0])  # centre, camera frame; radius 1
AT_ORIGIN = tracing.rigid(YUP_FROM_CAMERA, np.zeros(3))


@pytest.mark.parametrize("material", [GREEN, RED])
def test_mitsuba_evaluates_lambert_and_ggx_of_the_design(material):
    """One pixel's worth: a ball's radiance in a smooth light against a sum over directions of the written formula."""
    light = smooth_light(32)
    pose = tracing.rigid(YUP_FROM_CAMERA, YUP_FROM_CAMERA @ BALL)
    ball = {"type": "sphere", "to_world": tracing.transform(pose), "bsdf": tracing.bsdf(material)}
    scene = {"ball": ball, "light": tracing.envmap(light)}
    image = tracing.rendered(scene, tracing.sensor(PIXEL, AT_ORIGIN), 200_000, 2, 2)[0, 0]
    depth = 4.0 - np.sqrt(1 - 0.6**2 - 0.3**2)  # of the ball where the camera's axis meets it
    normal, view = np.array([0, 0, depth]) - BALL, np.array([0, 0, -1.0])
    incoming = lat_long_directions(512, 1024) @ YUP_FROM_CAMERA
    texels = sample_map(light, incoming @ YUP_FROM_CAMERA) * lat_long_solid_angles(512, 1024)[:, None, None]
    expected = reflected(material, normal[None], view[None], incoming.reshape(-1, 3), texels.reshape(-1, 3))
    assert image == pytest.approx(expected[0], rel=0.006)


def smooth_light(height):
    x, y, z = np.moveaxis(lat_long_directions(height, 2 * height), -1, 0)
    return 1 + np.stack([x * y, np.exp(4 * (0.6 * x + 0.8 * z - 1)) * 3, y * z * z], axis=-1)


def test_the_light_seen_is_the_light_there():
    """A map, seen from inside by six cameras in a turned frame, comes back as that map turned."""
    light = smooth_light(16)
    turn = tracing.look(20, 130) @ YUP_FROM_CAMERA
    seen = tracing.incident_light({"light": tracing.envmap(light)}, tracing.rigid(turn, (0, 0, 0)), 16, 4, 1)
    assert seen == pytest.approx(sample_map(light, lat_long_directions(16, 32) @ turn.T), rel=0.02, abs=0.05)
