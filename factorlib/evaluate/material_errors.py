"""Errors of recovered materials.

Roughness     Absolute difference.
Colours       Diffuse and specular, relative to the truth, after one factor per channel that all materials of a
              connected component share, because observations cannot separate it from the light.  The factor is the
              median over the component's materials of true over estimated diffuse + specular: a material's total
              reflectance is known best, and one bad material does not move a median.  A true albedo below 0.01 counts
              as 0.01.
Null          A grey ball: diffuse 0.5, specular 0.05, roughness 0.5 for every material, scaled by its own factor.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from factorlib.results.materials import Reflectance, Vec3, vec3
from factorlib.results.metrics import ComparedMaterial, MaterialError, MaterialScores

DARKEST = 0.01
GREY = Reflectance(diffuse=(0.5, 0.5, 0.5), specular=(0.05, 0.05, 0.05), roughness=0.5)


def compare_materials(
    estimates: Mapping[str, Reflectance], truths: Mapping[str, Reflectance], component: Mapping[str, int]
) -> MaterialScores | None:
    """Return the errors of the materials that have a truth; None if there are none.

    Args:
        estimates: recovered materials by name
        truths: true materials by name
        component: connected component of each material; a material without one was never observed and is left out
    """
    names = [n for n in estimates if n in truths and n in component]
    if not names:
        return None
    factor = {}
    compared = {}
    for c in sorted({component[n] for n in names}):
        group = [n for n in names if component[n] == c]
        true = [truths[n] for n in group]
        factor[str(c)] = common_factor([estimates[n] for n in group], true)
        grey = common_factor([GREY] * len(group), true)
        for n in group:
            errors = [_error(m, truths[n], f) for m, f in ((estimates[n], factor[str(c)]), (GREY, grey))]
            compared[n] = ComparedMaterial(c, truths[n], estimates[n], *errors)
    return MaterialScores(factor=factor, materials=compared, **_summary(compared))


def common_factor(estimates: list[Reflectance], truths: list[Reflectance]) -> Vec3:
    """Return the median over materials of true over estimated diffuse + specular, per channel.

    A material that reflects nothing counts as 1.

    >>> m = Reflectance((0.2, 0.4, 0.1), (0.1, 0.1, 0.1), 0.3)
    >>> common_factor([m], [Reflectance((0.4, 0.4, 0.1), (0.2, 0.1, 0.1), 0.3)])
    (2.0, 1.0, 1.0)
    """
    estimated, true = (np.array([_albedos(m).sum(axis=0) for m in group]) for group in (estimates, truths))
    ratio = np.where(estimated > 0, true / np.maximum(estimated, 1e-30), 1.0)
    return vec3(np.median(ratio, axis=0))


def _albedos(material: Reflectance) -> Float[np.ndarray, "2 3"]:
    return np.array([material.diffuse, material.specular], float)


def _error(estimate: Reflectance, truth: Reflectance, factor: Vec3) -> MaterialError:
    relative = (_albedos(estimate) * factor - _albedos(truth)) / np.maximum(_albedos(truth), DARKEST)
    diffuse, specular = (vec3(row) for row in relative)
    return MaterialError(roughness=abs(estimate.roughness - truth.roughness), diffuse=diffuse, specular=specular)


def _summary(compared: Mapping[str, ComparedMaterial]) -> dict[str, float]:
    summary: dict[str, float] = {}
    for part in ("roughness", "diffuse", "specular"):
        errors, null = (np.abs([getattr(getattr(m, k), part) for m in compared.values()]) for k in ("error", "null"))
        summary |= {f"mean_{part}": float(errors.mean()), f"worst_{part}": float(errors.max())}
        summary[f"null_mean_{part}"] = float(null.mean())
    return summary
