"""How coloured recovered lights are: what the paper's prior acts on.

chromaticity    of a light: deviation over its three channels of their mean radiances, over the mean of these.  Before that each
                channel is divided by its geometric mean over the case's lights: what no observation tells, a factor per
                channel, is out of it, in answers and in truths alike.  Mean over lights.
colour          mean angle between the colours of a mirror sphere in the recovered and in the true light, in the truth's gauge
tint            deviation over channels of the log of the factor that takes recovered reflectances to true ones: what remains
                of the free factor where the prior, or the gauge, has settled it
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from factorlib.evaluate.ball import Light
from factorlib.evaluate.lights import compare_lights
from factorlib.results.materials import read_materials
from studies.core.case import Case, Score, named
from studies.core.gauge import factor_of, in_true_gauge
from studies.core.lights import lights_of
from studies.core.world import materials_of


def tints_of(case: Case, solved: Path, lights: Mapping[int, Light]) -> Score:
    """By measure, of the files that `solve` wrote; the case's materials and lights are linked; lights: true ones."""
    table, truths, found = (
        read_materials(solved / "materials.json").materials,
        materials_of(case.seed),
        lights_of(solved, case.lights),
    )
    names = case.material_names
    factor = np.log(factor_of({n: table[n] for n in names}, truths))
    scaled = in_true_gauge(case, table, found, truths, dict.fromkeys(names, 0)).lights
    spheres = compare_lights(named(scaled), named(lights), {})
    mirror = spheres.mean["none"]["mirror"]
    values = {
        "chromaticity": chromaticity([found[li] for li in case.lights]),
        "true_chromaticity": chromaticity([lights[li] for li in case.lights]),
        "colour": mirror.estimate.rgb_angle_deg,
        "tint": float(np.std(factor)),
    }
    return Score(values, {"colour": mirror.null.rgb_angle_deg})


def chromaticity(lights: list[Light]) -> float:
    """Of lights that share materials; 0 where all have one colour.

    >>> from factorlib.evaluate.ball import constant_light
    >>> one = chromaticity([constant_light(np.array(c)) for c in ((1.0, 2.0, 3.0), (2.0, 4.0, 6.0))])
    >>> round(one, 6), round(chromaticity([constant_light(np.array(c)) for c in ((4.0, 1.0, 1.0), (1.0, 1.0, 1.0))]), 3)
    (0.0, 0.318)
    """
    means = np.stack([light.mean for light in lights]).clip(1e-9)
    free = means / np.exp(np.log(means).mean(axis=0))
    return float(np.mean(free.std(axis=1) / free.mean(axis=1)))
