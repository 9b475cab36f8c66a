"""The bundle solver: insert lobes where the residual asks, descend jointly, prune, and stop when held-out pixels do.

    rounds    find the lobes on a sample of the observations.  Where meshes hide a part of the light and self_shadowing = auto, they are
              run with shadows and without, and the model that explains the held-out pixels better goes on
    bounces   Where shadows go on and interreflection = auto, the light that surfaces send to each other is added, if held-out pixels
              are explained better with it after equally many iterations; further rounds follow
    choices   tone curves and specular parts, kept where held-out pixels are explained better with them (curves, specular)
    prior     lights with the statistics of natural light, where lobes do not explain held-out pixels well (natural).  All materials
              then keep their specular parts, which have a prior, too: trials with wrong lights cannot tell which are needless
    polish    if lights are lobes: brings the answer to its optimum, first on many observations, then on all
"""

from __future__ import annotations

from functools import partial

import msgspec
import numpy as np
from jaxtyping import Bool

from factorlib.light.prior import read_light_prior
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.solve.bounds import specular_unknowns
from factorlib.solve.curves import Curves, near_optimum, with_curves_where_needed
from factorlib.solve.descent import Descent, descend
from factorlib.solve.evidence import Evidence, decide, decide_over_lights
from factorlib.solve.history import Event, Recorder, Run
from factorlib.solve.iterate import evaluate
from factorlib.solve.natural import LOBES, OBSERVATIONS, Natural, lights_from_all, naturally, sure_ones
from factorlib.solve.options import Choices
from factorlib.solve.rounds import Fit, Start, answer_of, chosen_round, further_rounds, sampled_for
from factorlib.solve.specular import Specular, undecided, without_needless_specular
from factorlib.solve.thresholds import HOPEFUL, INTERREFLECTION, SHADOWS, WELL_EXPLAINED

MANY = 4  # times `sample` observations bring the chosen round to its optimum, before all of them settle it


class Solution(msgspec.Struct, frozen=True):
    """The answer: a point in the gauge of `factorlib.model.gauge`.

    history     every accepted point on the way;  loss: the loss function that was lowered last
    lambertian  materials without specular part
    shadows     whether visibility was used, with its evidence;  interreflection: whether surfaces light each other
    natural     the lights with a prior, where they are such, and sure: those of sure observations alone;  light_prior: the evidence for the prior
    specular    the evidence for each material's specular part, tone: for each light's tone curves; empty where nothing was tried
    """

    point: Point
    history: list[Event]
    loss: Loss
    lambertian: Bool[np.ndarray, " m"]
    shadows: Evidence = Evidence(False)
    interreflection: Evidence = Evidence(False)
    specular: list[Evidence] = []
    tone: list[Evidence] = []
    natural: Natural | None = None
    sure: Natural | None = None
    light_prior: Evidence = Evidence(False)

    def shown(self, problem: JointProblem) -> JointProblem:
        """The problem that the answer solves: with shadows and bounces or without, with the last loss."""
        return _of_model(problem, self.shadows.kept, self.interreflection.kept).with_loss(self.loss)


class Bounces(msgspec.Struct, frozen=True):
    """The fit with bounces or without, and what decided."""

    fit: Fit
    evidence: Evidence


class Prior(msgspec.Struct, frozen=True):
    """The fit with a prior on lights, and the evidence for it; sure: the fit to sure observations alone, whose materials it has."""

    fit: Natural
    sure: Natural
    evidence: Evidence


class Polished(msgspec.Struct, frozen=True):
    """The point after a phase of the polish, and all events so far."""

    point: Point
    history: list[Event]


