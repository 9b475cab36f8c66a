"""The solver of few lobes: insert lobes where the residual asks, descend jointly, prune, and stop when held-out pixels do.

    rounds    find the lobes on a sample of the observations
    specular  parts are kept where held-out observations are explained better with them
    polish    brings the answer to its optimum, first on many observations, then on all

The problem is taken as it is: all that its blocks know to be hidden is dark, or sends what they know to be sent.

The specular part of a material that is Lambertian in truth would fit errors of normals and lights.  So each material in turn, the
least specular first, is made Lambertian for a trial, the rest of the problem is brought near its optimum again, and held-out observations decide.
A material that reflects more specularly than diffusely is not tried: where normals are wrong, a blurred highlight explains held-out
observations better than the true one, and a dark glossy material would lose all that it reflects.

A trial whose iterations raise the held-out loss decides nothing.  A lobe may then have grown in a part of the light that only held-out
observations mirror, and their loss says nothing about the specular part.

A trial fits only the `LIGHTS` lights that show most of the material, so that its cost does not grow with the set; so does the fit that
it is compared with once another material has lost its specular part since the last fit of all lights.  These are fitted again at the end.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.model.gauge import in_gauge
from factorlib.model.materials import Materials, Point
from factorlib.model.problem import JointProblem
from factorlib.results.materials import Decision
from factorlib.solve.few_lobes.descent import descend, evaluate, fit_weights
from factorlib.solve.few_lobes.rounds import TOLERANCE, ChosenRound, chosen_round, recorder, sampled_for
from factorlib.solve.few_lobes.unknowns import blurred, pruned, specular_unknowns
from factorlib.solve.history import Event, Report, Solution, unreported
from factorlib.solve.options import FewLobes

# Times `sample` observations bring the chosen round to its optimum, before all of them settle it in so many iterations.
MANY, SETTLE = 4, 2
# Without its specular part, the held-out loss of a material that needs it is higher by more than GAIN, or that of all observations that are
# compared by more than HARM.  The latter moves by some 3 % as a descent goes on: less says nothing.
GAIN, HARM = 0.03, 0.05
# Times the held-out loss: if it is higher after few iterations without a specular part, that part is needed.
NEEDED_EARLY = 1.3
FIRST, ITERATIONS = 3, 6  # iterations of a trial, and further ones where the first do not decide
LIGHTS = 8


class Specular(msgspec.Struct, frozen=True):
    """A point without needless specular parts, which materials are Lambertian, and the evidence for every material."""

    point: Point
    lambertian: Bool[np.ndarray, " m"]
    evidence: list[Decision]


def few_lobes(
    problem: JointProblem, materials: int, options: FewLobes = FewLobes(), report: Report = unreported
) -> Solution:
    """One reflectance for each of so many materials and one light per block, from nothing.

    problem: its loss judges held-out observations and, made robust, is what is lowered;  report: called at every accepted point
    """
    fit = chosen_round(problem, materials, options, report)
    chosen = with_specular_chosen(problem, fit, options, report)
    point, history = polished(problem, fit, chosen, options, report)
    specular = np.where(chosen.lambertian[:, None], 0.0, point.materials.specular)
    return Solution(
        Point(Materials(point.materials.diffuse, specular, point.materials.roughness), point.lights),
        history,
        fit.loss,
        chosen.lambertian,
        shadows=Decision(any(block.visibility is not None for block in problem.blocks)),
        interreflection=Decision(problem.has_bounces),
        specular=chosen.evidence,
    )


def polished(
    problem: JointProblem, fit: ChosenRound, chosen: Specular, options: FewLobes, report: Report
) -> tuple[Point, list[Event]]:
    """The chosen round brought to its optimum on many observations, then on all, and the whole history."""
    everything = problem.with_none_held_out().with_loss(fit.loss)
    many = sampled_for(everything, fit.point, options, times=MANY)
    phases = [(many, options.polish), (everything, min(SETTLE, options.polish))]
    number, fixed = fit.history[-1].round, specular_unknowns(chosen.lambertian)
    point, history = chosen.point, list(fit.history)
    for of, iterations in phases if many.fitted_values < everything.fitted_values else phases[:1]:
        record = recorder(of, history, report, number, "polish")
        point = descend(of, evaluate(of, point), iterations, TOLERANCE, record, fixed).point
    return answer_of(everything, point), history


def answer_of(problem: JointProblem, point: Point) -> Point:
    """The final point: no lobe is sharper than the materials resolve, weights fit all observations, pruned, in the gauge."""
    lights = [blurred(light, point.materials.sharpest) for light in point.lights]
    fitted = fit_weights(problem, Point(point.materials, lights)).point
    return in_gauge(Point(fitted.materials, [pruned(light) for light in fitted.lights]), problem.blocks)


def with_specular_chosen(
    problem: JointProblem, fit: ChosenRound, options: FewLobes = FewLobes(), report: Report = unreported
) -> Specular:
    """The fit without needless specular parts, which materials have none, and the evidence for every material."""
    start, base, count = (
        fit.point,
        fit.point.materials,
        len(fit.point.materials),
    )  # all go on from here by as many iterations
    if problem.none_held_out:
        return Specular(start, np.zeros(count, bool), [])
    problem, last, lobes = sampled_for(problem, start, options), fit.history[-1].round, sum(map(len, start.lights))
    lambertian, every, numbers = np.zeros(count, bool), np.arange(len(problem.blocks)), np.arange(count)
    shown = np.array([np.bincount(block.material, minlength=count) for block in problem.blocks])

    def near_optimum(
        lights: Sequence[int], materials: Materials, plain: Bool[np.ndarray, " m"], most: float = np.inf
    ) -> Point:
        """The point of `materials` and `lights` after some iterations; the point before them if they raise the held-out loss.

        plain: which are Lambertian;  most: if the held-out loss exceeds it after the `FIRST` iterations, no more are made
        """
        judge, fixed = problem.restricted(lights), specular_unknowns(plain)
        own = judge.with_loss(fit.loss)
        before = evaluate(own, Point(materials, start.restricted(lights).lights))
        after = descend(own, before, FIRST, fixed=fixed)
        if not (np.isfinite(most) and judge.held_out_loss(after.point) > most):
            after = descend(own, after, ITERATIONS, fixed=fixed)
        harmless = (1 + HARM) * judge.held_out_loss(before.point)
        return after.point if judge.held_out_loss(after.point) <= harmless else before.point

    chosen, evidence = near_optimum(every, base, lambertian), [Decision(True) for _ in lambertian]
    current = True  # whether `chosen` is the fit of `base`
    for number, m in enumerate(np.argsort(base.specular.mean(1), kind="stable")):
        lights = np.sort(np.argsort(-shown[:, m], kind="stable")[:LIGHTS])  # that show most of the material
        lights = lights[shown[lights, m] > 0]
        judged = any((of.held_out & (of.material == m)).any() for of in (problem.blocks[k] for k in lights))
        if not judged or base.specular[m].mean() > base.diffuse[m].mean():
            continue
        richer = chosen.restricted(lights) if current else near_optimum(lights, base, lambertian)
        judge, without = problem.restricted(lights), base.lambertian(m)
        held_out = judge.held_out_loss(richer)
        report(Event(last, "specular part", number, held_out, held_out, lobes))
        trial = near_optimum(lights, without, lambertian | (numbers == m), NEEDED_EARLY * held_out)
        evidence[m] = compare(judge, trial, richer, int(m))
        if evidence[m].kept:
            continue
        base, lambertian[m] = without, True
        current = len(lights) == len(every)
        chosen = trial if current else chosen
    return Specular(chosen if current else near_optimum(every, base, lambertian), lambertian, evidence)


def compare(problem: JointProblem, without: Point, richer: Point, material: int) -> Decision:
    """Whether the specular part of a material is kept, by the held-out losses of two points at (or near) their optimum."""
    losses = [np.concatenate(problem.held_out_losses(point)) for point in (without, richer)]
    own = np.concatenate([b.material[b.held_out | problem.none_held_out] for b in problem.blocks]) == material
    harmed = losses[0].mean() > (1 + HARM) * losses[1].mean()
    plain, full = (float(of[own].mean()) if own.any() else 0.0 for of in losses)
    return Decision(bool(plain > (1 + GAIN) * full or harmed), full, plain)
