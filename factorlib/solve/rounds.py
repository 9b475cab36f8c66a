"""Rounds of the bundle solver, which find the lobes.

    round:  insert up to `insert` lobes per illumination (insertion), refit the weights (weights),
            descend on everything (descent), look for a better roughness (roughness), prune, fix the gauge
            (all on a sample of the observations, which finds the lobes as well as all of them do)
    best:   the last round that lowered the best one's held-out loss by `least_gain` of it, and by `LEAST_GAIN`
    stop:   when `PATIENCE` rounds in a row are not the best and do not halve the fitted loss (few held-out pixels are a noisy
            vote), at `lobes` lobes per light, or after `rounds`
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.solve.descent import Descent, Solution, descend, evaluated, fitted
from factorlib.solve.gauge import in_gauge
from factorlib.solve.held_out import held_out_loss
from factorlib.solve.history import Event, Report, Snapshot, recorder, unwatched
from factorlib.solve.insertion import blurred, lobes_inserted, pruned
from factorlib.solve.normal_equations import Loss, predicted_radiance, residuals
from factorlib.solve.options import Bundle
from factorlib.solve.problem import Block, sampled
from factorlib.solve.resume import Journal
from factorlib.solve.roughness import materials_out_of_valleys
from factorlib.solve.start import starting_light, starting_materials
from factorlib.solve.unknowns import Light, Materials

A_LOBE = 60  # observations for each lobe of a light, that it may not explain their noise
FAR_BEHIND = 1.25  # a model whose held-out loss is this many times a rival's at the same round is given up
ROBUST = 2.0  # standard deviations: beyond lies what a light of few lobes cannot show
LEAST_SCALE = 0.02
PATIENCE = 2  # rounds that may gain nothing
LEAST_GAIN = 0.005  # σ² of the noise model: what explains less is the operator's error, not the light
HALVED = 0.5  # a round that lowers the fitted loss to this share is not the last, whatever held-out observations say


class Start(msgspec.Struct, frozen=True):
    """Where the rounds start, and what is decided before them.

    point: materials and lights for the given blocks;  decided: materials whose specular part is not tried;
    matte: those of them that have none;  rested: the point counts as a round, and another follows only where one halves a loss
    """

    point: Callable[[Sequence[Block], object, Bundle, Callable], tuple[Materials, list[Light]]]
    decided: Bool[np.ndarray, "m"]
    matte: Bool[np.ndarray, "m"]
    rested: bool = False


def from_nothing(materials: int) -> Start:
    """Mean radiances alone, nothing decided."""

    def point(blocks: Sequence[Block], operator, bundle: Bundle, map_: Callable) -> tuple[Materials, list[Light]]:
        start = starting_materials(blocks, materials, bundle.start_specular_share, bundle.start_roughness)
        return start, [starting_light(block, start) for block in blocks]

    return Start(point, np.zeros(materials, bool), np.zeros(materials, bool))


class Rounds(msgspec.Struct, frozen=True):
    """How far the rounds are: where they stand, the best of them and its held-out loss, and the last fitted loss.

    idle: how many rounds in a row have gained nothing
    """

    current: Solution
    best: Solution
    held_out: float
    fitted: float
    history: list[Event]
    idle: int = 0
    over: bool = False


class Fit(msgspec.Struct, frozen=True):
    """The best round, its held-out loss, the loss function that its residuals ask for, and all events up to the last round."""

    solution: Solution
    held_out: float
    loss: Loss
    history: list[Event]

    def held_out_at(self, number: int) -> float:
        """The held-out loss of a round, of the best one where there were fewer."""
        rounds = [event.held_out for event in self.history if event.phase == "round"]
        return rounds[number] if number < len(rounds) else self.held_out


def best_round(
    blocks: Sequence[Block],
    start: Start,
    operator,
    bundle: Bundle,
    map_: Callable,
    report: Report,
    rivals: Sequence[Fit] = (),
    snapshot: Snapshot = unwatched,
    journal: Journal | None = None,
    part: str = "rounds",
) -> Fit:
    """Rounds on a sample of the observations, as long as they gain, and no rival was far ahead at the same round."""
    journal = journal or Journal()
    bundle = msgspec.structs.replace(bundle, rounds=1) if start.rested else bundle
    rounds = journal.kept(part, Rounds)
    for event in rounds.history if rounds else ():
        report(event)
    rounds = rounds or journal.keep(part, _before_rounds(blocks, start, operator, bundle, map_))
    while not rounds.over:
        rounds = journal.keep(part, _next_round(blocks, rounds, operator, bundle, map_, report, rivals, snapshot))
    return _fit(blocks, rounds, operator, bundle)


def further_rounds(
    blocks: Sequence[Block],
    fit: Fit,
    start: Solution,
    operator,
    bundle: Bundle,
    map_: Callable,
    report: Report,
    snapshot: Snapshot,
    journal: Journal,
) -> Fit:
    """Rounds that go on from another solution than the fit's best, as if they had found it."""
    rounds = journal.kept("further rounds", Rounds)
    if not rounds:
        held_out = held_out_loss(sampled_for(blocks, start.lights, bundle), start.materials, start.lights, operator, bundle.loss)
        rounds = Rounds(start, start, held_out, np.inf, fit.history)
        rounds = msgspec.structs.replace(rounds, over=_full(start.lights, bundle) or _rounds_done(rounds) >= bundle.rounds)
    while not rounds.over:
        rounds = journal.keep("further rounds", _next_round(blocks, rounds, operator, bundle, map_, report, (), snapshot))
    return _fit(blocks, rounds, operator, bundle)


