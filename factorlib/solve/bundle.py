"""The bundle solver: insert lobes where the residual asks, descend jointly, prune, and stop when held-out pixels do.

    round:  insert up to `insert` lobes per illumination (insertion), refit the weights (weights),
            descend on everything (descent), look for a better roughness (roughness), prune, fix the gauge
            (all on a sample of the observations, which finds the lobes as well as all of them do)
    stop:   when a round lowers the held-out loss by less than `least_gain` and does not halve the fitted one (few held-out
            pixels are a noisy vote), at `lobes` lobes per light, or after `rounds`; the best round by held-out loss is
            kept and polished on all observations.

Where observations see past something, the rounds are run with and without that (self_shadowing = auto), and what
explains the held-out pixels better is polished.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.solve.choice import Specular, matte_where_it_may_be, untried, without_specular
from factorlib.solve.descent import Descent, Solution, descend, evaluated
from factorlib.solve.gauge import in_gauge
from factorlib.solve.insertion import blurred, lobes_inserted, pruned, sharpest_told
from factorlib.solve.normal_equations import Loss, fit_loss, predicted_radiance, residuals, robust_losses
from factorlib.solve.problem import Block, of_rows, sampled
from factorlib.solve.resume import Journal
from factorlib.solve.roughness import materials_out_of_valleys
from factorlib.solve.shadowing import without_shadows
from factorlib.solve.start import starting_light, starting_materials
from factorlib.solve.tone_choice import Tone, rested, toned_where_it_pays
from factorlib.solve.unknowns import Light, Materials
from factorlib.solve.weights import refitted_weights

MANY = 4  # times `sample` observations bring the best round to rest, before all of them settle it
A_LOBE = 60  # observations for each lobe of a light, that it may not explain their noise
FAR_BEHIND = 1.25  # a model whose held-out loss is this many times a rival's at the same round is given up
HALVED = 0.5  # a round that lowers the fitted loss to this share is not the last, whatever held-out observations say


class Bundle(msgspec.Struct, frozen=True):
    """How the joint problem is solved; `lobes` and `sample` (the least observations that rounds use) are counted per illumination."""

    lobes: int = 48
    insert: int = 12
    rounds: int = 12
    iterations: int = 10
    polish: int = 20
    settle: int = 4
    sample: int = 1500
    tolerance: float = 1e-3
    least_gain: float = 0.01
    start_roughness: float = 0.4
    start_specular_share: float = 0.2
    self_shadowing: Literal["auto", "on", "off"] = "auto"
    specular: Literal["auto", "on"] = "auto"
    tone: Literal["auto", "off"] = "auto"
    loss: Loss = Loss()
    seed: int = 0


class Event(msgspec.Struct, frozen=True):
    """One accepted point: `loss` per fitted channel value, whitened (1 = explained to the noise model)."""

    round: int
    phase: str
    iteration: int
    loss: float
    held_out: float
    lobes: int


Report = Callable[[Event], None]
Snapshot = Callable[[Event, Solution], None]  # is handed every accepted point itself


def unwatched(event: Event, solution: Solution) -> None:
    """Nobody asked for snapshots."""


class Joint(msgspec.Struct, frozen=True):
    """The answer, in the gauge of `solve.gauge`: materials, one light per block, how it was reached, and the last loss.

    self_shadowing: whether visibility was used;  held_out: the held-out loss with and without it, of what was tried;
    matte: materials without specular part;  specular: what decided about each;  tone: what decided about each light's curves
    """

    solution: Solution
    history: list[Event]
    loss: Loss
    self_shadowing: bool = False
    held_out: dict[str, float] = {}
    matte: Bool[np.ndarray, "m"] | None = None
    specular: list[Specular] = []
    tone: list[Tone] = []


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
    """How far the rounds are: where they stand, the best of them and its held-out loss, the last fitted loss and its function."""

    current: Solution
    best: Solution
    held_out: float
    fitted: float
    loss: Loss
    history: list[Event]
    over: bool = False


class Chosen(msgspec.Struct, frozen=True):
    """Without needless specular parts; which materials have none, and what decided about each."""

    solution: Solution
    matte: Bool[np.ndarray, "m"]
    specular: list[Specular]


class Toned(msgspec.Struct, frozen=True):
    """With the tone curves that it needs, and what decided about each light."""

    solution: Solution
    tone: list[Tone]


class Polished(msgspec.Struct, frozen=True):
    """At rest after a phase of the polish, and all events so far."""

    solution: Solution
    history: list[Event]


class Fit(msgspec.Struct, frozen=True):
    """The best round, its held-out loss, the loss function it was fitted by, and all events up to the last round."""

    solution: Solution
    held_out: float
    loss: Loss
    history: list[Event]

    def held_out_at(self, number: int) -> float:
        """The held-out loss of a round, of the best one where there were fewer."""
        rounds = [event.held_out for event in self.history if event.phase == "round"]
        return rounds[number] if number < len(rounds) else self.held_out


def solve(
    blocks: Sequence[Block],
    materials: int,
    operator,
    bundle: Bundle,
    map_: Callable,
    report: Report,
    snapshot: Snapshot = unwatched,
    start: Start | None = None,
    journal: Journal | None = None,
) -> Joint:
    """Materials 0 … `materials`−1 and one light per block; `map_` spreads illuminations over workers.

    start: `from_nothing` unless given;  journal: what is done already, and what to keep of the rest
    """
    models, start, journal = candidates(blocks, bundle.self_shadowing), start or from_nothing(materials), journal or Journal()
    fits: dict[str, Fit] = {}
    for name, model in models.items():
        fits[name] = best_round(model, start, operator, bundle, map_, report, list(fits.values()), snapshot, journal, f"rounds {name}")
    chosen = min(fits, key=lambda name: fits[name].held_out)
    fit = fits[chosen]
    toned = with_tone_chosen(models[chosen], fit, operator, bundle, map_, journal)
    if any(of_light.kept for of_light in toned.tone):  # what the curves explain had stopped the rounds early
        fit = further_rounds(models[chosen], fit, toned.solution, operator, bundle, map_, report, snapshot, journal)
    choice = with_specular_chosen(models[chosen], fit, start, operator, bundle, map_, journal)
    fit, matte = msgspec.structs.replace(fit, solution=choice.solution), choice.matte
    solution, history = polished(models[chosen], fit, operator, bundle, map_, report, matte, snapshot, journal)
    found = solution.materials
    specular_or_none = np.where(matte[:, None], 0.0, found.specular)
    solution = msgspec.structs.replace(solution, materials=Materials(found.diffuse, specular_or_none, found.roughness))
    held_out = {name: fit.held_out for name, fit in fits.items()}
    return Joint(solution, history, fit.loss, chosen == "with", held_out, matte, choice.specular, toned.tone)


def with_tone_chosen(blocks: Sequence[Block], fit: Fit, operator, bundle: Bundle, map_: Callable, journal: Journal) -> Toned:
    """The fit nearer to rest, with a tone curve for the photos that held-out observations ask for one."""
    if kept := journal.kept("tone", Toned):
        return kept
    if not any(block.held_out.any() for block in blocks):
        return Toned(fit.solution, [])
    blocks = sampled_for(blocks, fit.solution.lights, bundle)
    at = rested(blocks, fit.solution, fit.solution.lights, operator, fit.loss, map_)
    if bundle.tone == "off":
        return journal.keep("tone", Toned(_bare(at), []))
    held = [held_out_of(blocks, k) for k in range(len(blocks))]
    losses = partial(_held_out, held=held, operator=operator, loss=bundle.loss)
    solution, evidence = toned_where_it_pays(blocks, held, at, operator, fit.loss, losses, map_)
    return journal.keep("tone", Toned(_bare(solution), evidence))


def _held_out(solution: Solution, held: Sequence[Block], operator, loss: Loss) -> Float[np.ndarray, "n"]:
    return held_out_losses(held, solution.materials, solution.lights, operator, loss)


def with_specular_chosen(
    blocks: Sequence[Block], fit: Fit, start: Start, operator, bundle: Bundle, map_: Callable, journal: Journal
) -> Chosen:
    """The fit without needless specular parts: those decided before, and those that held-out observations do not ask for."""
    if kept := journal.kept("choice", Chosen):
        return kept
    materials = fit.solution.materials
    for m in np.flatnonzero(start.matte):
        materials = without_specular(materials, m)
    before = msgspec.structs.replace(fit.solution, materials=materials)
    if bundle.specular == "on" or start.decided.all() or not any(block.held_out.any() for block in blocks):
        return journal.keep("choice", Chosen(before, start.matte, untried(start.matte) if start.decided.any() else []))
    blocks = sampled_for(blocks, before.lights, bundle)
    held = [held_out_of(blocks, k) for k in range(len(blocks))]
    losses = partial(_held_out, held=held, operator=operator, loss=bundle.loss)
    at = evaluated(blocks, materials, before.lights, operator, fit.loss, map_)
    solution, matte, evidence = matte_where_it_may_be(
        blocks, held, at, operator, fit.loss, losses, map_, decided=start.decided, matte=start.matte
    )
    return journal.keep("choice", Chosen(_bare(solution), matte, evidence))


def candidates(blocks: Sequence[Block], self_shadowing: str) -> dict[str, list[Block]]:
    """The models to choose from: `with` self-shadowing, `without`, or both.  Where nothing is hidden they are one."""
    shadows = self_shadowing != "off" and any(block.visibility is not None for block in blocks)
    models = {"without": [without_shadows(block) for block in blocks]} if not shadows or self_shadowing == "auto" else {}
    return models | ({"with": list(blocks)} if shadows else {})


def sampled_for(blocks: Sequence[Block], lights: Sequence[Light], bundle: Bundle, more: int = 0, times: int = 1) -> list[Block]:
    """A sample of each block, large enough for its lobes and `more` of them."""
    counts = [max(times * bundle.sample, A_LOBE * (len(light) + more)) for light in lights]
    return [sampled(block, count, bundle.seed) for block, count in zip(blocks, counts, strict=True)]


def _recorder(blocks: Sequence[Block], history: list[Event], operator, loss: Loss, report: Report, snapshot: Snapshot) -> Callable:
    def record(round_: int, phase: str, iteration: int, solution: Solution) -> float:
        held = held_out_loss(blocks, solution.materials, solution.lights, operator, loss) if iteration < 0 else np.nan
        fitted = sum(int((~b.held_out).sum()) * 3 for b in blocks)
        history.append(Event(round_, phase, iteration, solution.loss / fitted, held, sum(map(len, solution.lights))))
        report(history[-1])
        snapshot(history[-1], solution)
        return held

    return record


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
    return Fit(rounds.best, rounds.held_out, rounds.loss, rounds.history)


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
        rounds = Rounds(start, start, held_out, np.inf, fit.loss, fit.history)
        rounds = msgspec.structs.replace(rounds, over=_full(start.lights, bundle) or _rounds_done(rounds) >= bundle.rounds)
    while not rounds.over:
        rounds = journal.keep("further rounds", _next_round(blocks, rounds, operator, bundle, map_, report, (), snapshot))
    return Fit(rounds.best, rounds.held_out, rounds.loss, rounds.history)


def _full(lights: Sequence[Light], bundle: Bundle) -> bool:
    return max(map(len, lights)) >= bundle.lobes


def _rounds_done(rounds: Rounds) -> int:
    return sum(event.phase == "round" for event in rounds.history)


def _before_rounds(blocks: Sequence[Block], start: Start, operator, bundle: Bundle, map_: Callable) -> Rounds:
    blocks = [sampled(block, bundle.sample, bundle.seed) for block in blocks]
    materials, lights = start.point(blocks, operator, bundle, map_)
    current = evaluated(blocks, materials, lights, operator, bundle.loss, map_)
    current = _bare(_refitted(blocks, current, operator, bundle.loss, map_))
    if not start.rested:
        return Rounds(current, current, np.inf, np.inf, bundle.loss, [])
    loss = msgspec.structs.replace(bundle.loss, robust_scale=robust_scale(blocks, current, operator, bundle.loss))
    fitted = evaluated(blocks, current.materials, current.lights, operator, loss, map_).loss
    held_out = held_out_loss(blocks, current.materials, current.lights, operator, bundle.loss)
    return Rounds(current, current, held_out, fitted, loss, [])


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
    record = _recorder(blocks, history, operator, bundle.loss, report, snapshot)
    loss = msgspec.structs.replace(bundle.loss, robust_scale=robust_scale(blocks, current, operator, bundle.loss))
    current = with_new_lobes(blocks, current, operator, loss, bundle, number, map_)
    current = descend(blocks, current, operator, loss, _descent(bundle, bundle.iterations), map_, partial(record, number, "descent"))
    current = _tidied(blocks, _out_of_valleys(blocks, current, operator, loss, map_), operator, loss, map_)
    held = record(number, "round", -1, current)
    gained, halved = rounds.held_out - held, history[-1].loss < HALVED * rounds.fitted
    outdone = number >= 1 and any(held > FAR_BEHIND * rival.held_out_at(number) for rival in rivals)
    enough = (gained < bundle.least_gain * held and not halved) or _full(current.lights, bundle)
    best = current if gained > 0 else rounds.best
    over = outdone or enough or number + 1 == bundle.rounds
    return Rounds(_bare(current), _bare(best), min(held, rounds.held_out), history[-1].loss, loss, history, bool(over))


def polished(
    blocks: Sequence[Block],
    fit: Fit,
    operator,
    bundle: Bundle,
    map_: Callable,
    report: Report,
    matte=None,
    snapshot: Snapshot = unwatched,
    journal: Journal | None = None,
) -> tuple[Solution, list[Event]]:
    """The best round brought to rest on many observations, then on all, and the whole history."""
    everything = [msgspec.structs.replace(b, held_out=np.zeros(len(b), bool)) for b in blocks]
    many = sampled_for(everything, fit.solution.lights, bundle, times=MANY)
    number, loss, journal = fit.history[-1].round, fit.loss, journal or Journal()
    phases = [(many, bundle.polish), (everything, min(bundle.settle, bundle.polish))]
    at = Polished(fit.solution, fit.history)
    for phase, (of, iterations) in enumerate(phases if sum(map(len, many)) < sum(map(len, everything)) else phases[:1]):
        if kept := journal.kept(f"polish {phase}", Polished):
            at = kept
            continue
        history = list(at.history)
        record = _recorder(of, history, operator, loss, report, snapshot)
        best = evaluated(of, at.solution.materials, at.solution.lights, operator, loss, map_)
        best = descend(of, best, operator, loss, _descent(bundle, iterations), map_, partial(record, number, "polish"), matte)
        at = journal.keep(f"polish {phase}", Polished(_bare(best), history))
    return _tidied(everything, at.solution, operator, loss, map_), at.history


def _bare(solution: Solution) -> Solution:
    """Without its systems, which follow from the rest and are large."""
    return Solution(solution.materials, solution.lights, [])


def held_out_loss(blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator, loss: Loss) -> float:
    """Mean robust loss per held-out channel value; of all values where none is held out."""
    losses = held_out_losses([held_out_of(blocks, k) for k in range(len(blocks))], materials, lights, operator, loss)
    return float(losses.mean()) if len(losses) else 0.0


def held_out_of(blocks: Sequence[Block], k: int) -> Block:
    """What is held out of block k; all of it where nothing is held out of any."""
    none = not any(block.held_out.any() for block in blocks)
    return of_rows(blocks[k], blocks[k].held_out | none)


def held_out_losses(
    blocks: Sequence[Block], materials: Materials, lights: Sequence[Light], operator, loss: Loss
) -> Float[np.ndarray, "n"]:
    """Robust loss of every observation, mean over its channels, block by block."""
    residual = [residuals(b, predicted_radiance(b, light, materials, operator)) for b, light in zip(blocks, lights, strict=True)]
    return robust_losses(np.concatenate(residual), loss.robust_scale).mean(1)


def _descent(bundle: Bundle, iterations: int) -> Descent:
    return Descent(iterations, bundle.tolerance)


def robust_scale(blocks: Sequence[Block], solution: Solution, operator, loss: Loss) -> float:
    """Three robust standard deviations of the current residual, never below one σ of the noise model."""
    absolute = [
        np.abs(residuals(b, predicted_radiance(b, light, solution.materials, operator)))
        for b, light in zip(blocks, solution.lights, strict=True)
    ]
    return max(3 * 1.4826 * float(np.median(np.concatenate(absolute))), 1.0)


def with_new_lobes(blocks, current: Solution, operator, loss: Loss, bundle: Bundle, number: int, map_: Callable) -> Solution:
    seeds = [bundle.seed + 1000 * number + k for k in range(len(blocks))]
    grown = partial(_grown, materials=current.materials, operator=operator, bundle=bundle)
    lights = list(map_(grown, list(zip(blocks, current.lights, seeds, strict=True))))
    return _refitted(blocks, evaluated(blocks, current.materials, lights, operator, loss, map_), operator, loss, map_)


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


def _tidied(blocks, current: Solution, operator, loss: Loss, map_: Callable) -> Solution:
    """Pruned, no sharper than the materials can tell, and in gauge."""
    sharpest = sharpest_told(current.materials)
    materials, lights = in_gauge(current.materials, [blurred(pruned(light), sharpest) for light in current.lights], blocks)
    return evaluated(blocks, materials, lights, operator, loss, map_)


def _refitted(blocks, current: Solution, operator, loss: Loss, map_: Callable) -> Solution:
    lights = []
    for block, light, equations in zip(blocks, current.lights, current.systems, strict=True):
        refitted = refitted_weights(light, equations)
        better = fit_loss(block, refitted, current.materials, operator, loss) <= equations.loss
        lights.append(refitted if better else light)
    return evaluated(blocks, current.materials, lights, operator, loss, map_)
