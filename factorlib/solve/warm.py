"""Where a solve starts when an earlier solution is given: what has a name there is used, the rest follows from it.

Materials are known by their names, lights by their illumination's.  Mean radiances give all materials one relative scale
(`factorlib.solve.start.mean_albedo`), known or new; each gauge of the earlier solution is brought to that scale by one factor per channel, the
geometric mean over its materials, and its lights by the inverse.  So groups that a new photo links come into one gauge, and new materials
stand beside the known ones.  A new photo of a known light gets the exposure that explains its mean radiance; a new light is constant.

A light that explains its photos worse than a constant does (it was taken again, or turned, or in other units) is not known but new.  Only the
start, and what was decided of shadows and bounces, are taken over: nothing pulls toward the earlier answer.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.model.blocks import Block
from factorlib.model.bounds import SHARPNESS, TONE
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.results.solution import Earlier
from factorlib.solve.options import Choices
from factorlib.solve.solve import Start
from factorlib.solve.start import LEAST_RADIANCE, constant_light, mean_albedo, starting_materials

log = logging.getLogger("factorlib.solve")


def from_earlier(earlier: Earlier, names: Sequence[str]) -> Start:
    """The start of a problem whose materials are called `names`."""
    return Start(lambda problem, cells: [known_point(problem, earlier, names, cells)], earlier=True)


def with_decided(choices: Choices, earlier: Earlier) -> Choices:
    """Return the choices with shadows and bounces as they were decided before, where the two had been compared."""
    for name in ("self_shadowing", "interreflection"):
        if getattr(choices, name) == "auto" and getattr(earlier, name):
            choices = msgspec.structs.replace(choices, **{name: getattr(earlier, name)})
    return choices


def known_point(problem: JointProblem, earlier: Earlier, names: Sequence[str], cells: int) -> Point:
    """Build the point from which a solve starts."""
    blocks = problem.blocks
    start = starting_materials(blocks, len(names))
    component = [earlier.table.gauge.component.get(name) for name in names]
    factors = gauge_factors(earlier, names, component, mean_albedo(blocks, len(names)), blocks)
    rows = start.rows()
    for m, name in enumerate(names):
        if component[m] is not None:
            known = earlier.table.materials[name]
            rows[m] = [
                *(known.diffuse * factors[component[m]]),
                *(known.specular * factors[component[m]]),
                known.roughness,
            ]
    materials, lights = Materials.of_vector(rows.reshape(-1)), []
    for block in blocks:
        constant = constant_light(block, materials, cells)
        shown = [component[m] for m in np.unique(block.material) if component[m] is not None]
        light = (
            known_light(block, constant, earlier, factors[max(set(shown), key=lambda c: (shown.count(c), -c))])
            if shown
            else None
        )
        lights.append(better_one(problem, block, materials, light, constant))
    return Point(materials, lights)


def gauge_factors(
    earlier: Earlier,
    names: Sequence[str],
    component: Sequence[int | None],
    albedo: Float[np.ndarray, "m 3"],
    blocks: Sequence[Block],
) -> dict[int, Float[np.ndarray, "3"]]:
    """Find, for each component of the earlier solution, the factor per channel that brings its reflectances to the scale of `albedo`.

    The factor is the geometric mean over the component's materials that a block shows, or over all of them where none is shown.
    """
    shown, factors = {int(m) for block in blocks for m in np.unique(block.material)}, {}
    for c in sorted({c for c in component if c is not None}):
        members = [m for m in range(len(names)) if component[m] == c]
        members = [m for m in members if m in shown] or members
        known = [earlier.table.materials[names[m]] for m in members]
        whole = np.array([np.array(one.diffuse) + np.array(one.specular) for one in known])
        factors[c] = np.exp(np.mean(np.log(albedo[members]) - np.log(np.maximum(whole, LEAST_RADIANCE)), axis=0))
    return factors


def known_light(block: Block, constant: Light, earlier: Earlier, factor: Float[np.ndarray, "3"]) -> Light | None:
    """Bring the earlier light of a block to the block's unit and the start's gauge; None where there is none.

    A photo that the earlier solution does not have gets its exposure in the constant light, beside those of the others.
    """
    lobes = earlier.lights.get(block.name)
    exposure = np.array([np.log(np.mean(earlier.exposures.get(photo, (np.nan,) * 3))) for photo in block.photos])
    if not lobes or np.isnan(exposure).all():
        return None
    new = np.isnan(exposure)
    level = np.mean(exposure[~new] - constant.log_exposure[~new])
    exposure = np.where(new, constant.log_exposure + level, exposure)
    tone = [earlier.table.model.tone[photo].exponent for photo in block.photos if photo in earlier.table.model.tone]
    return Light(
        lobes.axis / np.linalg.norm(lobes.axis, axis=1, keepdims=True),
        np.log(np.maximum(lobes.sharpness, SHARPNESS[0])),
        np.maximum(lobes.weight, 0) / block.unit / factor * np.exp(exposure[0]),
        exposure - exposure[0],
        np.log(np.clip(tone, *TONE)) if len(tone) == len(block.photos) else np.zeros(0),
    )


def better_one(
    problem: JointProblem, block: Block, materials: Materials, known: Light | None, constant: Light
) -> Light:
    """Return the known light, unless the constant one explains the block better."""
    if known is None:
        return constant
    loss = [
        Illumination(block, one, materials, problem.operator).losses(problem.loss).mean() for one in (known, constant)
    ]
    if loss[0] <= loss[1]:
        return known
    log.warning(
        "illumination '%s' starts anew: what the earlier solution says of it explains less than a constant light",
        block.name,
    )
    return constant