def _fit(blocks: Sequence[Block], rounds: Rounds, operator, bundle: Bundle) -> Fit:
    loss = robust(sampled_for(blocks, rounds.best.lights, bundle), rounds.best, operator, bundle.loss)
    return Fit(rounds.best, rounds.held_out, loss, rounds.history)


def _full(lights: Sequence[Light], bundle: Bundle) -> bool:
    return max(map(len, lights)) >= bundle.lobes


def _rounds_done(rounds: Rounds) -> int:
    return sum(event.phase == "round" for event in rounds.history)


def sampled_for(blocks: Sequence[Block], lights: Sequence[Light], bundle: Bundle, more: int = 0, times: int = 1) -> list[Block]:
    """A sample of each block, large enough for its lobes and `more` of them."""
    counts = [max(times * bundle.sample, A_LOBE * (len(light) + more)) for light in lights]
    return [sampled(block, count, bundle.seed) for block, count in zip(blocks, counts, strict=True)]


def _before_rounds(blocks: Sequence[Block], start: Start, operator, bundle: Bundle, map_: Callable) -> Rounds:
    blocks = [sampled(block, bundle.sample, bundle.seed) for block in blocks]
    materials, lights = start.point(blocks, operator, bundle, map_)
    current = bare(fitted(blocks, materials, lights, operator, bundle.loss, map_))
    if not start.rested:
        return Rounds(current, current, np.inf, np.inf, [])
    loss = robust(blocks, current, operator, bundle.loss)
    reached = evaluated(blocks, current.materials, current.lights, operator, loss, map_).loss
    held_out = held_out_loss(blocks, current.materials, current.lights, operator, bundle.loss)
    return Rounds(current, current, held_out, reached, [])


