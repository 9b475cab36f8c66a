"""An answer in the truth's gauge (`studies.core.gauge`), where photos link all materials and all lights, which are maps."""

from __future__ import annotations

from collections.abc import Mapping

from factorlib.results.materials import Reflectance
from studies.core.baselines.scene import Map
from studies.core.gauge import factor_of, times


def in_gauge(
    materials: Mapping[str, Reflectance], lights: Mapping[int, Map], truths: Mapping[str, Reflectance]
) -> tuple[dict[str, Reflectance], dict[int, Map]]:
    """Materials times the factor, lights divided by it: what they show together stays as it is."""
    factor = factor_of(materials, truths)
    return {name: times(m, factor) for name, m in materials.items()}, {li: of / factor for li, of in lights.items()}


def lambertian_part(materials: Mapping[str, Reflectance]) -> dict[str, Reflectance]:
    """Without specular parts."""
    return {name: Reflectance(m.diffuse, (0.0, 0.0, 0.0), m.roughness) for name, m in materials.items()}
