"""Rounds, which find the lobes.

round:  insert up to `insert` lobes per illumination (insertion), refit the weights,
        descend on all unknowns (descent), look for a better roughness (roughness), prune, fix the gauge
        (all on a sample of the observations, which finds the lobes as well as all of them do)
best:   a round becomes the best if its held-out loss is lower than the best one's by the share `LEAST_GAIN` and by `LEAST_DECREASE`
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

from factorlib.model.gauge import in_gauge
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Point
from factorlib.model.noise import Loss
from factorlib.model.problem import JointProblem
from factorlib.robust import robust_deviation
from factorlib.solve.few_lobes.descent import Iterate, descend, evaluate, fit_weights
from factorlib.solve.few_lobes.insertion import candidates, lobes_inserted
from factorlib.solve.few_lobes.roughness import materials_of_best_roughness
from factorlib.solve.few_lobes.unknowns import pruned, starting_light
from factorlib.solve.history import Event, Report
from factorlib.solve.options import FewLobes
from factorlib.solve.start import starting_materials

A_LOBE = 60  # observations for each lobe of a light, so that lobes do not fit noise
ROBUST = 2.0  # standard deviations: larger residuals are features of the light that few lobes cannot show
LEAST_ROBUST_SCALE = 0.02
TOLERANCE = 1e-3  # a descent stops after two steps that lower the loss by less than this share of it
LEAST_GAIN = 0.01  # share of the held-out loss
PATIENCE = 2  # rounds in a row without gain, after which no further one is tried
LEAST_DECREASE = 0.005  # of the held-out loss, in σ² of the noise model: a smaller decrease is the operator's error
# A round that lowers the fitted loss to this share is not the last: few held-out observations are a noisy vote.
HALVED = 0.5


Record = Callable[[int, Iterate], None]  # called with the number of an iteration, and where it led


class ChosenRound(msgspec.Struct, frozen=True):
    """The chosen round, the loss function that its residuals ask for, and all events up to the last round."""

    point: Point
    loss: Loss
    history: list[Event]


def recorder(problem: JointProblem, history: list[Event], report: Report, number: int, phase: str) -> Record:
    """What appends the events of a round to `history` and reports them, with the held-out loss at a round's end (iteration −1)."""

    def record(iteration: int, iterate: Iterate) -> None:
        """Record an iterate."""
        held_out = problem.held_out_loss(iterate.point) if iteration < 0 else np.nan
        loss, lobes = iterate.loss / problem.fitted_values, sum(map(len, iterate.point.lights))
        history.append(Event(number, "round" if iteration < 0 else phase, iteration, loss, held_out, lobes))
        report(history[-1])

    return record


def chosen_round(problem: JointProblem, materials: int, options: FewLobes, report: Report) -> ChosenRound:
    """Rounds on a sample of the observations, until they gain nothing."""
    history, sample = list[Event](), problem.sampled(options.sample, options.seed)
    start = starting_materials(sample.blocks, materials)
    current = fit_weights(sample, Point(start, [starting_light(block, start) for block in sample.blocks])).point
    best = chosen = current
    least, fitted, without_gain = np.inf, np.inf, 0
    for number in range(options.rounds):
        sample = sampled_for(problem, current, options, options.insert)
        current = round_after(sample, current, options, recorder(sample, history, report, number, "descent"), number)
        held_out, loss = history[-1].held_out, history[-1].loss
        gain, error = gained(sample, None if np.isinf(least) else best, current)
        better = gain >= max(LEAST_GAIN * held_out, LEAST_DECREASE)
        without_gain = 0 if better or loss < HALVED * fitted else without_gain + 1
        best, least, fitted = current if better else best, held_out if better else least, loss
        chosen = current if better or gain >= -error else chosen
        if without_gain >= PATIENCE or max(map(len, current.lights)) >= options.lobes:
            break
    return ChosenRound(chosen, robust(sampled_for(problem, chosen, options), chosen), history)


def sampled_for(problem: JointProblem, point: Point, options: FewLobes, more: int = 0, times: int = 1) -> JointProblem:
    """A sample of each block, large enough for its lobes and `more` of them; `times` as large as the least."""
    counts = [max(times * options.sample, A_LOBE * (len(light) + more)) for light in point.lights]
    return problem.sampled(counts, options.seed)


def round_after(sample: JointProblem, point: Point, options: FewLobes, record: Record, number: int) -> Point:
    """The point after one round, which is recorded."""
    fitting = sample.with_loss(robust(sample, point))
    current = with_new_lobes(fitting, point, options, number)
    current = descend(fitting, current, options.iterations, TOLERANCE, record)
    materials = materials_of_best_roughness(fitting, current.point)
    if (
        materials.roughness != current.point.materials.roughness
    ).any():  # does that lower the loss of the whole sample?
        current = min(current, evaluate(fitting, Point(materials, current.point.lights)), key=lambda one: one.loss)
    lights = [pruned(light) for light in current.point.lights]
    current = evaluate(fitting, in_gauge(Point(current.point.materials, lights), fitting.blocks))
    record(-1, current)
    return current.point


def gained(sample: JointProblem, best: Point | None, point: Point) -> tuple[float, float]:
    """Return by how much the held-out loss of `point` is below the best round's, and the standard error of this difference.

    Both points are judged by the same observations; those that are hard for both tell nothing of the difference.  Infinitely, before
    there is a best round.
    """
    if best is None:
        return np.inf, 0.0
    before, now = (np.concatenate(sample.held_out_losses(at)) for at in (best, point))
    return float((before - now).mean()), float((before - now).std() / np.sqrt(len(now)))


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
