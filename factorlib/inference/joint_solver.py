"""Joint solve: one reflectance per material and one light per illumination, from all photos at once.

effects     Held-out observations choose shadows and interreflection (`factorlib.inference.model_selection`).
tone        They choose tone curves.
distances   They choose distances of lights.
materials   Materials and lights are fitted together to observations with reliable normals (`factorlib.inference.fit`).
splitting   The cells with most of each light's energy split in four while held-out observations gain.  Light sharper
            than a cell makes materials look smoother.  Suns and lamps are deeply split cells.
lights      Given the materials, lights are fitted to observations of any confidence.
suns        Each light is compared with one that has a sun in place of its brightest cells (`factorlib.inference.suns`).

Every step is a function of the previous state, and `Run` saves each state (`factorlib.inference.resume`).
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from factorlib.inference.evidence import FINER, compare, losses_of
from factorlib.inference.fit import Fit, Schedule, sure_ones
from factorlib.inference.gauge import in_gauge
from factorlib.inference.history import Solution
from factorlib.inference.materials import Point
from factorlib.inference.model_selection import (
    MUCH,
    TRIAL_CELLS,
    WORTH,
    Chosen,
    curves_chosen,
    distances_chosen,
    effects_chosen,
    gained,
    observations_of,
    observations_of_lights,
)
from factorlib.inference.options import Choices
from factorlib.inference.problem import JointProblem
from factorlib.inference.resume import Run
from factorlib.inference.start import Start, on_cells, with_known
from factorlib.inference.suns import suns_chosen
from factorlib.results.materials import Decision

MATERIALS = Schedule(lights=2, together=(5, 4))
AFTER_SPLITTING = Schedule(lights=2, together=(3, 2), estimate=False)
LIGHTS = Schedule(together=(0, 2, 2), least=0.1, given=True)
SPLIT = 24  # number of a light's cells that split at once
# Least distance between cells, degrees: the sun's width.  A cell splits only if its neighbours are twice as far.
SMALLEST = 0.5


class Asked(msgspec.Struct, frozen=True):
    """Question that a solve answers.

    Attributes:
        problem: All observations; its loss judges the held-out ones.
        start: Maker of the initial fits.
        choices: Options of the user.
        run: Runner of the fits.
    """

    problem: JointProblem
    start: Start
    choices: Choices
    run: Run

    def sure(self, state: State) -> JointProblem:
        """Return the observations with reliable normals, under the chosen effects."""
        return sure_ones(self.problem).with_effects(state.shadows.kept, state.bounces.kept)

    def all_(self, state: State) -> JointProblem:
        """Return the observations of any confidence that lights are fitted to, under the chosen effects."""
        problem = self.problem.with_effects(state.shadows.kept, state.bounces.kept)
        return problem.sampled(observations_of_lights(self.choices, state.splitting), self.choices.seed)


class State(msgspec.Struct, frozen=True):
    """State of a solve after some of its steps.

    Attributes:
        fit: Fit of the last step.
        materials: Fit of the last step that fitted materials.
        shadows: Decision on shadows.
        bounces: Decision on interreflection.
        tone: Decision on each light's tone curves.
        distances: Decision on each light's distance.
        splitting: Decision on each splitting.
        suns: Decision on each light's sun.
    """

    fit: Fit
    materials: Fit
    shadows: Decision = Decision(False)
    bounces: Decision = Decision(False)
    tone: list[Decision] = []
    distances: list[Decision] = []
    splitting: list[Decision] = []
    suns: list[Decision] = []

    def after(self, fit: Fit, **decided: Decision | list[Decision]) -> State:
        """Return the state after a step that fitted materials and lights."""
        return msgspec.structs.replace(self, fit=fit, materials=fit, **decided)


def solve(problem: JointProblem, start: Start, choices: Choices = Choices(), run: Run | None = None) -> Solution:
    """Solve the problem and return the answer, in the gauge of `factorlib.inference.gauge`.

    Args:
        problem: Observations and model.
        start: Maker of the initial fits.
        choices: Options of the user.
        run: Runner that saves states and reports events; None for one without a file.
    """
    run = run or Run()
    asked = Asked(problem, start, choices, run)
    begun = beginnings(asked)[0]
    state = run.completed(STEPS, asked, State(begun, begun))
    answer = in_gauge(state.fit.point, problem.blocks, problem.known)
    return Solution(
        Point(problem.known.put(answer.materials), answer.lights),
        run.history,
        materials=state.materials,
        lights=state.fit,
        shadows=state.shadows,
        interreflection=state.bounces,
        tone=state.tone,
        distances=state.distances,
        splitting=state.splitting,
        suns=state.suns,
    )


def beginnings(asked: Asked) -> list[Fit]:
    """Return the initial fits of the first trial, of which the best one continues."""
    sure = sure_ones(asked.problem)
    cells = min(TRIAL_CELLS, asked.choices.cells)
    begun = asked.start(sure, cells)
    return [msgspec.structs.replace(fit, point=with_known(fit.point, sure)) for fit in begun]


def choose_effects(asked: Asked, state: State) -> State:
    """Choose shadows and interreflection."""
    chosen = effects_chosen(sure_ones(asked.problem), beginnings(asked), asked.choices, asked.run.fit)
    return state.after(chosen.fit, shadows=chosen.shadows, bounces=chosen.bounces)


def choose_tone(asked: Asked, state: State) -> State:
    """Choose tone curves."""
    chosen = curves_chosen(asked.sure(state), state.fit, asked.choices, asked.run.fit)
    return state.after(chosen.fit, tone=chosen.evidence)


def choose_distances(asked: Asked, state: State) -> State:
    """Choose distances of lights."""
    chosen = distances_chosen(asked.sure(state), state.fit, asked.choices, asked.run.fit)
    return state.after(chosen.fit, distances=chosen.evidence)


def fit_materials(asked: Asked, state: State) -> State:
    """Fit materials and lights on all cells."""
    some = asked.sure(state).sampled(asked.choices.observations, asked.choices.seed)
    begun = on_cells(state.fit, asked.choices.cells, some)
    return state.after(asked.run.judged("materials and lights", some, begun, MATERIALS))


def split_cells(asked: Asked, state: State) -> State:
    """Split the cells with most energy while held-out observations gain."""
    chosen = split_while_gaining(asked.sure(state), state.fit, asked.choices, asked.run)
    return state.after(chosen.fit, splitting=chosen.evidence)


def fit_lights(asked: Asked, state: State) -> State:
    """Fit lights to observations of any confidence, materials given."""
    return msgspec.structs.replace(state, fit=asked.run.judged("lights", asked.all_(state), state.fit, LIGHTS))


def choose_suns(asked: Asked, state: State) -> State:
    """Choose suns, materials given."""
    chosen = suns_chosen(asked.all_(state), state.fit, asked.run)
    return msgspec.structs.replace(state, fit=chosen.fit, suns=chosen.evidence)


STEPS: dict[str, Callable[[Asked, State], State]] = {
    "effects": choose_effects,
    "tone": choose_tone,
    "distances": choose_distances,
    "materials": fit_materials,
    "splitting": split_cells,
    "lights": fit_lights,
    "suns": choose_suns,
}


def split_while_gaining(problem: JointProblem, fit: Fit, choices: Choices, run: Run) -> Chosen:
    """Split cells at most `Choices.splittings` times.

    A splitting is undone, and the last, unless it explains held-out observations better by more than FINER standard
    errors.  A splitting that lowers their loss by less than WORTH is kept, but is the last.  After a first splitting
    that lowers it by MUCH, the fit uses MORE times as many observations.

    Args:
        problem: Observations with reliable normals.
        fit: Fit of materials and lights.
        choices: Options of the user.
        run: Runner of the fits.
    """
    some = problem.sampled(choices.observations, choices.seed)
    evidence = []
    before = losses_of(some, fit.point)
    for number in range(0 if problem.none_held_out else choices.splittings):
        phase = f"splitting {number + 1}"
        smallest = 2 * np.radians(SMALLEST)
        lights = [one if one.held.any() else one.split(one.brightest(SPLIT, smallest)) for one in fit.point.lights]
        trial = run.judged(phase, some, fit.with_lights(lights), AFTER_SPLITTING)
        after = losses_of(some, trial.point)
        evidence.append(one := compare(before, after, FINER))
        if one.kept:
            fit = trial
            before = after
        if not gained(one, WORTH):
            break
        if number == 0 and gained(one, MUCH):
            some = problem.sampled(observations_of(choices, evidence), choices.seed)
            fit = run.judged(phase, some, fit, AFTER_SPLITTING)
            before = losses_of(some, fit.point)
    return Chosen(fit, evidence)