def solve(problem: JointProblem, start: Start, run: Run | None = None) -> Solution:
    """One reflectance per material and one light per block.

    problem: its loss judges held-out observations and, made robust, is what is lowered;  start: `from_nothing(materials)`, or an
    earlier solution;  run: options, reports and journal; None: the defaults
    """
    run, fits = run or Run(), dict[str, Fit]()
    for name, model in models(problem, run.options).items():
        fits[name] = chosen_round(model, start, run, f"rounds {name}", list(fits.values()))
    shadows = _shadows(fits)
    bounces = with_bounces_chosen(problem, fits["with"], run) if shadows.kept else Bounces(fits["without"], Evidence(False))
    problem, fit = _of_model(problem, shadows.kept, bounces.evidence.kept), bounces.fit
    curves = with_tone_chosen(problem, fit, run)
    if any(of_light.kept for of_light in curves.evidence) and lobes_may_do(fit, run):  # what the curves explain had stopped the rounds early
        fit = further_rounds(problem, fit, curves.point, run)
    chosen = with_specular_chosen(problem, fit, start, run)
    natural = with_prior_chosen(problem, msgspec.structs.replace(fit, point=chosen.point), chosen.lambertian, run)
    decided = (shadows, bounces.evidence, chosen.evidence, curves.evidence)
    if natural:
        return Solution(natural.fit.point, fit.history, problem.loss, chosen.lambertian, *decided, natural.fit, natural.sure, natural.evidence)
    end = polished(problem, msgspec.structs.replace(fit, point=chosen.point), chosen.lambertian, run)
    found = end.point.materials
    materials = Materials(found.diffuse, np.where(chosen.lambertian[:, None], 0.0, found.specular), found.roughness)
    point = Point(materials, end.point.lights)
    return Solution(point, end.history, fit.loss, chosen.lambertian, *decided)


def models(problem: JointProblem, choices: Choices) -> dict[str, JointProblem]:
    """The models that rounds start with: `with` self-shadowing, `without`, or both; `without` alone where nothing is hidden.

    `with` has bounces where they are `on`; else they are decided from its chosen round (`with_bounces_chosen`)
    """
    shadows = choices.self_shadowing != "off" and any(block.visibility is not None for block in problem.blocks)
    found = {"without": problem.without_shadows()} if not shadows or choices.self_shadowing == "auto" else {}
    return found | ({"with": _of_model(problem, True, choices.interreflection == "on")} if shadows else {})


def _of_model(problem: JointProblem, shadows: bool, bounces: bool) -> JointProblem:
    if not shadows:
        return problem.without_shadows()
    return problem if bounces else problem.without_bounces()


def _shadows(fits: dict[str, Fit]) -> Evidence:
    """Which model of `fits` explains held-out observations better, by its chosen round."""
    losses = {name: fit.held_out for name, fit in fits.items()}
    if len(losses) == 2:
        return decide(losses["without"], losses["with"], SHADOWS)
    return Evidence("with" in losses, losses.get("with"), losses.get("without"))


def with_bounces_chosen(problem: JointProblem, fit: Fit, run: Run) -> Bounces:
    """The fit, which has shadows, with bounces and after further rounds where they explain held-out observations better."""
    if run.options.interreflection != "auto" or not problem.has_bounces:
        kept = run.options.interreflection == "on" and problem.has_bounces
        return Bounces(fit, Evidence(kept, fit.held_out if kept else None))
    if not (decided := run.journal.kept("bounces", Bounces)):
        decided = run.journal.keep("bounces", _bounces_decided(problem, fit, run))
    if not (decided.evidence.kept and lobes_may_do(decided.fit, run)):
        return decided
    return Bounces(further_rounds(problem, decided.fit, decided.fit.point, run, "rounds bounces"), decided.evidence)


def lobes_may_do(fit: Fit, run: Run) -> bool:
    """Whether lobes may turn out to explain the photos so well that lights need no prior, or must do without one."""
    return run.options.light_prior == "none" or fit.held_out < HOPEFUL * WELL_EXPLAINED


