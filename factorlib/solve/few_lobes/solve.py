"""The solver of few lobes: insert lobes where the residual asks, descend jointly, prune, and stop when held-out pixels do.

    rounds    find the lobes on a sample of the observations
    specular  parts are kept where held-out observations are explained better with them
    polish    brings the answer to its optimum, first on many observations, then on all

The problem is taken as it is: all that its blocks know to be hidden is dark, or sends what they know to be sent.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.evidence import Evidence
from factorlib.solve.few_lobes.descent import Descent, descend, evaluate
from factorlib.solve.few_lobes.history import Recorder, Run
from factorlib.solve.few_lobes.rounds import Fit, answer_of, chosen_round, sampled_for
from factorlib.solve.few_lobes.specular import Specular, without_needless_specular
from factorlib.solve.few_lobes.unknowns import specular_unknowns
from factorlib.solve.history import Event, Solution

MANY = 4  # times `sample` observations bring the chosen round to its optimum, before all of them settle it


def few_lobes(problem: JointProblem, materials: int, run: Run | None = None) -> Solution:
    """One reflectance for each of so many materials and one light per block, from nothing.

    problem: its loss judges held-out observations and, made robust, is what is lowered;  run: options and reports; None: the defaults
    """
    run = run or Run()
    fit = chosen_round(problem, materials, run)
    chosen = with_specular_chosen(problem, fit, run)
    point, history = polished(problem, fit, chosen, run)
    specular = np.where(chosen.lambertian[:, None], 0.0, point.materials.specular)
    return Solution(
        Point(Materials(point.materials.diffuse, specular, point.materials.roughness), point.lights),
        history,
        fit.loss,
        chosen.lambertian,
        shadows=Evidence(any(block.visibility is not None for block in problem.blocks)),
        interreflection=Evidence(problem.has_bounces),
        specular=chosen.evidence,
    )


def with_specular_chosen(problem: JointProblem, fit: Fit, run: Run) -> Specular:
    """The fit without needless specular parts: those without which held-out observations lose nothing, or all of them."""
    point, count = fit.point, len(fit.point.materials)
    if run.options.specular == "off":
        for m in range(count):
            point = Point(point.materials.lambertian(m), point.lights)
        return Specular(point, np.ones(count, bool), [])
    if run.options.specular == "on" or problem.none_held_out:
        return Specular(point, np.zeros(count, bool), [])
    number, lobes = fit.history[-1].round, sum(map(len, point.lights))

    def report(trial: int, held_out: float) -> None:
        """Of a trial without one material's specular part."""
        run.report(Event(number, "specular part", trial, held_out, held_out, lobes))

    return without_needless_specular(sampled_for(problem, point, run.options), point, fit.loss, report)


def polished(problem: JointProblem, fit: Fit, chosen: Specular, run: Run) -> tuple[Point, list[Event]]:
    """The chosen round brought to its optimum on many observations, then on all, and the whole history."""
    everything = problem.with_none_held_out().with_loss(fit.loss)
    many = sampled_for(everything, fit.point, run.options, times=MANY)
    phases = [(many, run.options.polish), (everything, min(run.options.settle, run.options.polish))]
    number, fixed = fit.history[-1].round, specular_unknowns(chosen.lambertian)
    point, history = chosen.point, list(fit.history)
    for of, iterations in phases if many.fitted_values < everything.fitted_values else phases[:1]:
        record = partial(Recorder(of, history, run).record, number, "polish")
        descent = Descent(iterations, run.options.tolerance)
        point = descend(of, evaluate(of, point), descent, record, fixed).point
    return answer_of(everything, point), history