def _next_round(
    blocks: Sequence[Block],
    rounds: Rounds,
    operator,
    bundle: Bundle,
    map_: Callable,
    report: Report,
    rivals: Sequence[Fit],
    snapshot: Snapshot,
) -> Rounds:
    history, current = list(rounds.history), rounds.current
    number = _rounds_done(rounds)
    blocks = sampled_for(blocks, current.lights, bundle, bundle.insert)
    record = recorder(blocks, history, operator, bundle.loss, report, snapshot)
    loss = robust(blocks, current, operator, bundle.loss)
    current = with_new_lobes(blocks, current, operator, loss, bundle, number, map_)
    current = descend(blocks, current, operator, loss, descent_of(bundle, bundle.iterations), map_, partial(record, number, "descent"))
    current = tidied(blocks, _out_of_valleys(blocks, current, operator, loss, map_), operator, loss, map_)
    held = record(number, "round", -1, current)
    better = rounds.held_out - held >= max(bundle.least_gain * held, LEAST_GAIN)
    halved = history[-1].loss < HALVED * rounds.fitted
    outdone = number >= 1 and any(held > FAR_BEHIND * rival.held_out_at(number) for rival in rivals)
    idle = 0 if better or halved else rounds.idle + 1
    enough = idle >= PATIENCE or _full(current.lights, bundle)
    best, least = (current, held) if better else (rounds.best, rounds.held_out)
    over = outdone or enough or number + 1 == bundle.rounds
    return Rounds(bare(current), bare(best), least, history[-1].loss, history, idle, bool(over))


def robust(blocks: Sequence[Block], solution: Solution, operator, loss: Loss) -> Loss:
    """The loss with `ROBUST` robust standard deviations of the current residual as its scale, at least `LEAST_SCALE` of the noise model's σ.

    What a light of few lobes cannot show stands out from the rest long before it exceeds the noise model, and bends the materials.
    """
    absolute = [
        np.abs(residuals(b, predicted_radiance(b, light, solution.materials, operator)))
        for b, light in zip(blocks, solution.lights, strict=True)
    ]
    scale = max(ROBUST * 1.4826 * float(np.median(np.concatenate(absolute))), LEAST_SCALE)
    return msgspec.structs.replace(loss, robust_scale=scale)


def with_new_lobes(blocks, current: Solution, operator, loss: Loss, bundle: Bundle, number: int, map_: Callable) -> Solution:
    seeds = [bundle.seed + 1000 * number + k for k in range(len(blocks))]
    grown = partial(_grown, materials=current.materials, operator=operator, bundle=bundle)
    lights = list(map_(grown, list(zip(blocks, current.lights, seeds, strict=True))))
    return fitted(blocks, current.materials, lights, operator, loss, map_)


def _grown(one: tuple[Block, Light, int], materials: Materials, operator, bundle: Bundle) -> Light:
    block, light, seed = one
    count = min(bundle.insert, bundle.lobes - len(light))
    return lobes_inserted(block, light, materials, operator, count, seed) if count > 0 else light


def _out_of_valleys(blocks, current: Solution, operator, loss: Loss, map_: Callable) -> Solution:
    """With another roughness where that lowers the loss of the whole sample, too."""
    materials = materials_out_of_valleys(blocks, current.materials, current.lights, operator, loss, map_)
    if (materials.roughness == current.materials.roughness).all():
        return current
    trial = evaluated(blocks, materials, current.lights, operator, loss, map_)
    return trial if trial.loss < current.loss else current


def tidied(blocks, current: Solution, operator, loss: Loss, map_: Callable) -> Solution:
    """Pruned, and in gauge."""
    materials, lights = in_gauge(current.materials, [pruned(light) for light in current.lights], blocks)
    return evaluated(blocks, materials, lights, operator, loss, map_)


def answer_of(blocks, current: Solution, operator, loss: Loss, map_: Callable) -> Solution:
    """Pruned, no lobe sharper than the materials can tell, in gauge, the weights those that fit all observations best."""
    lights = [blurred(light, current.materials.sharpest) for light in current.lights]
    at = fitted(blocks, current.materials, lights, operator, loss, map_)
    return Solution(*in_gauge(at.materials, [pruned(light) for light in at.lights], blocks), [])


def bare(solution: Solution) -> Solution:
    """Without its systems, which follow from the rest and are large."""
    return Solution(solution.materials, solution.lights, [])


def descent_of(bundle: Bundle, iterations: int) -> Descent:
    return Descent(iterations, bundle.tolerance)
