"""Rounds of the bundle solver, which find the lobes.

    round:  insert up to `insert` lobes per illumination (insertion), refit the weights (weights),
            descend on all unknowns (descent), look for a better roughness (roughness), prune, fix the gauge
            (all on a sample of the observations, which finds the lobes as well as all of them do)
    best:   a round becomes the best if its held-out loss is lower than the best one's by `least_gain` and by `LEAST_DECREASE`
    chosen: the last round whose held-out loss is above the best one's by no more than the standard error of their difference,
            observation by observation.  Where held-out observations cannot tell two rounds apart, the fitted ones do, which the
            later round explains better; the least of two losses that are equal up to noise would be rounding's choice
    stop:   when `PATIENCE` rounds in a row neither become the best nor halve the fitted loss (a few held-out pixels are noisy
            evidence), at `lobes` lobes per light, or after `rounds`; after `ENOUGH` of them, where lights may follow a prior and a
            further round is not expected to explain held-out pixels so well that they need none
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from factorlib.solve.descent import Descent, descend
from factorlib.solve.history import Event, Recorder, Run
from factorlib.solve.insertion import blurred, candidates, lobes_inserted, pruned
from factorlib.solve.iterate import Iterate, evaluate, fit_weights
from factorlib.solve.options import Bundle
from factorlib.solve.roughness import materials_of_best_roughness
from factorlib.solve.start import starting_light, starting_materials
from factorlib.solve.thresholds import ENOUGH, FAR_BEHIND, HALVED, HOPEFUL, LEAST_DECREASE, WELL_EXPLAINED

A_LOBE = 60  # observations for each lobe of a light, so that lobes do not fit noise
ROBUST = 2.0  # standard deviations: larger residuals are features of the light that few lobes cannot show
LEAST_ROBUST_SCALE = 0.02
PATIENCE = 2  # rounds in a row without gain, after which no further one is tried


class Start(msgspec.Struct, frozen=True):
    """Where the rounds start, and what is decided before them.

    point       gives materials and lights for a problem
    decided     materials for which it is decided whether they have a specular part;  lambertian: those of them that have none
    converged   the point is an earlier solution: it counts as a round, and only one more is made
    """

    point: Callable[[JointProblem, Bundle], Point]
    decided: Bool[np.ndarray, " m"]
    lambertian: Bool[np.ndarray, " m"]
    converged: bool = False


def from_nothing(materials: int) -> Start:
    """Materials 0 … `materials`−1 and lights from mean radiances alone, nothing decided."""

    def point(problem: JointProblem, bundle: Bundle) -> Point:
        """Materials whose diffuse part explains mean radiances, one broad lobe a light."""
        start = starting_materials(problem.blocks, materials, bundle.start_specular_share, bundle.start_roughness)
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

    def held_out_at(self, number: int) -> float:
        """The held-out loss of round `number`; if there were fewer rounds, that of the chosen one."""
        rounds = [event.held_out for event in self.history if event.phase == "round"]
        return rounds[number] if number < len(rounds) else self.held_out


def chosen_round(problem: JointProblem, start: Start, run: Run, part: str = "rounds", rivals: Sequence[Fit] = ()) -> Fit:
    """Rounds on a sample of the observations, until they gain nothing or a rival was far better at the same round.

    part: the name by which the journal keeps them
    """
    if start.converged:
        run = msgspec.structs.replace(run, options=msgspec.structs.replace(run.options, rounds=1))
    rounds = run.journal.kept(part, Rounds)
    for event in rounds.history if rounds else ():
        run.report(event)
    return _fit_of(problem, rounds or run.journal.keep(part, _before_rounds(problem, start, run.options)), run, part, rivals)


def further_rounds(problem: JointProblem, fit: Fit, start: Point, run: Run, part: str = "further rounds") -> Fit:
    """Further rounds from `start` in place of the fit's point."""
    rounds = run.journal.kept(part, Rounds)
    if not rounds:
        held_out = sampled_for(problem, start, run.options).held_out_loss(start)
        rounds = Rounds(start, start, start, held_out, np.inf, fit.history)
        rounds = msgspec.structs.replace(rounds, over=_full(start, run.options) or rounds.done >= run.options.rounds)
    return _fit_of(problem, rounds, run, part)


def _fit_of(problem: JointProblem, rounds: Rounds, run: Run, part: str, rivals: Sequence[Fit] = ()) -> Fit:
    """All further rounds, until they are over."""
    while not rounds.over:
        rounds = run.journal.keep(part, _next_round(problem, rounds, run, rivals))
    sample = sampled_for(problem, rounds.chosen, run.options)
    return Fit(rounds.chosen, sample.held_out_loss(rounds.chosen), robust(sample, rounds.chosen), rounds.history)


