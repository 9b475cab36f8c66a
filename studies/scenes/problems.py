"""Joint problems of known answer: spheres of given materials under lights made of lobes.

The operator itself renders them.
"""

import msgspec
import numpy as np

from factorlib.inference.blocks import Block
from factorlib.inference.forward import Illumination
from factorlib.inference.lights import Light
from factorlib.inference.materials import Materials

MATERIALS = Materials(
    diffuse=np.array([[0.5, 0.1, 0.1], [0.2, 0.4, 0.25], [0.1, 0.12, 0.2]]),
    specular=np.array([[0.05, 0.05, 0.05], [0.2, 0.2, 0.2], [0.4, 0.35, 0.3]]),
    roughness=np.array([0.7, 0.4, 0.25]),
)


def sphere_normals(size: int) -> np.ndarray:
    """Return normals of a sphere seen from the front, one per pixel of a `size`² picture, grazing ones left out."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    inside = x**2 + y**2 < 0.95
    x, y = x[inside], y[inside]
    return np.column_stack([x, y, -np.sqrt(1 - x**2 - y**2)])


def random_light(rng, lobes: int, photos: int = 1, sharpest: float = 4.5, contrast: float = 0.7) -> Light:
    """Return lobes of random directions, of log sharpness up to `sharpest`; the exposures of photos but the first."""
    axis = rng.normal(size=(lobes, 3))
    log_sharpness = rng.uniform(0, sharpest, lobes)
    weight = (
        rng.lognormal(0, contrast, (lobes, 1)) * rng.lognormal(0, 0.2, (lobes, 3)) * np.exp(log_sharpness / 2)[:, None]
    )
    exposure = np.concatenate([[0.0], rng.normal(0, 0.5, photos - 1)])
    return Light(axis / np.linalg.norm(axis, axis=1, keepdims=True), log_sharpness, weight, exposure)


def block(name: str, light: Light, materials: Materials, shown, operator, size: int = 24, seed: int = 0) -> Block:
    """Return one illumination that shows the materials `shown`, a sphere of each in each of its photos."""
    normals = sphere_normals(size)
    photos, n = len(light.log_exposure), len(normals)
    material = np.repeat(sorted(shown), n * photos)
    photo = np.tile(np.repeat(np.arange(photos), n), len(shown))
    rows = len(material)
    empty = Block(
        name=name,
        photos=tuple(f"{name}_{k}" for k in range(photos)),
        unit=1.0,
        normal=np.tile(normals, (photos * len(shown), 1)),
        view=np.tile([0.0, 0.0, -1.0], (rows, 1)),
        radiance=np.zeros((rows, 3)),
        clipped=np.zeros((rows, 3), bool),
        precision=np.ones((rows, 3)),
        material=material,
        photo=photo,
        held_out=np.random.default_rng(seed).random(rows) < 0.1,
    )
    radiance = Illumination(empty, light, materials, operator).radiance()
    scaled = radiance / radiance.mean()
    return msgspec.structs.replace(
        empty, radiance=scaled, unit=float(radiance.mean()), precision=1 / np.hypot(0.05, 0.05 * scaled)
    )


def factor_between(found: Materials, true: Materials) -> np.ndarray:
    """Return the factor per channel that takes `found` reflectances to `true` ones."""
    return (true.diffuse + true.specular).sum(0) / (found.diffuse + found.specular).sum(0)
