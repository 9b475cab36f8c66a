"""Errors of materials' numbers and of lights as scores, each beside that of a null."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from factorlib.evaluate.ball import Light
from factorlib.evaluate.lights import SPHERES, compare_lights
from factorlib.evaluate.materials import compare_materials
from factorlib.results.materials import Reflectance
from studies.core.case import Score

PARTS = ("diffuse", "specular", "roughness")


def material_errors(
    found: Mapping[str, Reflectance],
    truths: Mapping[str, Reflectance],
    component: Mapping[str, int],
    parts: Sequence[str] = PARTS,
) -> Score:
    """Means over materials, one factor per channel and component taken out; the null is grey.

    component: of each material by name, as `connected_components` numbers them
    """
    errors = compare_materials(found, truths, component)
    return Score(*({part: getattr(errors, prefix + part) for part in parts} for prefix in ("mean_", "null_mean_")))


def light_errors(
    found: Mapping[str, Light], truths: Mapping[str, Light], gauge: str = "none", spheres: Sequence[str] = SPHERES
) -> Score:
    """RMSE of white spheres over the truth's RMS, means over the lights that were found; the null is constant light of the true mean.

    gauge: of `factorlib.evaluate.gauge`
    """
    errors = compare_lights(found, truths, {}).mean[gauge]
    return Score(
        *({sphere: getattr(errors[sphere], which).rmse for sphere in spheres} for which in ("estimate", "null"))
    )
