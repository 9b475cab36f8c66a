"""What no photo determines, a factor per channel between all materials and all lights, taken out of an answer by the true materials."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from factorlib.evaluate.materials import common_factor
from factorlib.results.materials import Reflectance
from studies.core.baselines.scene import Map


def factor_of(materials: Mapping[str, Reflectance], truths: Mapping[str, Reflectance]) -> Float[np.ndarray, "3"]:
    """That takes the materials nearest to the true ones of their names."""
    return np.array(common_factor(list(materials.values()), [truths[name] for name in materials]))


def times(material: Reflectance, factor: Float[np.ndarray, "3"]) -> Reflectance:
    """A material that reflects so many times as much."""
    diffuse, specular = (tuple((np.array(k) * factor).tolist()) for k in (material.diffuse, material.specular))
    return Reflectance(diffuse, specular, material.roughness)


def in_gauge(
    materials: Mapping[str, Reflectance], lights: Mapping[int, Map], truths: Mapping[str, Reflectance]
) -> tuple[dict[str, Reflectance], dict[int, Map]]:
    """Materials times the factor, lights divided by it: what they show together stays as it is."""
    factor = factor_of(materials, truths)
    return {name: times(m, factor) for name, m in materials.items()}, {li: of / factor for li, of in lights.items()}


def lambertian_part(materials: Mapping[str, Reflectance]) -> dict[str, Reflectance]:
    """Without specular parts."""
    return {name: Reflectance(m.diffuse, (0.0, 0.0, 0.0), m.roughness) for name, m in materials.items()}
