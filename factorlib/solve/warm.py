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
from factorlib.solve.start import LEAST_RADIANCE, constant_light, mean_albedo, starting_point

log = logging.getLogger("factorlib.solve")


def from_earlier(earlier: Earlier, names: Sequence[str]) -> Start:
    """The start of a problem whose materials are called `names`."""
    return Start(lambda problem, cells: [known_point(problem, earlier, names, cells)], earlier=True)


def with_decided(choices: Choices, earlier: Earlier) -> Choices:
    """The choices, with shadows and bounces as they were decided before, where the two had been compared."""
    for name in ("self_shadowing", "interreflection"):
        if getattr(choices, name) == "auto" and getattr(earlier, name):
            choices = msgspec.structs.replace(choices, **{name: getattr(earlier, name)})
    return choices


def known_point(problem: JointProblem, earlier: Earlier, names: Sequence[str], cells: int) -> Point:
    """The point from which a solve starts."""
    blocks, point = problem.blocks, starting_point(problem.blocks, len(names), cells)
    albedo, rows = mean_albedo(blocks, len(names)), point.materials.rows()
    shown = {int(m) for block in blocks for m in np.unique(block.material)}
    factors: dict[int, np.ndarray] = {}
    for component in sorted(set(earlier.table.gauge.component.values())):
        members = [m for m, name in enumerate(names) if earlier.table.gauge.component.get(name) == component]
        seen = [m for m in members if m in shown] or members
        if not members:
            continue
        whole = np.array([_whole(earlier, names[m]) for m in seen])
        factors[component] = np.exp(np.mean(np.log(albedo[seen]) - np.log(np.maximum(whole, LEAST_RADIANCE)), axis=0))
        for m in members:
            known = earlier.table.materials[names[m]]
            rows[m] = [*(known.diffuse * factors[component]), *(known.specular * factors[component]), known.roughness]
    materials = Materials.of_vector(rows.reshape(-1))
    lights = [_light(problem, block, earlier, names, factors, materials, cells) for block in blocks]
    return Point(materials, lights)


def _whole(earlier: Earlier, name: str) -> Float[np.ndarray, "3"]:
    known = earlier.table.materials[name]
    return np.array(known.diffuse) + np.array(known.specular)


def _light(
    problem: JointProblem,
    block: Block,
    earlier: Earlier,
    names: Sequence[str],
    factors: dict[int, np.ndarray],
    materials: Materials,
    cells: int,
) -> Light:
    """The earlier light of a block in the block's unit and the start's gauge, or a constant one."""
    constant = constant_light(block, materials, cells)
    components = [earlier.table.gauge.component.get(names[m], -1) for m in np.unique(block.material)]
    known, lobes = [c for c in components if c in factors], earlier.lights.get(block.name)
    exposure = np.array([np.log(np.mean(earlier.exposures.get(photo, (np.nan,) * 3))) for photo in block.photos])
    if not known or not lobes or np.isnan(exposure).all():
        return constant
    factor = factors[max(set(known), key=lambda c: (known.count(c), -c))]
    new = np.isnan(exposure)
    level = np.mean(exposure[~new] - constant.log_exposure[~new])
    exposure = np.where(new, constant.log_exposure + level, exposure)
    tone = [earlier.table.model.tone[photo].exponent for photo in block.photos if photo in earlier.table.model.tone]
    light = Light(
        lobes.axis / np.linalg.norm(lobes.axis, axis=1, keepdims=True),
        np.log(np.maximum(lobes.sharpness, SHARPNESS[0])),
        np.maximum(lobes.weight, 0) / block.unit / factor * np.exp(exposure[0]),
        exposure - exposure[0],
        np.log(np.clip(tone, *TONE)) if len(tone) == len(block.photos) else np.zeros(0),
    )
    loss = [_loss(problem, block, one, materials) for one in (light, constant)]
    if loss[0] <= loss[1]:
        return light
    log.warning(
        "illumination '%s' starts anew: what the earlier solution says of it explains less than a constant light", block.name
    )
    return constant


def _loss(problem: JointProblem, block: Block, light: Light, materials: Materials) -> float:
    return float(Illumination(block, light, materials, problem.operator).losses(problem.loss).mean())
