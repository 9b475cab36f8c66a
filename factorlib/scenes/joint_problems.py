"""Joint problems of known answer: spheres of given materials under lights made of lobes.

The operator itself renders them.
"""

from collections.abc import Sequence
from string import digits
from typing import Any

import msgspec
import numpy as np

from factorlib.inference.model.blocks import Block
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.lights import Light
from factorlib.inference.model.materials import Materials
from factorlib.reflection import Operator
from factorlib.urm.observations import Observations

MATERIALS = Materials(
    diffuse=np.array([[0.5, 0.1, 0.1], [0.2, 0.4, 0.25], [0.1, 0.12, 0.2]]),
    specular=np.array([[0.05, 0.05, 0.05], [0.2, 0.2, 0.2], [0.4, 0.35, 0.3]]),
    roughness=np.array([0.7, 0.4, 0.25]),
)


def sphere_normals(size: int) -> np.ndarray:
    """Return normals of a sphere seen from the front, one per pixel of a `size`² picture, grazing ones left out."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size * 2 - 1
    inside = x**2 + y**2 < 0.95
    x = x[inside]
    y = y[inside]
    return np.column_stack([x, y, -np.sqrt(1 - x**2 - y**2)])


def random_light(
    rng: np.random.Generator, lobes: int, photos: int = 1, sharpest: float = 4.5, contrast: float = 0.7
) -> Light:
    """Draw lobes of random directions, of log sharpness up to `sharpest`, and the exposures of all photos but one."""
    axis = rng.normal(size=(lobes, 3))
    log_sharpness = rng.uniform(0, sharpest, lobes)
    level = rng.lognormal(0, contrast, (lobes, 1))
    weight = level * rng.lognormal(0, 0.2, (lobes, 3)) * np.exp(log_sharpness / 2)[:, None]
    exposure = np.concatenate([[0.0], rng.normal(0, 0.5, photos - 1)])
    return Light(axis / np.linalg.norm(axis, axis=1, keepdims=True), log_sharpness, weight, exposure)


def sphere_block(
    name: str, light: Light, materials: Materials, numbers: Sequence[int], operator: Operator, size: int = 24
) -> Block:
    """Return an illumination's observations: in each of its photos a sphere of each material.

    Args:
        name: Name of the illumination; a number at its end is the seed by which a tenth is held out.
        light: Light, with an exposure for each photo.
        materials: Materials of the problem.
        numbers: Numbers of the materials in the photos.
        operator: Reflection operator that renders them.
        size: Pixels across a sphere.
    """
    normals = sphere_normals(size)
    photos = len(light.log_exposure)
    n = len(normals)
    material = np.repeat(sorted(numbers), n * photos)
    rows = len(material)
    seed = int("0" + name[len(name.rstrip(digits)) :])
    empty = Block(
        name=name,
        photos=tuple(f"{name}_{k}" for k in range(photos)),
        unit=1.0,
        normal=np.tile(normals, (photos * len(numbers), 1)),
        view=np.tile([0.0, 0.0, -1.0], (rows, 1)),
        radiance=np.zeros((rows, 3)),
        clipped=np.zeros((rows, 3), bool),
        inverse_sigma=np.ones((rows, 3)),
        material=material,
        photo=np.tile(np.repeat(np.arange(photos), n), len(numbers)),
        held_out=np.random.default_rng(seed).random(rows) < 0.1,
    )
    radiance = Illumination(empty, light, materials, operator).radiance()
    scaled = radiance / radiance.mean()
    return msgspec.structs.replace(
        empty, radiance=scaled, unit=float(radiance.mean()), inverse_sigma=1 / np.hypot(0.05, 0.05 * scaled)
    )


def observations_from_front(
    normal: np.ndarray,
    radiance: np.ndarray,
    material: np.ndarray,
    names: tuple[str, ...],
    name: str = "room",
    **columns: Any,
) -> Observations:
    """Return one photo's observations of surfaces seen from the front, in a light of the same name.

    Args:
        normal: Normals in the camera's frame.
        radiance: Linear radiance.
        material: Numbers of the materials among `names`.
        names: Names of the materials.
        name: Name of the photo and of its light.
        columns: Columns that are others than usual: nothing is clipped, every weight is 1.
    """
    n = len(normal)
    zero = np.zeros(len(normal), int)
    usual: dict[str, Any] = {
        "view": np.tile([0.0, 0.0, -1.0], (n, 1)),
        "clipped": np.zeros((n, 3), bool),
        "photo": zero,
        "illumination": zero,
        "x": np.arange(n),
        "y": zero,
        "weight": np.ones(n),
        "photos": (name,),
        "illuminations": (name,),
    }
    return Observations(normal=normal, radiance=radiance, material=material, materials=names, **usual | columns)


def factor_between(estimate: Materials, truth: Materials) -> np.ndarray:
    """Return the factor per channel that takes estimated reflectances to the true ones."""
    return (truth.diffuse + truth.specular).sum(0) / (estimate.diffuse + estimate.specular).sum(0)
