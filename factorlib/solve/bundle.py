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

from factorlib.solve.choice import Specular, matte_where_it_may_be
from factorlib.solve.descent import Descent, Solution, descend, evaluated
from factorlib.solve.gauge import in_gauge
from factorlib.solve.insertion import blurred, lobes_inserted, pruned, sharpest_told
from factorlib.solve.normal_equations import Loss, fit_loss, predicted_radiance, residuals, robust_losses
from factorlib.solve.problem import Block, of_rows, sampled
from factorlib.solve.roughness import materials_out_of_valleys
from factorlib.solve.shadowing import without_shadows
from factorlib.solve.start import starting_light, starting_materials
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
    tolerance: float = 1e-4
    least_gain: float = 0.01
    start_roughness: float = 0.4
    start_specular_share: float = 0.2
    self_shadowing: Literal["auto", "on", "off"] = "auto"
    specular: Literal["auto", "on"] = "auto"
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
    matte: materials without specular part;  specular: what decided about each
    """

    solution: Solution
    history: list[Event]
    loss: Loss
    self_shadowing: bool = False
    held_out: dict[str, float] = {}
    matte: Bool[np.ndarray, "m"] | None = None
    specular: list[Specular] = []


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
    blocks: Sequence[Block], materials: int, operator, bundle: Bundle, map_: Callable, report: Report, snapshot: Snapshot = unwatched
) -> Joint:
    """Materials 0 … `materials`−1 and one light per block; `map_` spreads illuminations over workers."""
    models = candidates(blocks, bundle.self_shadowing)
    fits: dict[str, Fit] = {}
    for name, model in models.items():
        fits[name] = best_round(model, materials, operator, bundle, map_, report, list(fits.values()), snapshot)
    chosen = min(fits, key=lambda name: fits[name].held_out)
    fit, matte, specular = with_specular_chosen(models[chosen], fits[chosen], operator, bundle, map_)
    solution, history = polished(models[chosen], fit, operator, bundle, map_, report, matte, snapshot)
    found = solution.materials
    specular_or_none = np.where(matte[:, None], 0.0, found.specular)
    solution = msgspec.structs.replace(solution, materials=Materials(found.diffuse, specular_or_none, found.roughness))
    held_out = {name: fit.held_out for name, fit in fits.items()}
    return Joint(solution, history, fit.loss, chosen == "with", held_out, matte, specular)


def with_specular_chosen(blocks: Sequence[Block], fit: Fit, operator, bundle: Bundle, map_: Callable):
    """The fit without needless specular parts, which materials are matte, and the evidence."""
    blocks = sampled_for(blocks, fit.solution.lights, bundle)
    start = evaluated(blocks, fit.solution.materials, fit.solution.lights, operator, fit.loss, map_)
    if bundle.specular == "on" or not any(block.held_out.any() for block in blocks):
        return fit, np.zeros(len(start.materials), bool), []

    held = [held_out_of(blocks, k) for k in range(len(blocks))]

    def held_out(s: Solution) -> np.ndarray:
        return held_out_losses(held, s.materials, s.lights, operator, bundle.loss)

    solution, matte, evidence = matte_where_it_may_be(blocks, held, start, operator, fit.loss, held_out, map_)
    return msgspec.structs.replace(fit, solution=solution), matte, evidence


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
    materials: int,
    operator,
    bundle: Bundle,
    map_: Callable,
    report: Report,
    rivals: Sequence[Fit] = (),
    snapshot: Snapshot = unwatched,
) -> Fit:
    """Rounds on a sample of the observations, as long as they gain, and no rival was far ahead at the same round."""
    whole, history = blocks, []
    blocks = [sampled(block, bundle.sample, bundle.seed) for block in whole]
    start = starting_materials(blocks, materials, bundle.start_specular_share, bundle.start_roughness)
    current = evaluated(blocks, start, [starting_light(b, start) for b in blocks], operator, bundle.loss, map_)
    current = _refitted(blocks, current, operator, bundle.loss, map_)
    best, best_held, fitted = current, np.inf, np.inf
    for number in range(bundle.rounds):
        blocks = sampled_for(whole, current.lights, bundle, bundle.insert)
        record = _recorder(blocks, history, operator, bundle.loss, report, snapshot)
        loss = msgspec.structs.replace(bundle.loss, robust_scale=_robust_scale(blocks, current, operator, bundle.loss))
        current = _with_new_lobes(blocks, current, operator, loss, bundle, number, map_)
        said = partial(record, number, "descent")
        current = descend(blocks, current, operator, loss, _descent(bundle, bundle.iterations), map_, said)
        current = _tidied(blocks, _out_of_valleys(blocks, current, operator, loss, map_), operator, loss, map_)
        held = record(number, "round", -1, current)
        gained, halved = best_held - held, history[-1].loss < HALVED * fitted
        fitted = history[-1].loss
        if held < best_held:
            best, best_held = current, held
        outdone = number >= 1 and any(held > FAR_BEHIND * rival.held_out_at(number) for rival in rivals)
        if outdone or (gained < bundle.least_gain * held and not halved) or max(map(len, current.lights)) >= bundle.lobes:
            break
    return Fit(best, best_held, loss, history)


def polished(
    blocks: Sequence[Block], fit: Fit, operator, bundle: Bundle, map_: Callable, report: Report, matte=None, snapshot: Snapshot = unwatched
) -> tuple[Solution, list[Event]]:
    """The best round brought to rest on many observations, then on all, and the whole history."""
    everything = [msgspec.structs.replace(b, held_out=np.zeros(len(b), bool)) for b in blocks]
    many = sampled_for(everything, fit.solution.lights, bundle, times=MANY)
    history, number, loss, best = list(fit.history), fit.history[-1].round, fit.loss, fit.solution
    phases = [(many, bundle.polish), (everything, min(bundle.settle, bundle.polish))]
    for of, iterations in phases if sum(map(len, many)) < sum(map(len, everything)) else phases[:1]:
        record = _recorder(of, history, operator, loss, report, snapshot)
        best = evaluated(of, best.materials, best.lights, operator, loss, map_)
        best = descend(
            of, best, operator, loss, _descent(bundle, iterations), map_, partial(record, number, "polish"), matte
        )
    return _tidied(everything, best, operator, loss, map_), history


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


def _robust_scale(blocks: Sequence[Block], solution: Solution, operator, loss: Loss) -> float:
    """Three robust standard deviations of the current residual, never below one σ of the noise model."""
    absolute = [
        np.abs(residuals(b, predicted_radiance(b, light, solution.materials, operator)))
        for b, light in zip(blocks, solution.lights, strict=True)
    ]
    return max(3 * 1.4826 * float(np.median(np.concatenate(absolute))), 1.0)


def _with_new_lobes(blocks, current: Solution, operator, loss: Loss, bundle: Bundle, number: int, map_: Callable) -> Solution:
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
