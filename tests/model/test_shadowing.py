"""Self-shadowing in the model: hemispherical bowls, whose visibility is known by hand, traced by brute force."""

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.reflection import reflection_operator
from factorlib.urm.observations import Observations
from studies.scenes.problems import MATERIALS, random_light, sphere_normals

OPERATOR = reflection_operator("closed_form", dtype="float64")
NAMES = ("red", "green", "blue")


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
    return (weight * ni / np.pi) @ incoming * materials.diffuse[material] + (
        weight * highlight
    ) @ incoming * materials.specular[material]


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


def test_model_in_shadow_is_the_traced_radiance(rooms):
    for data, seed in zip(rooms, (20, 21), strict=True):
        light = rough_light(seed)
        light = msgspec.structs.replace(light, weight=light.weight / data.unit)
        with_, without = (
            Illumination(b, light, MATERIALS, reflection_operator("network")).radiance()
            for b in (data, data.without_shadows())
        )
        error, ignored = (np.sqrt(np.mean((found - data.radiance) ** 2)) for found in (with_, without))
        assert ignored > 0.15 * data.radiance.mean()
        assert error < 0.2 * ignored


def test_nothing_hidden_is_nothing_computed():
    seen = bowls("room", rough_light(3), size=8)
    open_ = msgspec.structs.replace(seen, visibility=np.full_like(seen.visibility, 255))
    assert blocks_of_observations(open_, Noise())[0].visibility is None
