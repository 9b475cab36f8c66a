"""What no observation tells, a factor per channel between the materials and the lights of a connected component, taken out of an answer.

The true materials fix it.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.evaluate.ball import Light
from factorlib.evaluate.materials import common_factor
from factorlib.results.materials import Reflectance
from studies.core.entries import Entries


class Answer(msgspec.Struct, frozen=True):
    """What was solved, in the truth's gauge: materials by name, lights by number."""

    materials: dict[str, Reflectance]
    lights: dict[int, Light]


def factor_of(materials: Mapping[str, Reflectance], truths: Mapping[str, Reflectance]) -> Float[np.ndarray, "3"]:
    """That takes the materials nearest to the true ones of their names."""
    return np.array(common_factor(list(materials.values()), [truths[name] for name in materials]))


def times(material: Reflectance, factor: Float[np.ndarray, "3"]) -> Reflectance:
    """A material that reflects so many times as much."""
    diffuse, specular = (tuple((np.array(k) * factor).tolist()) for k in (material.diffuse, material.specular))
    return Reflectance(diffuse, specular, material.roughness)


def in_true_gauge(
    case: Entries,
    table: Mapping[str, Reflectance],
    lights: Mapping[int, Light],
    truths: Mapping[str, Reflectance],
    component: Mapping[str, int],
) -> Answer:
    """Each component's materials times its factor per channel, its lights divided by it."""
    names = {number: [n for n in case.material_names if component[n] == number] for number in component.values()}
    factor = {number: factor_of({n: table[n] for n in of}, truths) for number, of in names.items()}
    of_light = {li: factor[component[case.names_in(li)[0]]] for li in case.lights}
    return Answer(
        {n: times(table[n], factor[component[n]]) for n in case.material_names},
        {
            li: Light(tuple((level / of_light[li]).astype(np.float32) for level in lights[li].levels))
            for li in case.lights
        },
    )
