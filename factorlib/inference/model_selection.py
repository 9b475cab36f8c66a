"""Model choices that a scene needs, made in the model that gives the answer.

effects     No shadows, shadows of the given meshes, or shadows with interreflection, on fewer observations and cells.
            The first model is fitted from every start, the others from its result.  Shadows stay unless the evidence is
            against them.  Interreflection needs evidence and shadows.
tone        Exponents of tone curves are freed for all photos.  A light keeps its curves under three conditions: the
            evidence supports them, the loss without them is more than `LEAST_TONE_GAIN` higher, and they end within the
            range of real cameras.  An exponent also fits some errors of the rest of the model, such as wrong normals.
distance    A light gets the curvature of `CURVATURES` that explains held-out observations best, if the evidence
            supports it.  Otherwise the light is infinitely far away.
roughness   With few materials, the start decides which local minimum a fit reaches: a smooth surface in soft light
            looks like a rough one in sharp light.  Of the fits from several starts, the one of least held-out loss
            continues.

All choices but the last use `factorlib.inference.evidence`, on observations with reliable normals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from factorlib.inference.evidence import CLEARLY_AGAINST, CLEARLY_FOR, Losses, compare_models, held_out_losses
from factorlib.inference.fit import Fit, FitSchedule
from factorlib.inference.options import SolveOptions
from factorlib.inference.problem import JointProblem
from factorlib.results.materials import Decision

# Observations and cells of a light in comparisons of models.
TRIAL_OBSERVATIONS = 1000
TRIAL_CELLS = 180
TRIAL = FitSchedule(lights=3, together=(6, 4))
CONTINUED_TRIAL = FitSchedule(lights=2, together=(4, 2), estimate=False)
TONE_SCHEDULE = FitSchedule(together=(8,), estimate=False)
# Least relative gain of the held-out loss.  Under two standard errors alone, a photo with a wrong pose got a curve
# (margin 3.0, captured set of seed 7), and k_d was 30 % wrong instead of 13 %.
LEAST_TONE_GAIN = 0.25
LEAST_DISTANCE_MARGIN = (
    1.0  # standard errors from which a light comes nearer; at `CLEARLY_FOR` it has its estimated distance
)
# Curvatures of lights 20, 10 and 5 RMS distances away.  A chair's points are 0.4 m from their centre, and a room's
# walls and lamps 2 to 8 m.
CURVATURES = (0.05, 0.1, 0.2)
DISTANCE_SCHEDULE = FitSchedule(lights=2, together=(2,), estimate=False)
OBSERVATION_FACTOR = 8  # factor on the number of observations
LIGHT_OBSERVATION_FACTOR = (
    2  # factor on it where materials are given: +0.25 dB on data/eames, +0.27 on the made set of seed 101
)
LARGE_GAIN = 0.2  # least relative gain of the first splitting for that factor
# Least relative gain of a splitting for another one.  After a splitting that gained 3 %, two more gained 3.6 and 1 % on
# data/eames, and materials did not improve.
LEAST_GAIN = 0.05
LIGHTS_ONLY = FitSchedule(lights=2, estimate=False, given=True)

Fitting = Callable[[str, JointProblem, Fit, FitSchedule], Fit]  # phase, problem, start and schedule


class EffectSelection(msgspec.Struct, frozen=True):
    """Chosen effects, the evidence for them, and the fit of the chosen model on few observations."""

    fit: Fit
    shadows: Decision
    bounces: Decision

    def effective_problem(self, problem: JointProblem) -> JointProblem:
        """Return the problem under the chosen effects."""
        return problem.with_effects(self.shadows.kept, self.bounces.kept)


class Selection(msgspec.Struct, frozen=True):
    """Fit after a choice, and the evidence for each light or each splitting."""

    fit: Fit
    evidence: list[Decision]


def gain_exceeds(splitting: Decision, share: float) -> bool:
    """Return True if a splitting was kept and lowers the held-out loss by more than a share of the new loss."""
    gain = (splitting.held_out_loss_without or 0.0) / max(splitting.held_out_loss_with or 1.0, 1e-12) - 1
    return splitting.kept and gain > share


def observation_count(choices: SolveOptions, splittings: Sequence[Decision]) -> int:
    """Return the number of a light's observations to fit: more where smaller cells gain much.

    Errors of the model are small there, and those of few observations matter: k_d of data/synthetic is 13 % wrong with
    1,000 observations, 2.6 % with 4,000 and 1.0 % with 8,000.
    """
    return (
        OBSERVATION_FACTOR * choices.observations
        if splittings and gain_exceeds(splittings[0], LARGE_GAIN)
        else choices.observations
    )


def light_observation_count(choices: SolveOptions, splittings: Sequence[Decision]) -> int:
    """Return the number of a light's observations to fit where materials are given and a fit is cheap."""
    return LIGHT_OBSERVATION_FACTOR * observation_count(choices, splittings)