def _bounces_decided(problem: JointProblem, fit: Fit, run: Run) -> Bounces:
    """Both models are brought near their optimum by equally many iterations; the fit keeps its point where bounces are not kept."""
    samples = [sampled_for(model, fit.point, run.options) for model in (problem.without_bounces(), problem)]
    points = [near_optimum(sample.with_loss(fit.loss), fit.point).point for sample in samples]
    losses = [sample.held_out_losses(point) for sample, point in zip(samples, points, strict=True)]
    evidence = decide_over_lights(*losses, INTERREFLECTION)
    if not evidence.kept:
        return Bounces(fit, evidence)
    return Bounces(msgspec.structs.replace(fit, point=points[1], held_out=samples[1].held_out_loss(points[1])), evidence)


def with_tone_chosen(problem: JointProblem, fit: Fit, run: Run) -> Curves:
    """The fit nearer to its optimum, with tone curves where held-out observations are explained better with them."""
    if kept := run.journal.kept("tone", Curves):
        return kept
    if problem.none_held_out:
        return Curves(fit.point, [])
    sample = sampled_for(problem, fit.point, run.options)
    at = near_optimum(sample.with_loss(fit.loss), fit.point)
    curves = Curves(at.point, []) if run.options.tone == "off" else with_curves_where_needed(sample, at, fit.loss)
    return run.journal.keep("tone", curves)


def with_specular_chosen(problem: JointProblem, fit: Fit, start: Start, run: Run) -> Specular:
    """The fit without needless specular parts: those decided before, and, unless lights follow the prior, those without which
    held-out observations lose nothing."""
    if kept := run.journal.kept("choice", Specular):
        return kept
    materials = fit.point.materials
    for m in np.flatnonzero(start.lambertian):
        materials = materials.lambertian(m)
    before = Point(materials, fit.point.lights)
    if run.options.specular == "on" or start.decided.all() or problem.none_held_out or follows_prior(problem, fit, run.options):
        evidence = undecided(start.lambertian) if start.decided.any() else []
        return run.journal.keep("choice", Specular(before, start.lambertian, evidence))
    sample = sampled_for(problem, before, run.options)
    number, lobes = fit.history[-1].round, sum(map(len, before.lights))

    def report(trial: int, held_out: float) -> None:
        """Of a trial without one material's specular part."""
        run.report(Event(number, "specular part", trial, held_out, held_out, lobes))

    found = without_needless_specular(sample, before, fit.loss, start.decided, start.lambertian, report)
    return run.journal.keep("choice", found)


def follows_prior(problem: JointProblem, fit: Fit, choices: Choices) -> bool:
    """Whether lights have a prior: if so chosen, or where lobes of `fit` explain held-out observations badly."""
    if choices.light_prior == "auto":
        return not problem.none_held_out and not fit.held_out < WELL_EXPLAINED
    return choices.light_prior == "on"


def with_prior_chosen(problem: JointProblem, fit: Fit, lambertian: Bool[np.ndarray, " m"], run: Run) -> Prior | None:
    """The fit with a prior on lights; None where the lobes of `fit` explain held-out observations well, or none are held out."""
    if not follows_prior(problem, fit, run.options):
        return None
    if kept := run.journal.kept("light prior", Prior):
        return kept
    sample, sure = (seen_under_prior(of, run.options) for of in (problem, sure_ones(problem)))
    number, lobes = fit.history[-1].round, LOBES * len(problem.blocks)

    def report(iteration: int, loss: float) -> None:
        """Of an iteration with a prior on lights."""
        run.report(Event(number, "light prior", iteration, loss, np.nan, lobes))

    of_sure = run.journal.kept("materials under the light prior", Natural)
    if not of_sure:
        of_sure = naturally(sure, fit.point, read_light_prior(), lambertian, report)
        of_sure = run.journal.keep("materials under the light prior", of_sure)
    found = lights_from_all(sample, of_sure, read_light_prior(), report)
    losses = [sample.held_out_loss(point) for point in (found.point, fit.point)]
    return run.journal.keep("light prior", Prior(found, of_sure, Evidence(True, *losses)))


def seen_under_prior(problem: JointProblem, choices: Choices) -> JointProblem:
    """As many observations as lights with a prior are found from."""
    return problem.sampled(max(choices.sample, OBSERVATIONS), choices.seed)


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
