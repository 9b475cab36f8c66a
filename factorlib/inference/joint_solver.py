"""The joint solve: one reflectance per material and one light per illumination, from all photos at once.

    effects     shadows and bounces, tone curves and distances of lights are chosen by held-out observations (`factorlib.inference.model_selection`)
    materials   materials and lights are fitted together, to observations whose normals are sure (`factorlib.inference.fit`)
    splitting   the cells that hold most of each light's energy split in four, while held-out observations gain: what is sharper than a cell
                looks as if materials were smoother.  Suns and lamps are cells split deep
    lights      given the materials, lights are fitted to observations of any confidence
    suns        each light is tried with a sun in place of its brightest cells (`factorlib.inference.suns`)

Every part is a function of the one before it, and is kept once it is done (`factorlib.inference.resume`).
"""

from __future__ import annotations

import numpy as np

from factorlib.inference.evidence import FINER, compare, losses_of
from factorlib.inference.fit import Fit, Schedule, sure_ones
from factorlib.inference.gauge import in_gauge
from factorlib.inference.history import Solution
from factorlib.inference.materials import Point
from factorlib.inference.model_selection import (
    TRIAL_CELLS,
    Chosen,
    Effects,
    curves_chosen,
    distances_chosen,
    effects_chosen,
)
from factorlib.inference.options import Choices
from factorlib.inference.problem import JointProblem
from factorlib.inference.resume import Parts
from factorlib.inference.start import Start, on_cells, with_known
from factorlib.inference.suns import suns_chosen

MATERIALS = Schedule(lights=3, together=(6, 4))
AFTER_SPLITTING = Schedule(lights=2, together=(3, 2), estimate=False)
LIGHTS = Schedule(together=(0, 3, 2), least=0.1, given=True)
SPLIT = 24  # cells of a light that split at once
WORTH = 0.05  # of the held-out loss; after a splitting that gained 3 %, two more gained 3.6 and 1 % on data/eames, materials no better
# Degrees between cells: the sun's width.  No cell splits that is less than twice as far from its neighbours.
SMALLEST = 0.5


def solve(problem: JointProblem, start: Start, choices: Choices = Choices(), parts: Parts | None = None) -> Solution:
    """The answer, in the gauge of `factorlib.inference.gauge`.

    problem: all observations, its loss judges those that are held out;  parts: those that are done already, and who is told
    """
    parts, sure = parts or Parts(), sure_ones(problem)
    points = [with_known(point, sure) for point in start(sure, min(TRIAL_CELLS, choices.cells))]
    effects = parts.part("effects", Effects, lambda: effects_chosen(sure, points, choices, parts.fit))
    problem, sure = effects.of(problem), effects.of(sure)
    curves = parts.part("tone", Chosen, lambda: curves_chosen(sure, effects.fit, choices, parts.fit))
    distances = parts.part("distances", Chosen, lambda: distances_chosen(sure, curves.fit, choices, parts.fit))
    some, all_ = (of.sampled(choices.observations, choices.seed) for of in (sure, problem))
    begun = on_cells(distances.fit, choices.cells, some)
    fit = parts.part("materials", Fit, lambda: parts.judged("materials and lights", some, begun, MATERIALS))
    split = parts.part("splitting", Chosen, lambda: split_while_gaining(some, fit, choices, parts))
    smooth = parts.part("lights", Fit, lambda: parts.judged("lights", all_, split.fit, LIGHTS))
    suns = parts.part("suns", Chosen, lambda: suns_chosen(all_, smooth, parts))
    answer = in_gauge(suns.fit.point, problem.blocks, problem.known)
    return Solution(
        Point(problem.known.put(answer.materials), answer.lights),
        parts.history,
        problem.loss,
        shadows=effects.shadows,
        interreflection=effects.bounces,
        tone=curves.evidence,
        distances=distances.evidence,
        splitting=split.evidence,
        suns=suns.evidence,
        materials=split.fit,
        lights=suns.fit,
    )


def split_while_gaining(problem: JointProblem, fit: Fit, choices: Choices, parts: Parts) -> Chosen:
    """Splitting after splitting, until there were `Choices.splittings`.  One that does not explain held-out observations better by more than
    FINER standard errors is undone and the last; one that lowers their loss by less than WORTH is kept and the last."""
    evidence, before = [], losses_of(problem, fit.point)
    for number in range(0 if problem.none_held_out else choices.splittings):
        smallest = 2 * np.radians(SMALLEST)
        lights = [one if one.held.any() else one.split(one.brightest(SPLIT, smallest)) for one in fit.point.lights]
        trial = parts.judged(f"splitting {number + 1}", problem, fit.with_lights(lights), AFTER_SPLITTING)
        after = losses_of(problem, trial.point)
        evidence.append(one := compare(before, after, FINER))
        if one.kept:
            fit, before = trial, after
        if not one.kept or one.held_out_loss_without < (1 + WORTH) * one.held_out_loss_with:
            break
    return Chosen(fit, evidence)
