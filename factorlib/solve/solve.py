"""The joint solve: one reflectance per material and one light per illumination, from all photos at once.

    effects     shadows and bounces, tone curves and distances of lights are chosen by held-out observations (`factorlib.solve.choices`)
    materials   materials and lights are fitted together, to observations whose normals are sure (`factorlib.solve.fit`)
    splitting   the cells that hold most of each light's energy split in four, while held-out observations gain: what is sharper than a cell
                looks as if materials were smoother.  Suns and lamps are cells split deep
    lights      given the materials, lights are fitted to observations of any confidence
    suns        each light is tried with a sun in place of its brightest cells (`factorlib.solve.suns`)

Every part is a function of the one before it, and the journal keeps what is done.
"""

from __future__ import annotations

from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.light.lobes import SUN, Lobes
from factorlib.light.prior import LightPrior, read_light_prior
from factorlib.model.gauge import in_gauge
from factorlib.model.lights import Light, even_cells
from factorlib.model.materials import Point
from factorlib.model.problem import JointProblem
from factorlib.results.materials import Decision
from factorlib.solve.choices import TRIAL_CELLS, Chosen, Effects, curves_chosen, distances_chosen, effects_chosen
from factorlib.solve.evidence import AGAINST, FINER, compare, losses_of
from factorlib.solve.fit import Fit, Schedule, sure_ones
from factorlib.solve.history import Report, Solution, unreported
from factorlib.solve.options import Choices
from factorlib.solve.resume import Journal, Parts
from factorlib.solve.start import Start, with_known
from factorlib.solve.suns import WIDE, candidate, clearly_better, compared

MATERIALS = Schedule(lights=4, together=(10, 8))
AFTER_SPLITTING = Schedule(lights=2, together=(6, 4), estimate=False)
LIGHTS = Schedule(together=(0, 8, 6), least=0.1, given=True)
AROUND_SUNS = Schedule(together=(0, 8), least=0.1, given=True)
SPLIT = 24  # cells of a light that split at once
WORTH = 0.05  # of the held-out loss; after a splitting that gained 3 %, two more gained 3.6 and 1 % on data/eames, materials no better
SMALLEST = (
    0.5  # degrees between cells: the sun's width.  No cell splits that is less than twice as far from its neighbours
)


class Run(msgspec.Struct, frozen=True):
    """choices: of the user;  report: called at every point that is tried;  journal: the parts that are done already;  prior: on lights."""

    choices: Choices = Choices()
    report: Report = unreported
    journal: Journal = msgspec.field(default_factory=Journal)
    prior: LightPrior = msgspec.field(default_factory=read_light_prior)


def solve(problem: JointProblem, start: Start, run: Run | None = None) -> Solution:
    """The answer, in the gauge of `factorlib.model.gauge`; problem: all observations, its loss judges those that are held out."""
    run = run or Run()
    choices, parts, sure = run.choices, Parts(run.journal, run.report, run.prior), sure_ones(problem)
    few = min(TRIAL_CELLS, choices.cells)
    points = [with_known(point, sure) for point in start(sure, few)]
    effects = parts.part("effects", Effects, lambda: effects_chosen(sure, points, choices, parts.fit))
    problem, sure = effects.of(problem), effects.of(sure)
    curves = parts.part("tone", Chosen, lambda: curves_chosen(sure, effects.fit, choices, parts.fit))
    distances = parts.part("distances", Chosen, lambda: distances_chosen(sure, curves.fit, choices, parts.fit))
    some, all_ = (of.sampled(choices.observations, choices.seed) for of in (sure, problem))
    lights = distances.fit.point.lights  # of which an earlier solution's keep their cells
    coarse = [len(one) == few and not one.held.any() for one in lights]
    begun = distances.fit.with_lights(
        [on_cells(one, choices.cells) if again else one for one, again in zip(lights, coarse, strict=True)]
    )
    fit = parts.part("materials", Fit, lambda: parts.judged("materials and lights", some, begun, MATERIALS))
    split = parts.part("splitting", Chosen, lambda: split_while_gaining(some, fit, choices, parts))
    smooth = parts.part("lights", Fit, lambda: parts.judged("lights", all_, split.fit, LIGHTS))
    suns = parts.part("suns", Chosen, lambda: suns_chosen(all_, smooth, parts))
    lights = suns.fit
    answer = in_gauge(lights.point, problem.blocks, problem.known)
    return Solution(
        Point(problem.known.put(answer.materials), answer.lights),
        parts.history,
        problem.loss,
        lambertian=np.zeros(len(lights.point.materials), bool),
        shadows=effects.shadows,
        interreflection=effects.bounces,
        tone=curves.evidence,
        distances=distances.evidence,
        splitting=split.evidence,
        suns=suns.evidence,
        materials=split.fit,
        lights=lights,
    )