def comparison_sample(problem: JointProblem, choices: SolveOptions) -> JointProblem:
    """Return the observations on which models are compared."""
    return problem.subsample(min(TRIAL_OBSERVATIONS, choices.observations), choices.seed)


def select_effects(problem: JointProblem, starts: list[Fit], choices: SolveOptions, fit: Fitting) -> EffectSelection:
    """Choose shadows and interreflection.

    Args:
        problem: Observations with reliable normals.
        starts: Initial fits; the best result continues.
        choices: Options of the user.
        fit: Function that fits a model.
    """
    sample = comparison_sample(problem, choices)
    hidden = any(block.visibility is not None for block in problem.blocks)
    # without held-out observations, shadows are on and interreflection is off
    unjudged = problem.none_held_out
    shadows = ("on" if unjudged else "auto") if choices.self_shadowing == "auto" else choices.self_shadowing
    bounces = ("off" if unjudged else "auto") if choices.interreflection == "auto" else choices.interreflection
    shadows = shadows if hidden else "off"
    bounces = bounces if problem.has_bounces else "off"
    tried: dict[tuple[bool, bool], tuple[Fit, Losses]] = {}

    def trial(with_shadows: bool, with_bounces: bool) -> tuple[Fit, Losses]:
        """Return the fit of one model and its losses, from every start at first and then from the best result."""
        if (with_shadows, with_bounces) not in tried:
            name = "shadows and bounces" if with_bounces else "shadows" if with_shadows else "no shadows"
            model = sample.with_effects(with_shadows, with_bounces)
            begun = [fit for fit, _ in list(tried.values())[:1]] or starts
            fits = [fit(name, model, one, CONTINUED_TRIAL if np.isfinite(one.value) else TRIAL) for one in begun]
            trials = [(one, held_out_losses(model, one.point)) for one in fits]
            tried[with_shadows, with_bounces] = min(trials, key=lambda one: _geometric_mean(one[1]))
        return tried[with_shadows, with_bounces]

    trial(shadows != "off", shadows != "off" and bounces == "on")
    said = Decision(shadows == "on")
    lit = Decision(bounces == "on")
    if shadows == "auto":
        said = compare_models(trial(False, False)[1], trial(True, False)[1], CLEARLY_AGAINST)
    if not said.kept:
        return EffectSelection(trial(False, False)[0], said, Decision(False))
    if bounces == "auto":
        lit = compare_models(trial(True, False)[1], trial(True, True)[1], CLEARLY_FOR)
    return EffectSelection(trial(True, lit.kept)[0], said, lit)


def _geometric_mean(losses: Losses) -> float:
    """Return the log of the geometric mean over lights of their mean losses, weighted by observations.

    It is rounded to six digits, so that rounding errors do not decide.
    """
    counts = [len(values) for values in losses.values]
    logs = [len(values) and np.log(max(float(np.mean(values)), 1e-12)) for values in losses.values]
    return round(float(np.dot(counts, logs)) / max(sum(counts), 1), 6)


def select_tone_curves(problem: JointProblem, before: Fit, choices: SolveOptions, fit: Fitting) -> Selection:
    """Choose tone curves.

    Args:
        problem: Observations with reliable normals, under the chosen effects.
        before: Fit of few of them.
        choices: Options of the user.
        fit: Function that fits a model.
    """
    lights = before.point.lights
    had = [len(light.log_tone) > 0 for light in lights]
    if choices.tone == "off" or problem.none_held_out:
        return Selection(before, [Decision(has) for has in had])
    sample = comparison_sample(problem, choices)
    freed = [light if has else light.with_curves() for light, has in zip(lights, had, strict=True)]
    curved = fit("tone curves", sample, before.with_lights(freed), TONE_SCHEDULE)
    without, richer = (held_out_losses(sample, one.point) for one in (before, curved))
    evidence = []
    for k, light in enumerate(curved.point.lights):
        one = _compare_light(k, without, richer)
        gain = (one.held_out_loss_without or 0.0) / max(one.held_out_loss_with or 1.0, 1e-12) - 1
        kept = one.kept and gain > LEAST_TONE_GAIN and not light.implausible_tone
        evidence.append(Decision(True) if had[k] else msgspec.structs.replace(one, kept=kept))
    if all(one.kept for one in evidence):
        return Selection(curved, evidence)
    if not any(one.kept and not has for one, has in zip(evidence, had, strict=True)):
        return Selection(before, evidence)
    mixed = [new if one.kept else old for new, old, one in zip(curved.point.lights, lights, evidence, strict=True)]
    return Selection(fit("tone curves", sample, before.with_lights(mixed), TONE_SCHEDULE), evidence)


