"""The bundle solver: insert lobes where the residual asks, descend jointly, prune, and stop when held-out pixels do.

    rounds    on a sample of the observations find the lobes (rounds); where observations see past something, they are run with and
              without that (self_shadowing = auto), and what explains the held-out pixels better goes on
    choices   tone curves and specular parts that held-out pixels ask for (tone_choice, choice)
    polish    brings the answer to rest on many observations, then on all
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from factorlib.solve.choice import Specular, matte_where_it_may_be, untried, without_specular
from factorlib.solve.descent import Solution, descend, evaluated
from factorlib.solve.held_out import Judge, held_out_of, losses_of, none_held_out
from factorlib.solve.history import Event, Report, Snapshot, recorder, unwatched
from factorlib.solve.normal_equations import Loss
from factorlib.solve.options import Bundle
from factorlib.solve.problem import Block
from factorlib.solve.resume import Journal
from factorlib.solve.rounds import Fit, Start, answer_of, bare, best_round, descent_of, from_nothing, further_rounds, sampled_for
from factorlib.solve.shadowing import without_shadows
from factorlib.solve.step import specular_unknowns
from factorlib.solve.tone_choice import Tone, rested, toned_where_it_pays
from factorlib.solve.unknowns import Materials

MANY = 4  # times `sample` observations bring the best round to rest, before all of them settle it


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
    if none_held_out(blocks):
        return Toned(fit.solution, [])
    blocks = sampled_for(blocks, fit.solution.lights, bundle)
    at = rested(blocks, fit.solution, fit.solution.lights, operator, fit.loss, map_)
    if bundle.tone == "off":
        return journal.keep("tone", Toned(bare(at), []))
    solution, evidence = toned_where_it_pays(blocks, at, operator, fit.loss, judged_by(bundle, operator), map_)
    return journal.keep("tone", Toned(bare(solution), evidence))


def judged_by(bundle: Bundle, operator) -> Judge:
    """Held-out losses by the loss that the solve began with."""

    def losses(blocks: Sequence[Block], at: Solution) -> list[Float[np.ndarray, "n"]]:
        return losses_of([held_out_of(block, False) for block in blocks], at.materials, at.lights, operator, bundle.loss)

    return losses


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
    if bundle.specular == "on" or start.decided.all() or none_held_out(blocks):
        return journal.keep("choice", Chosen(before, start.matte, untried(start.matte) if start.decided.any() else []))
    blocks = sampled_for(blocks, before.lights, bundle)
    at = evaluated(blocks, materials, before.lights, operator, fit.loss, map_)
    solution, matte, evidence = matte_where_it_may_be(
        blocks, at, operator, fit.loss, judged_by(bundle, operator), map_, decided=start.decided, matte=start.matte
    )
    return journal.keep("choice", Chosen(bare(solution), matte, evidence))


def candidates(blocks: Sequence[Block], self_shadowing: str) -> dict[str, list[Block]]:
    """The models to choose from: `with` self-shadowing, `without`, or both.  Where nothing is hidden they are one."""
    shadows = self_shadowing != "off" and any(block.visibility is not None for block in blocks)
    models = {"without": [without_shadows(block) for block in blocks]} if not shadows or self_shadowing == "auto" else {}
    return models | ({"with": list(blocks)} if shadows else {})


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
    held = None if matte is None else specular_unknowns(matte)
    phases = [(many, bundle.polish), (everything, min(bundle.settle, bundle.polish))]
    at = Polished(fit.solution, fit.history)
    for phase, (of, iterations) in enumerate(phases if sum(map(len, many)) < sum(map(len, everything)) else phases[:1]):
        if kept := journal.kept(f"polish {phase}", Polished):
            at = kept
            continue
        history = list(at.history)
        record = recorder(of, history, operator, loss, report, snapshot)
        best = evaluated(of, at.solution.materials, at.solution.lights, operator, loss, map_)
        best = descend(of, best, operator, loss, descent_of(bundle, iterations), map_, partial(record, number, "polish"), held)
        at = journal.keep(f"polish {phase}", Polished(bare(best), history))
    return answer_of(everything, at.solution, operator, loss, map_), at.history