def suns_chosen(problem: JointProblem, fit: Fit, parts: Parts) -> Chosen:
    """Suns in the lights that have one (`factorlib.solve.suns`); the other lights stay as they are."""
    before = problem.illuminations(fit.point)
    tried = list(problem.spread(partial(candidate, sharpness=SUN), before))
    evidence = [Decision(bool(one.light.suns.any())) for one in before]
    if all(light is one.light for light, one in zip(tried, before, strict=True)):
        return Chosen(fit, evidence)
    trial = parts.judged("suns", problem, fit.with_lights(tried), AROUND_SUNS)
    after = problem.illuminations(trial.point)
    for k, (cells, sun) in enumerate(zip(before, after, strict=True)):
        if tried[k] is not cells.light:
            evidence[k] = clearly_better(cells, sun)
    asked = [k for k, one in enumerate(evidence) if one.kept and one.margin is not None]
    if asked:
        wide = list(problem.spread(partial(candidate, sharpness=WIDE), [before[k] for k in asked]))
        begun = Fit(Point(fit.point.materials, wide), [fit.hyperparameters[k] for k in asked])
        problem = problem.restricted(asked)
        other = problem.illuminations(parts.judged("suns", problem, begun, AROUND_SUNS).point)
        for k, one in zip(asked, other, strict=True):
            narrow = compared(one, after[k], AGAINST)
            evidence[k] = evidence[k] if narrow.kept else narrow
    lights, hyperparameters = (
        [new if one.kept else old for one, new, old in zip(evidence, *both, strict=True)]
        for both in ((trial.point.lights, fit.point.lights), (trial.hyperparameters, fit.hyperparameters))
    )
    return Chosen(msgspec.structs.replace(fit.with_lights(lights), hyperparameters=hyperparameters), evidence)


def split_while_gaining(problem: JointProblem, fit: Fit, choices: Choices, parts: Parts) -> Chosen:
    """Splitting after splitting, until there were `Choices.splittings`.  One that does not explain held-out observations better by more than
    FINER standard errors is undone and the last; one that lowers their loss by less than WORTH is kept and the last."""
    evidence, before = [], losses_of(problem, fit.point)
    for number in range(0 if problem.none_held_out else choices.splittings):
        begun = fit.with_lights([one if one.held.any() else one.split(brightest(one)) for one in fit.point.lights])
        trial = parts.judged(f"splitting {number + 1}", problem, begun, AFTER_SPLITTING)
        after = losses_of(problem, trial.point)
        evidence.append(one := compare(before, after, FINER))
        if one.kept:
            fit, before = trial, after
        if not one.kept or one.held_out_loss_without < (1 + WORTH) * one.held_out_loss_with:
            break
    return Chosen(fit, evidence)


def brightest(light: Light) -> Bool[np.ndarray, " p"]:
    """The `SPLIT` cells that hold most energy, of those whose parts are no smaller than `SMALLEST`."""
    energy = np.where(np.degrees(light.spacing) > 2 * SMALLEST, light.energy.sum(1), 0.0)
    which = np.zeros(len(light), bool)
    which[np.argsort(-energy, kind="stable")[:SPLIT]] = True
    return which & (energy > 0)


def on_cells(light: Light, count: int) -> Light:
    """Return the light on `count` cells of one size."""
    cells = even_cells(count)
    radiance = Lobes(light.axis, light.sharpness, light.weight).radiance(cells.axis)
    lobes = msgspec.structs.replace(light, axis=cells.axis, log_sharpness=np.log(cells.sharpness), weight=radiance)
    return lobes.with_log_radiance(np.log(np.maximum(radiance, 1e-12)).T)
