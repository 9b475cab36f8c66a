"""Joint solve: one reflectance per material and one light per illumination, from all photos at once.

effects     Held-out observations choose shadows and interreflection (`factorlib.inference.model_selection`).
tone        They choose tone curves.
distances   They choose distances of lights.
materials   Materials and lights are fitted together to observations with reliable normals (`factorlib.inference.fit`).
splitting   The cells with most of each light's energy split in four while held-out observations gain.  Light sharper
            than a cell makes materials look smoother.  Suns and lamps are deeply split cells.
lights      Given the materials, lights are fitted to observations of any confidence.
suns        Each light is compared with one that has a sun in place of its brightest cells (`factorlib.inference.suns`).

Every step is a function of the previous state, and `FitRunner` saves each state (`factorlib.inference.resume`).
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from factorlib.inference.evidence import WEAKLY_FOR, compare_models, held_out_losses
from factorlib.inference.fit import Fit, FitSchedule, reliable_observations
from factorlib.inference.gauge import fix_gauge
from factorlib.inference.history import Solution
from factorlib.inference.materials import Point
from factorlib.inference.model_selection import (
    LARGE_GAIN,
    LEAST_GAIN,
    TRIAL_CELLS,
    Selection,
    gain_exceeds,
    light_observation_count,
    observation_count,
    select_distances,
    select_effects,
    select_tone_curves,
)
from factorlib.inference.options import SolveOptions
from factorlib.inference.problem import JointProblem
from factorlib.inference.resume import FitRunner
from factorlib.inference.start import Start, insert_known, refine_cells
from factorlib.inference.suns import select_suns
from factorlib.results.materials import Decision

MATERIALS = FitSchedule(lights=2, together=(5, 4))
AFTER_SPLITTING = FitSchedule(lights=2, together=(3, 2), estimate=False)
LIGHTS = FitSchedule(together=(0, 2, 2), least=0.1, given=True)
SPLIT_CELLS = 24  # number of a light's cells that split at once
# Least distance between cells, degrees: the sun's width.  A cell splits only if its neighbours are twice as far.
LEAST_SPACING_DEG = 0.5


class SolveRequest(msgspec.Struct, frozen=True):
    """Question that a solve answers.

    Attributes:
        problem: All observations; its loss judges the held-out ones.
        start: Maker of the initial fits.
        choices: Options of the user.
        run: Runner of the fits.
    """

    problem: JointProblem
    start: Start
    options: SolveOptions
    run: FitRunner

    def reliable_problem(self, state: SolveState) -> JointProblem:
        """Return the observations with reliable normals, under the chosen effects."""
        return reliable_observations(self.problem).with_effects(state.shadows.kept, state.bounces.kept)

    def light_problem(self, state: SolveState) -> JointProblem:
        """Return the observations of any confidence that lights are fitted to, under the chosen effects."""
        problem = self.problem.with_effects(state.shadows.kept, state.bounces.kept)
        return problem.subsample(light_observation_count(self.options, state.splitting), self.options.seed)


class SolveState(msgspec.Struct, frozen=True):
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

    def with_fit(self, fit: Fit, **decided: Decision | list[Decision]) -> SolveState:
        """Return the state after a step that fitted materials and lights."""
        return msgspec.structs.replace(self, fit=fit, materials=fit, **decided)


def solve(
    problem: JointProblem, start: Start, choices: SolveOptions = SolveOptions(), run: FitRunner | None = None
) -> Solution:
    """Solve the problem and return the answer, in the gauge of `factorlib.inference.gauge`.

    Args:
        problem: Observations and model.
        start: Maker of the initial fits.
        choices: Options of the user.
        run: Runner that saves states and reports events; None for one without a file.
    """
    run = run or FitRunner()
    asked = SolveRequest(problem, start, choices, run)
    begun = initial_fits(asked)[0]
    state = run.run_steps(STEPS, asked, SolveState(begun, begun))
    answer = fix_gauge(state.fit.point, problem.blocks, problem.known)
    return Solution(
        Point(problem.known.insert_into(answer.materials), answer.lights),
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


def initial_fits(asked: SolveRequest) -> list[Fit]:
    """Return the initial fits of the first trial, of which the best one continues."""
    sure = reliable_observations(asked.problem)
    cells = min(TRIAL_CELLS, asked.options.cells)
    begun = asked.start(sure, cells)
    return [msgspec.structs.replace(fit, point=insert_known(fit.point, sure)) for fit in begun]


def choose_effects(asked: SolveRequest, state: SolveState) -> SolveState:
    """Choose shadows and interreflection."""
    chosen = select_effects(reliable_observations(asked.problem), initial_fits(asked), asked.options, asked.run.fit)
    return state.with_fit(chosen.fit, shadows=chosen.shadows, bounces=chosen.bounces)


def choose_tone(asked: SolveRequest, state: SolveState) -> SolveState:
    """Choose tone curves."""
    chosen = select_tone_curves(asked.reliable_problem(state), state.fit, asked.options, asked.run.fit)
    return state.with_fit(chosen.fit, tone=chosen.evidence)


def choose_distances(asked: SolveRequest, state: SolveState) -> SolveState:
    """Choose distances of lights."""
    chosen = select_distances(asked.reliable_problem(state), state.fit, asked.options, asked.run.fit)
    return state.with_fit(chosen.fit, distances=chosen.evidence)


def fit_materials(asked: SolveRequest, state: SolveState) -> SolveState:
    """Fit materials and lights on all cells."""
    some = asked.reliable_problem(state).subsample(asked.options.observations, asked.options.seed)
    begun = refine_cells(state.fit, asked.options.cells, some)
    return state.with_fit(asked.run.fit_and_report("materials and lights", some, begun, MATERIALS))


def split_cells(asked: SolveRequest, state: SolveState) -> SolveState:
    """Split the cells with most energy while held-out observations gain."""
    chosen = split_while_gaining(asked.reliable_problem(state), state.fit, asked.options, asked.run)
    return state.with_fit(chosen.fit, splitting=chosen.evidence)


def fit_lights(asked: SolveRequest, state: SolveState) -> SolveState:
    """Fit lights to observations of any confidence, materials given."""
    return msgspec.structs.replace(
        state, fit=asked.run.fit_and_report("lights", asked.light_problem(state), state.fit, LIGHTS)
    )


def choose_suns(asked: SolveRequest, state: SolveState) -> SolveState:
    """Choose suns, materials given."""
    chosen = select_suns(asked.light_problem(state), state.fit, asked.run)
    return msgspec.structs.replace(state, fit=chosen.fit, suns=chosen.evidence)


STEPS: dict[str, Callable[[SolveRequest, SolveState], SolveState]] = {
    "effects": choose_effects,
    "tone": choose_tone,
    "distances": choose_distances,
    "materials": fit_materials,
    "splitting": split_cells,
    "lights": fit_lights,
    "suns": choose_suns,
}


def split_while_gaining(problem: JointProblem, fit: Fit, choices: SolveOptions, run: FitRunner) -> Selection:
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
    some = problem.subsample(choices.observations, choices.seed)
    evidence = []
    before = held_out_losses(some, fit.point)
    for number in range(0 if problem.none_held_out else choices.splittings):
        phase = f"splitting {number + 1}"
        smallest = 2 * np.radians(LEAST_SPACING_DEG)
        lights = [
            one if one.fixed.any() else one.split(one.brightest_cells(SPLIT_CELLS, smallest))
            for one in fit.point.lights
        ]
        trial = run.fit_and_report(phase, some, fit.with_lights(lights), AFTER_SPLITTING)
        after = held_out_losses(some, trial.point)
        evidence.append(one := compare_models(before, after, WEAKLY_FOR))
        if one.kept:
            fit = trial
            before = after
        if not gain_exceeds(one, LEAST_GAIN):
            break
        if number == 0 and gain_exceeds(one, LARGE_GAIN):
            some = problem.subsample(observation_count(choices, evidence), choices.seed)
            fit = run.fit_and_report(phase, some, fit, AFTER_SPLITTING)
            before = held_out_losses(some, fit.point)
    return Selection(fit, evidence)