def select_distances(problem: JointProblem, before: Fit, choices: SolveOptions, fit: Fitting) -> Selection:
    """Choose distances of lights.

    Materials and all lights are fitted at each distance: those fitted in far lights make up for errors of these.  A
    light stays near only if, given the materials, it also explains its observations better than a far one does.  The
    weaker of the two decisions determines its distance.

    Args:
        problem: Observations with reliable normals, under the chosen effects.
        before: Fit of few of them.
        choices: Options of the user.
        fit: Function that fits a model.
    """
    lights = before.point.lights
    pairs = zip(lights, problem.blocks, strict=True)
    known = [light.curvature > 0 or light.fixed.any() or block.place is None for light, block in pairs]
    evidence = [Decision(light.curvature > 0) for light in lights]
    if choices.distance == "off" or problem.none_held_out or all(known):
        return Selection(before, evidence)
    sample = comparison_sample(problem, choices)
    asked = [k for k, one in enumerate(known) if not one]

    def fit_at(curvatures: dict[int, float], start: Fit = before, schedule: FitSchedule = DISTANCE_SCHEDULE) -> Fit:
        """Return the fit with lights of these curvatures, by number of the light."""
        placed = list(start.point.lights)
        for k, c in curvatures.items():
            placed[k] = msgspec.structs.replace(placed[k], curvature=c)
        return fit("distances", sample, start.with_lights(placed), schedule)

    losses, last = [], before  # each fit goes on from the one before
    for c in (0.0, *CURVATURES):
        last = fit_at(dict.fromkeys(asked, c), last)
        losses.append(held_out_losses(sample, last.point))
    likeliest = {k: _select_curvature(k, losses) for k in asked}
    evidence = [likeliest[k][1] if k in likeliest else one for k, one in enumerate(evidence)]
    curvature = {k: c for k, (c, one) in likeliest.items() if one.kept}
    if not curvature:
        return Selection(before, evidence)
    chosen = fit_at(curvature)
    both = (dict.fromkeys(curvature, 0.0), curvature)
    far, there = (held_out_losses(sample, fit_at(one, chosen, LIGHTS_ONLY).point) for one in both)
    for k in curvature:
        given = _compare_light(k, far, there, LEAST_DISTANCE_MARGIN)
        evidence[k] = min(evidence[k], given, key=lambda one: one.margin or 0.0)
    kept = {k: c * distance_share(evidence[k]) for k, c in curvature.items() if evidence[k].kept}
    return Selection(fit_at(kept) if kept else before, evidence)


def _select_curvature(k: int, losses: Sequence[Losses]) -> tuple[float, Decision]:
    """Return the best of `CURVATURES` for light k and the evidence for it; losses: far away, then at each of them."""
    tried = [_compare_light(k, losses[0], near, LEAST_DISTANCE_MARGIN) for near in losses[1:]]
    best = min(range(len(tried)), key=lambda i: (not tried[i].kept, tried[i].held_out_loss_with or 0.0))
    return CURVATURES[best], tried[best]


def distance_share(evidence: Decision) -> float:
    """Return the weight of the richer model, from 0 at `LEAST_DISTANCE_MARGIN` standard errors to 1 at `CLEARLY_FOR`.

    It is continuous, so that rounding does not decide.
    """
    return float(
        np.clip(((evidence.margin or 0.0) - LEAST_DISTANCE_MARGIN) / (CLEARLY_FOR - LEAST_DISTANCE_MARGIN), 0.0, 1.0)
    )


def _compare_light(k: int, without: Losses, richer: Losses, least: float = CLEARLY_FOR) -> Decision:
    """Return the evidence of light k alone for the richer model."""
    losses = [Losses([of.values[k]], [of.clusters[k]]) for of in (without, richer)]
    return compare_models(losses[0], losses[1], least)
