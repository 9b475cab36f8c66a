"""The solver of few lobes: insert lobes where the residual asks, descend jointly, prune, and stop when held-out pixels do.

    rounds    find the lobes on a sample of the observations
    specular  parts are kept where held-out observations are explained better with them
    polish    brings the answer to its optimum, first on many observations, then on all

The problem is taken as it is: all that its blocks know to be hidden is dark, or sends what they know to be sent.
"""

from __future__ import annotations

from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.evidence import Evidence
from factorlib.solve.few_lobes.bounds import specular_unknowns
from factorlib.solve.few_lobes.descent import Descent, descend
from factorlib.solve.few_lobes.history import Recorder, Run
from factorlib.solve.few_lobes.iterate import evaluate
from factorlib.solve.few_lobes.rounds import Fit, Start, answer_of, chosen_round, sampled_for
from factorlib.solve.few_lobes.specular import Specular, undecided, without_needless_specular
from factorlib.solve.history import Event, Solution

MANY = 4  # times `sample` observations bring the chosen round to its optimum, before all of them settle it


class Polished(msgspec.Struct, frozen=True):
    """The point after a phase of the polish, and all events so far."""

    point: Point
    history: list[Event]


def few_lobes(problem: JointProblem, start: Start, run: Run | None = None) -> Solution:
    """One reflectance per material and one light per block.

    problem: its loss judges held-out observations and, made robust, is what is lowered;  start: `from_nothing(materials)`;
    run: options, reports and journal; None: the defaults
    """
    run = run or Run()
    fit = chosen_round(problem, start, run)
    chosen = with_specular_chosen(problem, fit, start, run)
    end = polished(problem, msgspec.structs.replace(fit, point=chosen.point), chosen.lambertian, run)
    found = end.point.materials
    materials = Materials(found.diffuse, np.where(chosen.lambertian[:, None], 0.0, found.specular), found.roughness)
    return Solution(
        Point(materials, end.point.lights),
        end.history,
        fit.loss,
        chosen.lambertian,
        shadows=Evidence(any(block.visibility is not None for block in problem.blocks)),
        interreflection=Evidence(problem.has_bounces),
        specular=chosen.evidence,
    )


def with_specular_chosen(problem: JointProblem, fit: Fit, start: Start, run: Run) -> Specular:
    """The fit without needless specular parts: those decided before, and those without which held-out observations lose nothing."""
    if kept := run.journal.kept("choice", Specular):
        return kept
    materials = fit.point.materials
    for m in np.flatnonzero(start.lambertian):
        materials = materials.lambertian(m)
    before = Point(materials, fit.point.lights)
    if run.options.specular == "on" or start.decided.all() or problem.none_held_out:
        evidence = undecided(start.lambertian) if start.decided.any() else []
        return run.journal.keep("choice", Specular(before, start.lambertian, evidence))
    sample = sampled_for(problem, before, run.options)
    number, lobes = fit.history[-1].round, sum(map(len, before.lights))

    def report(trial: int, held_out: float) -> None:
        """Of a trial without one material's specular part."""
        run.report(Event(number, "specular part", trial, held_out, held_out, lobes))

    found = without_needless_specular(sample, before, fit.loss, start.decided, start.lambertian, report)
    return run.journal.keep("choice", found)


def polished(problem: JointProblem, fit: Fit, lambertian: Bool[np.ndarray, " m"], run: Run) -> Polished:
    """The chosen round brought to its optimum on many observations, then on all, and the whole history."""
    everything = problem.with_none_held_out().with_loss(fit.loss)
    many = sampled_for(everything, fit.point, run.options, times=MANY)
    number, fixed = fit.history[-1].round, specular_unknowns(lambertian)
    phases = [(many, run.options.polish), (everything, min(run.options.settle, run.options.polish))]
    at = Polished(fit.point, fit.history)
    for phase, (of, iterations) in enumerate(phases if many.fitted_values < everything.fitted_values else phases[:1]):
        if kept := run.journal.kept(f"polish {phase}", Polished):
            at = kept
            continue
        history = list(at.history)
        record = partial(Recorder(of, history, run).record, number, "polish")
        found = descend(of, evaluate(of, at.point), Descent(iterations, run.options.tolerance), record, fixed)
        at = run.journal.keep(f"polish {phase}", Polished(found.point, history))
    return Polished(answer_of(everything, at.point), at.history)