def _full(point: Point, bundle: Bundle) -> bool:
    return max(map(len, point.lights)) >= bundle.lobes


def sampled_for(problem: JointProblem, point: Point, bundle: Bundle, more: int = 0, times: int = 1) -> JointProblem:
    """A sample of each block, large enough for its lobes and `more` of them; `times` as large as the least."""
    counts = [max(times * bundle.sample, A_LOBE * (len(light) + more)) for light in point.lights]
    return problem.sampled(counts, bundle.seed)


def _before_rounds(problem: JointProblem, start: Start, bundle: Bundle) -> Rounds:
    sample = problem.sampled(bundle.sample, bundle.seed)
    current = fit_weights(sample, start.point(sample, bundle)).point
    if not start.converged:
        return Rounds(current, current, current, np.inf, np.inf, [])
    reached = evaluate(sample.with_loss(robust(sample, current)), current).loss
    return Rounds(current, current, current, sample.held_out_loss(current), reached, [])


def _next_round(problem: JointProblem, rounds: Rounds, run: Run, rivals: Sequence[Fit]) -> Rounds:
    bundle, history, number = run.options, list(rounds.history), rounds.done
    sample = sampled_for(problem, rounds.current, bundle, bundle.insert)
    record = Recorder(sample, history, run).record
    fitting = sample.with_loss(robust(sample, rounds.current))
    current = with_new_lobes(fitting, rounds.current, bundle, number)
    current = descend(fitting, current, Descent(bundle.iterations, bundle.tolerance), partial(record, number, "descent"))
    current = pruned_in_gauge(fitting, _with_best_roughness(fitting, current).point)
    held_out = record(number, "round", -1, current)
    gain, error = gained(sample, rounds, current.point)
    better = gain >= max(bundle.least_gain * held_out, LEAST_DECREASE)
    halved = history[-1].loss < HALVED * rounds.fitted
    outdone = number >= 1 and any(held_out > FAR_BEHIND * rival.held_out_at(number) for rival in rivals)
    without_gain = 0 if better or halved else rounds.without_gain + 1
    needs_prior = bundle.light_prior != "none" and number + 1 >= ENOUGH and another_is_too_few(rounds.held_out, held_out)
    over = outdone or needs_prior or without_gain >= PATIENCE or _full(current.point, bundle) or number + 1 == bundle.rounds
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


def another_is_too_few(best: float, held_out: float) -> bool:
    """Whether lobes still explain badly after another round, if it lowers the held-out loss by the same factor as this one did.

    best: before this round;  held_out: after it

    >>> another_is_too_few(1.35, 0.72), another_is_too_few(2.0, 1.2), another_is_too_few(1.31, 1.18), another_is_too_few(1.2, 1.3)
    (False, True, True, True)
    """
    return min(held_out, best) ** 2 > HOPEFUL * WELL_EXPLAINED * best


def robust(problem: JointProblem, point: Point) -> Loss:
    """The problem's loss with a robust scale of `ROBUST` robust standard deviations of the current residuals, and at least
    `LEAST_ROBUST_SCALE` of the noise model's σ.

    A feature of the light that few lobes cannot show is an outlier among the residuals long before it exceeds the noise model.  With
    the noise model's scale it would bias the materials.
    """
    scale = max(ROBUST * robust_deviation(np.concatenate(problem.residuals(point))), LEAST_ROBUST_SCALE)
    return msgspec.structs.replace(problem.loss, robust_scale=scale)


def with_new_lobes(problem: JointProblem, point: Point, bundle: Bundle, number: int) -> Iterate:
    """The point with up to `insert` further lobes for each light in round `number`, and all weights fitted again."""
    seeds = [bundle.seed + 1000 * number + k for k in range(len(problem.blocks))]
    grown = partial(_grown, bundle=bundle)
    lights = list(problem.spread(grown, list(zip(problem.illuminations(point), seeds, strict=True))))
    return fit_weights(problem, Point(point.materials, lights))


def _grown(one: tuple[Illumination, int], bundle: Bundle) -> Light:
    illumination, seed = one
    count = min(bundle.insert, bundle.lobes - len(illumination.light))
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
    return evaluate(problem, in_gauge(Point(point.materials, [pruned(light) for light in point.lights]), problem.blocks))


def answer_of(problem: JointProblem, point: Point) -> Point:
    """The final point: no lobe is sharper than the materials resolve, weights fit all observations, pruned, in the gauge."""
    lights = [blurred(light, point.materials.sharpest) for light in point.lights]
    fitted = fit_weights(problem, Point(point.materials, lights)).point
    return in_gauge(Point(fitted.materials, [pruned(light) for light in fitted.lights]), problem.blocks)
