"""Reflectors: the same radiance as quadrature over the exported map, and as the operator without short cuts; balls of them."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.conventions import FRONT, YUP_FROM_CAMERA, lat_long_directions, lat_long_solid_angles
from factorlib.geometry.sphere import ball_normals, fibonacci_sphere
from factorlib.light.latlong import lat_long_of_lobes
from factorlib.light.lobes import Lobes, no_lobes
from factorlib.reflection import reflection_operator
from factorlib.reflection.reference import Reference
from factorlib.render.reflect import PointEffects, Reflector
from factorlib.render.resynthesis import balls
from factorlib.results.materials import Reflectance
from tests.integral import reflected

GLOSSY = Reflectance((0.4, 0.2, 0.1), (0.1, 0.2, 0.3), 0.4)


def unit(count: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def light(count: int = 5) -> Lobes:
    weight = np.random.default_rng(1).uniform(0.2, 2, (count, 3)) * np.geomspace(1, 20, count)[:, None]
    return Lobes(unit(count, 0), np.geomspace(1, 150, count), weight)


def cells(sharpest: float = 900.0) -> Lobes:
    """A light as it is solved for: lobes all around, some bright and narrow."""
    narrow = np.arange(300) % 50 == 0
    weight = np.random.default_rng(6).uniform(0.2, 2, (300, 3)) * np.where(narrow, 0.05 * sharpest, 1)[:, None]
    return Lobes(fibonacci_sphere(300), np.where(narrow, sharpest, 70.0), weight)


def points(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals and views that see the surface."""
    normals, views = unit(count, 2), unit(count, 3)
    return normals, views * np.sign((normals * views).sum(1, keepdims=True))


def test_radiance_is_the_integral_over_the_exported_map():
    light_map, (normals, views) = lat_long_of_lobes(light(), 128, 256), points(12)
    texels = light_map * lat_long_solid_angles(128, 256)[:, None, None]
    incoming = (lat_long_directions(128, 256) @ YUP_FROM_CAMERA).reshape(-1, 3)
    expected = reflected(GLOSSY, normals, views, incoming, texels.reshape(-1, 3))
    found = Reflector(Reference(tolerance=1e-4), light())(GLOSSY, normals, views)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("roughness, sharpest", [(0.1, 900.0), (0.3, 900.0), (0.3, 2e5), (0.6, 900.0)])
def test_balls_are_the_operator_at_every_pixel(roughness, sharpest):
    glossy = msgspec.structs.replace(GLOSSY, roughness=roughness)
    reflector = Reflector(reflection_operator("network"), cells(sharpest))
    for picture in balls(reflector, glossy, (96, 48)):
        normals, inside = ball_normals(len(picture))
        normals = normals * (1, -1, -1)
        expected = reflector(glossy, normals, np.broadcast_to(FRONT, normals.shape))
        error = np.abs(picture[inside] - expected)
        assert not picture[~inside].any()
        assert np.sqrt((error**2).mean() / (expected**2).mean()) < 0.003
        assert np.percentile(error / expected, 99) < 0.005


def test_turning_light_and_object_together_changes_nothing_and_scaling_the_light_scales():
    rotation, (normals, views) = Rotation.random(random_state=4).as_matrix(), points(50)
    operator, factor = reflection_operator("closed_form", dtype="float64"), np.array([2.0, 0.5, 3.0])
    expected = Reflector(operator, light())(GLOSSY, normals, views)
    turned = Reflector(operator, light().turned(rotation))(GLOSSY, normals @ rotation.T, views @ rotation.T)
    np.testing.assert_allclose(turned, expected, rtol=1e-6)
    scaled = Reflector(operator, light().scaled(factor))(GLOSSY, normals, views)
    np.testing.assert_allclose(scaled, expected * factor, rtol=1e-9)


def test_chunks_do_not_show(monkeypatch):
    operator, seen = reflection_operator("closed_form"), []
    whole = Reflector(operator, light())(GLOSSY, *points(50))
    monkeypatch.setattr("factorlib.render.reflect.PAIRS_AT_ONCE", 35)
    parts = Reflector(operator, light())(GLOSSY, *points(50), report=lambda done, total: seen.append((done, total)))
    np.testing.assert_allclose(parts, whole, rtol=1e-6)
    assert seen[0] == (7, 50) and seen[-1] == (50, 50)


@pytest.mark.parametrize("lit, facing", [(no_lobes(), 1), (light().scaled(0.0), 1), (light(), -1)])
def test_darkness_is_black_and_so_is_what_faces_away(lit, facing):
    normals, views = points(20)
    assert not Reflector(reflection_operator("closed_form"), lit)(GLOSSY, normals, facing * views).any()


def test_shadows_that_hide_nothing_change_nothing_and_those_that_hide_all_leave_darkness():
    reflector, (normals, views) = Reflector(reflection_operator("closed_form"), light()), points(40)
    for level, factor in ((255, 1.0), (0, 0.0)):
        found = reflector(GLOSSY, normals, views, effects=PointEffects(visibility=np.full((40, 256), level, np.uint8)))
        np.testing.assert_allclose(found, factor * reflector(GLOSSY, normals, views), rtol=1e-5, atol=2e-3)


def test_a_near_light_is_to_each_point_a_far_one_of_moved_lobes():
    operator, lobes, (normals, views) = reflection_operator("closed_form", dtype="float64"), light(), points(20)
    place, curvature = 1.5 * unit(20, 5), 0.2
    near = Reflector(operator, lobes, curvature)(GLOSSY, normals, views, effects=PointEffects(place=place))
    for k, x in enumerate(curvature * place):
        to = lobes.axis - x
        d = np.linalg.norm(to, axis=1, keepdims=True)
        moved = Lobes(to / d, lobes.sharpness, lobes.weight * (1 - lobes.axis @ x)[:, None] / d**3)
        far = Reflector(operator, moved)(GLOSSY, normals[k : k + 1], views[k : k + 1])[0]
        np.testing.assert_allclose(near[k], far, rtol=1e-4)
    middle = Reflector(operator, lobes, curvature)(GLOSSY, normals, views, effects=PointEffects(place=0 * place))
    np.testing.assert_allclose(middle, Reflector(operator, lobes)(GLOSSY, normals, views), rtol=1e-9)
    assert np.abs(near / middle - 1).max() > 0.1


def test_detail_is_a_factor_on_the_diffuse_part_alone():
    reflector, (normals, views) = Reflector(reflection_operator("network"), light()), points(40)
    detail, black = np.linspace(0.2, 2.0, 40), (0.0, 0.0, 0.0)
    diffuse, specular = (Reflectance(kd, ks, 0.4) for kd, ks in ((GLOSSY.diffuse, black), (black, GLOSSY.specular)))
    parts = [reflector(of, normals, views) for of in (diffuse, specular)]
    expected = detail[:, None] * parts[0] + parts[1]
    np.testing.assert_allclose(
        reflector(GLOSSY, normals, views, effects=PointEffects(detail=detail)), expected, rtol=0.03, atol=1e-3
    )
    np.testing.assert_allclose(
        reflector(diffuse, normals, views, effects=PointEffects(detail=detail)), detail[:, None] * parts[0], rtol=1e-5
    )
