"""Rounds, which find the lobes.

round:  insert up to `insert` lobes per illumination (insertion), refit the weights (weights),
        descend on all unknowns (descent), look for a better roughness (roughness), prune, fix the gauge
        (all on a sample of the observations, which finds the lobes as well as all of them do)
best:   a round becomes the best if its held-out loss is lower than the best one's by `least_gain` and by `LEAST_DECREASE`
chosen: the last round whose held-out loss is above the best one's by no more than the standard error of their difference,
        observation by observation.  Where held-out observations cannot tell two rounds apart, the fitted ones do, which the
        later round explains better; the least of two losses that are equal up to noise would be rounding's choice
stop:   when `PATIENCE` rounds in a row neither become the best nor halve the fitted loss (a few held-out pixels are noisy
        evidence), at `lobes` lobes per light, or after `rounds`
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.model.gauge import in_gauge
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.robust import robust_deviation
from factorlib.solve.few_lobes.descent import Descent, descend
from factorlib.solve.few_lobes.history import Recorder, Run
from factorlib.solve.few_lobes.insertion import blurred, candidates, lobes_inserted, pruned
from factorlib.solve.few_lobes.iterate import Iterate, evaluate, fit_weights
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.roughness import materials_of_best_roughness
from factorlib.solve.few_lobes.start import starting_light
from factorlib.solve.few_lobes.thresholds import HALVED, LEAST_DECREASE
from factorlib.solve.history import Event
from factorlib.solve.start import starting_materials

A_LOBE = 60  # observations for each lobe of a light, so that lobes do not fit noise
ROBUST = 2.0  # standard deviations: larger residuals are features of the light that few lobes cannot show
LEAST_ROBUST_SCALE = 0.02
PATIENCE = 2  # rounds in a row without gain, after which no further one is tried


class Start(msgspec.Struct, frozen=True):
    """Where the rounds start, and what is decided before them.

    point       gives materials and lights for a problem
    decided     materials for which it is decided whether they have a specular part;  lambertian: those of them that have none
    """

    point: Callable[[JointProblem, FewLobes], Point]
    decided: Bool[np.ndarray, " m"]
    lambertian: Bool[np.ndarray, " m"]


def from_nothing(materials: int) -> Start:
    """Materials 0 … `materials`−1 and lights from mean radiances alone, nothing decided."""

    def point(problem: JointProblem, options: FewLobes) -> Point:
        """Materials whose diffuse part explains mean radiances, one broad lobe a light."""
        start = starting_materials(problem.blocks, materials, options.start_specular_share, options.start_roughness)
        return Point(start, [starting_light(block, start) for block in problem.blocks])

    return Start(point, np.zeros(materials, bool), np.zeros(materials, bool))


class Rounds(msgspec.Struct, frozen=True):
    """The state between two rounds.

    current       the point after the last round;  best: the best point so far, with its held-out loss `held_out`
    chosen        the last point that held-out observations do not tell to be worse than the best
    fitted        the fitted loss of the last round
    without_gain  how many rounds in a row have gained nothing;  over: there is no further round
    """

    current: Point
    best: Point
    chosen: Point
    held_out: float
    fitted: float
    history: list[Event]
    without_gain: int = 0
    over: bool = False

    @property
    def done(self) -> int:
        """How many rounds."""
        return sum(event.phase == "round" for event in self.history)


class Fit(msgspec.Struct, frozen=True):
    """The chosen round, its held-out loss, the loss function that its residuals ask for, and all events up to the last round."""

    point: Point
    held_out: float
    loss: Loss
    history: list[Event]


def chosen_round(problem: JointProblem, start: Start, run: Run) -> Fit:
    """Rounds on a sample of the observations, until they gain nothing."""
    rounds = run.journal.kept("rounds", Rounds)
    for event in rounds.history if rounds else ():
        run.report(event)
    rounds = rounds or run.journal.keep("rounds", _before_rounds(problem, start, run.options))
    while not rounds.over:
        rounds = run.journal.keep("rounds", _next_round(problem, rounds, run))
    sample = sampled_for(problem, rounds.chosen, run.options)
    return Fit(rounds.chosen, sample.held_out_loss(rounds.chosen), robust(sample, rounds.chosen), rounds.history)


def _full(point: Point, options: FewLobes) -> bool:
    return max(map(len, point.lights)) >= options.lobes


def sampled_for(problem: JointProblem, point: Point, options: FewLobes, more: int = 0, times: int = 1) -> JointProblem:
    """A sample of each block, large enough for its lobes and `more` of them; `times` as large as the least."""
    counts = [max(times * options.sample, A_LOBE * (len(light) + more)) for light in point.lights]
    return problem.sampled(counts, options.seed)


def _before_rounds(problem: JointProblem, start: Start, options: FewLobes) -> Rounds:
    sample = problem.sampled(options.sample, options.seed)
    current = fit_weights(sample, start.point(sample, options)).point
    return Rounds(current, current, current, np.inf, np.inf, [])


def _next_round(problem: JointProblem, rounds: Rounds, run: Run) -> Rounds:
    options, history, number = run.options, list(rounds.history), rounds.done
    sample = sampled_for(problem, rounds.current, options, options.insert)
    record = Recorder(sample, history, run).record
    fitting = sample.with_loss(robust(sample, rounds.current))
    current = with_new_lobes(fitting, rounds.current, options, number)
    current = descend(
        fitting, current, Descent(options.iterations, options.tolerance), partial(record, number, "descent")
    )
    current = pruned_in_gauge(fitting, _with_best_roughness(fitting, current).point)
    held_out = record(number, "round", -1, current)
    gain, error = gained(sample, rounds, current.point)
    better = gain >= max(options.least_gain * held_out, LEAST_DECREASE)
    halved = history[-1].loss < HALVED * rounds.fitted
    without_gain = 0 if better or halved else rounds.without_gain + 1
    over = without_gain >= PATIENCE or _full(current.point, options) or number + 1 == options.rounds
    best, least = (current.point, held_out) if better else (rounds.best, rounds.held_out)
    chosen = current.point if better or gain >= -error else rounds.chosen
    return Rounds(current.point, best, chosen, least, history[-1].loss, history, without_gain, bool(over))


def gained(sample: JointProblem, rounds: Rounds, point: Point) -> tuple[float, float]:
    """By how much the held-out loss of `point` is below the best round's, and the standard error of this difference.

    Both points are judged by the same observations; those that are hard for both tell nothing of the difference.  Infinitely, before
    there is a best round.
    """
    if np.isinf(rounds.held_out):
        return np.inf, 0.0
    best, now = (np.concatenate(sample.held_out_losses(at)) for at in (rounds.best, point))
    return float((best - now).mean()), float((best - now).std() / np.sqrt(len(now)))


def robust(problem: JointProblem, point: Point) -> Loss:
    """The problem's loss with a robust scale of `ROBUST` robust standard deviations of the current residuals, and at least
    `LEAST_ROBUST_SCALE` of the noise model's σ.

    A feature of the light that few lobes cannot show is an outlier among the residuals long before it exceeds the noise model.  With
    the noise model's scale it would bias the materials.
    """
    scale = max(ROBUST * robust_deviation(np.concatenate(problem.residuals(point))), LEAST_ROBUST_SCALE)
    return msgspec.structs.replace(problem.loss, robust_scale=scale)


def with_new_lobes(problem: JointProblem, point: Point, options: FewLobes, number: int) -> Iterate:
    """The point with up to `insert` further lobes for each light in round `number`, and all weights fitted again."""
    seeds = [options.seed + 1000 * number + k for k in range(len(problem.blocks))]
    grown = partial(_grown, options=options)
    lights = list(problem.spread(grown, list(zip(problem.illuminations(point), seeds, strict=True))))
    return fit_weights(problem, Point(point.materials, lights))


def _grown(one: tuple[Illumination, int], options: FewLobes) -> Light:
    illumination, seed = one
    count = min(options.insert, options.lobes - len(illumination.light))
    return lobes_inserted(illumination, count, candidates(illumination, seed)) if count > 0 else illumination.light


def _with_best_roughness(problem: JointProblem, current: Iterate) -> Iterate:
    """The iterate with other roughnesses, if they lower the loss of the whole sample too; else as it is."""
    materials = materials_of_best_roughness(problem, current.point)
    if (materials.roughness == current.point.materials.roughness).all():
        return current
    trial = evaluate(problem, Point(materials, current.point.lights))
    return trial if trial.loss < current.loss else current


def pruned_in_gauge(problem: JointProblem, point: Point) -> Iterate:
    """The point without lobes that have no energy, in the gauge."""
    return evaluate(
        problem, in_gauge(Point(point.materials, [pruned(light) for light in point.lights]), problem.blocks)
    )


def answer_of(problem: JointProblem, point: Point) -> Point:
    """The final point: no lobe is sharper than the materials resolve, weights fit all observations, pruned, in the gauge."""
    lights = [blurred(light, point.materials.sharpest) for light in point.lights]
    fitted = fit_weights(problem, Point(point.materials, lights)).point
    return in_gauge(Point(fitted.materials, [pruned(light) for light in fitted.lights]), problem.blocks)
