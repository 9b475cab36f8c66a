"""Model choices that a scene needs, made in the model that gives the answer.

effects     No shadows, shadows of the given meshes, or shadows with interreflection, on fewer observations and cells.
            Shadows are fitted from every first guess, and the model without them goes one step from the best result.
            If held-out observations do not clearly support shadows then, both models continue from there, and the
            marginal likelihood decides: few clusters kept shadows on exact spheres that have none (margin −0.7, log
            Bayes factor −1,567).  Interreflection needs shadows, and a marginal likelihood that supports it.
background  The surroundings that photos show are observations of a light.  Where the objects are clearly against them,
            their errors are twice as wide, or four times; beyond that they are left out.
tone        Exponents of tone curves are freed for all photos, at first for one step.  A light keeps its curves under
            three conditions: the evidence supports them, the loss without them is more than `LEAST_TONE_GAIN` higher,
            and they end within the range of real cameras.  An exponent also fits some errors of the rest of the model,
            such as wrong normals.
distance    The marginal likelihoods of a light at infinity and at `CURVATURES` decide.  They use all fitted
            observations; the few that are held out decide differently from draw to draw.  Wrong normals in few places
            favour a near light, too, so its log Bayes factor counts less its own error (2).
ground      The shadows on the ground are observations of a light if they lie where the light that the objects tell of
            casts them.  A cut-out or a picture of a floor has none, and a wrong plane has others.
roughness   With few materials, the start decides which local minimum a fit reaches: a smooth surface in soft light
            looks like a rough one in sharp light.  Of the fits from several starts, the one of least held-out loss
            continues.

Models that are compared are fitted from one start with the same number of steps: one that got more descent would seem
better.  Shadows and tone curves compare two models that are fitted to the same observations with reliable normals, by
held-out observations.  These are whole clusters of mirror directions (`factorlib.inference.model.observed`).  Let a_i
and b_i be the mean robust losses of light i without and with the richer part, and n_i the number of its held-out
observations.  Then

    d = Σ_i n_i (log a_i − log b_i) / Σ_i n_i                                                                      (1)

is the difference of the logarithms of geometric means over lights.  It is a log likelihood ratio for residuals whose
unknown variance differs from light to light.  A light with wrong normals has many times the loss of another, and in a
plain sum its change would outweigh all others.

Neighbouring residuals are correlated, so the standard error of d is taken over clusters.  Let A_k and B_k be the summed
losses of cluster k of light i, and K the number of clusters.  By the delta method, log a_i − log b_i has the variance
K/(K−1) Σ_k (A_k/ΣA − B_k/ΣB)².  Few clusters estimate it badly, so d in standard errors is distributed as Student's t,
with K − 1 degrees of freedom, and over several lights with those of Welch and Satterthwaite.  The margin is the
standard normal deviate of the same probability.

A log Bayes factor of models that are both wrong has an error, too (Vuong 1989, "Likelihood ratio tests for model
selection and non-nested hypotheses").  Let D_k be the change of Σ ρ(r)/2T of cluster k by the richer model.  Then

    s² = K/(K−1) Σ_k (D_k − D̄)²                                                                                     (2)

is its variance.  Where errors of normals decide, the factor is clear only if it is two s above a threshold, or below.
On data/eames those of lights that are near are 298 ± 54 and 56 ± 19, and that of one that is far is 13 ± 21.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr, ndtri, softmax, stdtr

from factorlib.inference.fit.fit import LIGHT_TEMPERATURE, Fit, FitSchedule
from factorlib.inference.fit.fit_runner import FitRunner, SolveState
from factorlib.inference.model.blocks import FIT_LOSS
from factorlib.inference.model.cast_shadows import cast_shadows
from factorlib.inference.model.materials import Point
from factorlib.inference.model.normal_errors import with_normal_errors
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import SolveOptions
from factorlib.results.materials import Decision
from factorlib.robust import TINY

LEAST_LOSS = 1e-4  # added to every loss, in σ² of the noise model: two losses far below it count as equal
ONE_CLUSTER = 1.0  # variance of log a_i − log b_i in a light with one cluster, from which none can be estimated
# Thresholds, in standard errors, of evidence from held-out observations.
CLEARLY_AGAINST = -2.0
CLEARLY_FOR = 2.0
WEAKLY_FOR = 1.0
# Observations and cells of a light in comparisons of models.
TRIAL_OBSERVATIONS = 1000
TRIAL_CELLS = 180
TRIAL = FitSchedule(light_steps=3, descents=(6, 4))
CONTINUED_TRIAL = FitSchedule(light_steps=2, descents=(4, 2), estimate_first=False)
BACKGROUND_SCHEDULE = FitSchedule(light_steps=2, descents=(6,))
PAIR_SCHEDULE = FitSchedule(light_steps=2, descents=(6,), estimate_first=False)
AFTER_BOUNCES = FitSchedule(descents=(2,))
ONE_STEP = FitSchedule(descents=(1,), estimate_first=False)
TONE_SCHEDULE = FitSchedule(descents=(8,), estimate_first=False)
# Least relative gain of the held-out loss.  Under two standard errors alone, a photo with a wrong pose got a curve
# (margin 3.0, captured set of seed 7), and k_d was 30 % wrong instead of 13 %.
LEAST_TONE_GAIN = 0.25
VERY_STRONG = 5.0  # log Bayes factor of very strong evidence (Kass and Raftery 1995)
# Curvatures of lights 20, 10 and 5 RMS distances away.  A chair's points are 0.4 m from their centre, and a room's
# walls and lamps 2 to 8 m.
CURVATURES = (0.05, 0.1, 0.2)
DISTANCE_SCHEDULE = FitSchedule(light_steps=2, descents=(2,), estimate_first=False)
LIGHTS_ONLY = FitSchedule(light_steps=3, materials_fixed=True)
TEMPERED_LIGHTS = FitSchedule(descents=(0, 3), temperature_factor=LIGHT_TEMPERATURE, materials_fixed=True)
WIDEST = 4.0  # largest width of a background: a factor of 5 in radiance, at one standard deviation
LEAST_CORRELATION = 0.3  # of shadows on the ground, predicted and observed


class Losses(NamedTuple):
    """Robust losses of the observations that decide, by light, and their cluster numbers."""

    values: list[Float[np.ndarray, " n"]]
    clusters: list[Int[np.ndarray, " n"]]

    def one_light(self, k: int) -> Losses:
        """Return the losses of light k alone."""
        return Losses([self.values[k]], [self.clusters[k]])


def held_out_losses(problem: JointProblem, point: Point) -> Losses:
    """Return the losses of the held-out observations at a point; of every observation if none is held out."""
    held_out = problem.held_out()
    return Losses(held_out.losses(point), [block.clusters() for block in held_out.blocks])


def compare_models(simpler: Losses, richer: Losses, least: float) -> Decision:
    """Compare two models: keep the richer one if d of (1) exceeds `least` standard errors.

    Without held-out observations the richer model is not kept.

    Args:
        simpler: Losses of the simpler model.
        richer: Losses of the richer model, of the same observations.
        least: Threshold in standard errors.

    >>> same = Losses([np.array([1.0, 2.0, 3.0])], [np.array([0, 1, 2])])
    >>> compare_models(same, same, CLEARLY_FOR).accepted, compare_models(same, same, CLEARLY_AGAINST).accepted
    (False, True)
    """
    counts = np.array([len(values) for values in richer.values])
    if not counts.sum():
        return Decision(False)
    variances = []
    freedom = []
    logs = []
    for a, b, cluster in zip(simpler.values, richer.values, richer.clusters, strict=True):
        # A_k and B_k, then log a_i − log b_i and its variance over clusters
        sums_pair = [np.bincount(cluster, losses + LEAST_LOSS) for losses in (a, b)]
        shares = [sums / max(float(sums.sum()), TINY) for sums in sums_pair]
        logs.append([np.log(np.mean(losses) + LEAST_LOSS) if len(losses) else 0.0 for losses in (a, b)])
        number = len(sums_pair[0])
        spread = float(np.sum((shares[0] - shares[1]) ** 2))
        variances.append(number / (number - 1) * spread if number > 1 else ONE_CLUSTER)
        freedom.append(max(number - 1.0, 1.0))
    share = counts / counts.sum()
    # d of (1), its standard error and degrees of freedom, and the margin
    d = float(share @ [log_pair[0] - log_pair[1] for log_pair in logs])
    parts = share**2 * np.array(variances)
    degrees = parts.sum() ** 2 / max(float(parts**2 @ (1 / np.array(freedom))), TINY)
    t = d / max(float(np.sqrt(parts.sum())), 1e-12)
    margin = float(np.copysign(ndtri(max(stdtr(max(degrees, 1.0), -abs(t)), TINY)), t))
    loss_with, loss_without = (float(np.exp(share @ [log_pair[k] for log_pair in logs])) for k in (1, 0))
    return Decision(margin > least, loss_with, loss_without, margin)


def simultaneous_margin(number: int) -> float:
    """Return `CLEARLY_FOR` with Bonferroni's correction for several margins.

    Any of them exceeds it by chance as seldom as a single margin exceeds `CLEARLY_FOR`.  Every light may get tone
    curves; under the threshold of one light, one of many would often get them by chance.

    Args:
        number: Number of margins.

    >>> round(simultaneous_margin(1), 9), round(simultaneous_margin(6), 2)
    (2.0, 2.67)
    """
    return float(-ndtri(ndtr(-CLEARLY_FOR) / number))


class Selection(msgspec.Struct, frozen=True):
    """Result of a model comparison: fit of the chosen model, and one decision per light (one in all for bounces)."""

    fit: Fit
    evidence: list[Decision]


def gains(decision: Decision, least: float, negligible: float = 0.0) -> bool:
    """Return True if the loss without the richer part is higher by more than a share of the loss with it.

    Args:
        decision: Losses with the part and without it.
        least: Least share.
        negligible: Loss that is added to both.
    """
    with_part, without = decision.held_out_loss_with or 0.0, decision.held_out_loss_without or 0.0
    return without + negligible > (1 + least) * (with_part + negligible)


def comparison_sample(problem: JointProblem, fit: Fit, options: SolveOptions) -> JointProblem:
    """Return the subsample of observations on which models are compared, with errors of normals as at a fit."""
    sample = problem.subsample(min(TRIAL_OBSERVATIONS, options.observations), options.seed)
    return with_normal_errors(sample, fit.point)


def select_effects(problem: JointProblem, starts: list[Fit], options: SolveOptions, run: FitRunner) -> SolveState:
    """Choose shadows by held-out observations or marginal likelihood, and interreflection by marginal likelihood.

    Args:
        problem: Observations with reliable normals.
        starts: First guesses, of which the best result continues, or one fit.
        options: Options of the user.
        run: Runner of the fits.
    """
    sample = comparison_sample(problem, starts[0], options).keep_backgrounds([]).keep_grounds([])
    hidden = any(block.visibility is not None for block in problem.blocks)
    shadows = options.self_shadowing if hidden else "off"
    bounces = options.interreflection if problem.has_bounces else "off"

    def fit_best(name: str, with_shadows: bool, with_bounces: bool) -> tuple[Fit, Losses]:
        """Return the best fit of one model from the starts, and its losses."""
        model = sample.with_effects(with_shadows, with_bounces)
        fits = [run.fit(name, model, fit, CONTINUED_TRIAL if fit.fitted else TRIAL) for fit in starts]
        results = [(fit, held_out_losses(model, fit.point)) for fit in fits]
        return min(results, key=lambda result: _log_geometric_mean(result[1]))

    if shadows == "off":
        fit, _ = fit_best("no shadows", False, False)
        return SolveState(fit, fit)
    forced = bounces == "on"
    with_shadows = "shadows and bounces" if forced else "shadows", True, forced
    fit, losses = fit_best(*with_shadows)
    decision = Decision(True)
    if shadows == "auto" and not problem.none_held_out:
        models = [sample.with_effects(False, False), sample.with_effects(True, forced)]
        plain = run.fit("shadows", models[0], fit, ONE_STEP)
        decision = compare_models(held_out_losses(models[0], plain.point), losses, CLEARLY_FOR)
        if not decision.accepted:  # both continue from one fit
            plain, fit = fit_both("shadows", models, fit, run)
            decision = decide_by_likelihood(plain, fit, -VERY_STRONG)
            if not decision.accepted:
                return SolveState(plain, plain, decision)
    if bounces == "auto":
        selection = select_interreflection(sample, fit, run)
        return SolveState(selection.fit, selection.fit, decision, selection.evidence[0])
    return SolveState(fit, fit, decision, Decision(forced))


def fit_both(phase: str, models: list[JointProblem], start: Fit, run: FitRunner) -> list[Fit]:
    """Return the fits of two models from one start, under its hyperparameters."""
    return [run.fit(phase, model, start, PAIR_SCHEDULE) for model in models]


def decide_by_likelihood(simpler: Fit, richer: Fit, least: float) -> Decision:
    """Keep the richer model if the log Bayes factor of the marginal likelihoods exceeds `least`."""
    log_bayes_factor = (simpler.value - richer.value) / 2
    return Decision(log_bayes_factor > least, log_bayes_factor=log_bayes_factor)


def log_bayes_factors(problem: JointProblem, simpler: Fit, richer: Fit) -> Float[np.ndarray, "2 k"]:
    """Return the log Bayes factor of each light between two fits with the same materials, and its error s of (2).

    Args:
        problem: Observations of both fits.
        simpler: Fit of the simpler model.
        richer: Fit of the richer model.
    """
    problem = problem.without_held_out()
    errors = []
    pairs = [problem.tabulated(fit.point) for fit in (simpler, richer)]
    for k, block in enumerate(problem.blocks):
        without, with_part = (
            FIT_LOSS.evaluate(lights[k].residuals()).sum(1) / (2 * fit.hyperparameters[k].temperature)
            for lights, fit in zip(pairs, (simpler, richer), strict=True)
        )
        by_cluster = np.bincount(block.clusters(), without - with_part)
        number = len(by_cluster)
        errors.append(float(np.sqrt(number * by_cluster.var(ddof=1))) if number > 1 else np.inf)
    return np.array([(np.array(simpler.light_values) - richer.light_values) / 2, errors])


def select_interreflection(sample: JointProblem, start: Fit, run: FitRunner) -> Selection:
    """Choose interreflection by the marginal likelihoods of two fits, with and without it, from one start.

    Args:
        sample: Observations on which models are compared.
        start: Fit with shadows alone.
        run: Runner of the fits.
    """
    models = [sample.with_effects(True, with_bounces) for with_bounces in (False, True)]
    phase = "shadows and bounces"
    fits = fit_both(phase, models, start, run)
    decision = decide_by_likelihood(fits[0], fits[1], VERY_STRONG)
    index = int(decision.accepted)
    return Selection(run.fit(phase, models[index], fits[index], AFTER_BOUNCES), [decision])


def _log_geometric_mean(losses: Losses) -> float:
    """Return the log of the geometric mean over lights of their mean losses, weighted by observations.

    It is rounded to six digits, so that rounding errors do not decide.
    """
    counts = [len(values) for values in losses.values]
    logs = [len(values) and np.log(max(float(np.mean(values)), 1e-12)) for values in losses.values]
    return round(float(np.dot(counts, logs)) / max(sum(counts), 1), 6)


def select_backgrounds(problem: JointProblem, before: Fit, options: SolveOptions, run: FitRunner) -> Selection:
    """Choose by marginal likelihood the lights that are also observed by the surroundings that photos show.

    Materials and all lights are fitted with all backgrounds.  Given these materials, each light is fitted with its
    background and without it.  If the observations are strongly against a background, its errors are twice as wide, and
    it is left out beyond `WIDEST`.  Observations say little about most of the directions that it shows.

    Args:
        problem: Observations with reliable normals, with the backgrounds of all lights.
        before: Fit to the comparison sample.
        options: Options of the user.
        run: Runner of the fits.
    """
    pairs = zip(problem.blocks, before.point.lights, strict=True)
    candidates = [block.background is not None and not light.fixed.any() for block, light in pairs]
    if options.background == "off" or not any(candidates):
        return Selection(before, [Decision(False) for _ in candidates])
    sample = comparison_sample(problem, before, options)
    without = sample.keep_backgrounds([])
    widths = np.array(candidates, float)
    factors = np.zeros(len(candidates))
    fit = before
    while widths.any():
        model = sample.keep_backgrounds(widths.tolist())
        fit = run.fit("background", model, fit, BACKGROUND_SCHEDULE)
        start = run.fit("background", without, fit, TEMPERED_LIGHTS)
        fits = [run.fit("background", each, start, LIGHTS_ONLY) for each in (without, model)]
        compared, errors = log_bayes_factors(without, *fits)
        factors = np.where(widths > 0, compared, factors)
        # the worst first: they shift the scale of all
        contradicted = (widths > 0) & (factors + CLEARLY_FOR * errors < -VERY_STRONG)
        doubtful = contradicted & (factors < factors.min(where=contradicted, initial=0.0) / 2)
        if not doubtful.any():
            break
        widths[doubtful] *= 2
        widths[widths > WIDEST] = 0
    if not widths.any():
        fit = before
    evidence = [
        Decision(bool(width), log_bayes_factor=float(factor), width=float(width)) if has else Decision(False)
        for width, factor, has in zip(widths, factors, candidates, strict=True)
    ]
    return Selection(fit, evidence)


def select_grounds(problem: JointProblem, fit: Fit, options: SolveOptions) -> list[Decision]:
    """Choose the lights that are also observed by shadows on the ground.

    Args:
        problem: Observations, with the grounds of all lights.
        fit: Fit to the objects alone.
        options: Options of the user.
    """
    decisions = []
    for block, light in zip(problem.blocks, fit.point.lights, strict=True):
        if block.ground is None or options.ground == "off" or light.fixed.any():
            decisions.append(Decision(False))
            continue
        correlation = cast_shadows(block.ground, light.unit_lobes, problem.operator).correlation(light.weight)
        decisions.append(Decision(round(correlation, 6) >= LEAST_CORRELATION, correlation=correlation))
    return decisions


def select_tone_curves(problem: JointProblem, start: Fit, options: SolveOptions, run: FitRunner) -> Selection:
    """Choose by held-out observations which lights get tone curves, and fit them.

    Args:
        problem: Observations with reliable normals, under the chosen effects.
        start: Fit to the comparison sample.
        options: Options of the user.
        run: Runner of the fits.
    """
    curved_before = [len(light.log_tone) > 0 for light in start.point.lights]
    if options.tone == "off" or problem.none_held_out:
        return Selection(start, [Decision(has) for has in curved_before])
    sample = comparison_sample(problem, start, options)
    freed = [
        light if has else msgspec.structs.replace(light, log_tone=np.zeros_like(light.log_exposure))
        for light, has in zip(start.point.lights, curved_before, strict=True)
    ]

    def compare(schedule: FitSchedule) -> tuple[Fit, Fit, list[Decision]]:
        """Return the fits without curves and with them, and a comparison of each light."""
        plain, curved = (
            run.fit("tone curves", sample, start.with_lights(lights), schedule)
            for lights in (start.point.lights, freed)
        )
        without, with_curves = (held_out_losses(sample, fit.point) for fit in (plain, curved))
        pairs = ((without.one_light(k), with_curves.one_light(k)) for k in range(len(freed)))
        return plain, curved, [compare_models(*pair, simultaneous_margin(len(freed))) for pair in pairs]

    plain, curved, compared = compare(ONE_STEP)
    if any(gains(decision, LEAST_TONE_GAIN / 2) for decision in compared):
        plain, curved, compared = compare(TONE_SCHEDULE)
    evidence = []
    for has, decision, light in zip(curved_before, compared, curved.point.lights, strict=True):
        accepted = decision.accepted and gains(decision, LEAST_TONE_GAIN) and not light.implausible_tone
        evidence.append(Decision(True) if has else msgspec.structs.replace(decision, accepted=accepted))
    if all(decision.accepted for decision in evidence):
        return Selection(curved, evidence)
    if not any(decision.accepted and not has for decision, has in zip(evidence, curved_before, strict=True)):
        return Selection(plain, evidence)
    pairs = zip(curved.point.lights, plain.point.lights, strict=True)
    mixed = [pair[0 if decision.accepted else 1] for pair, decision in zip(pairs, evidence, strict=True)]
    return Selection(run.fit("tone curves", sample, plain.with_lights(mixed), TONE_SCHEDULE), evidence)


def select_distances(problem: JointProblem, before: Fit, options: SolveOptions, run: FitRunner) -> Selection:
    """Choose distances of lights by their marginal likelihoods.

    Materials adapt to the distances at which they are fitted.  Each light is therefore compared twice: with materials
    and lights fitted at infinity and at each of `CURVATURES`, and, if that favours a near light, with the materials of
    the near lights.  The smaller Bayes factor counts.  A light that is less likely at one distance than at infinity is
    not tried nearer.

    Args:
        problem: Observations with reliable normals, under the chosen effects.
        before: Fit to the comparison sample.
        options: Options of the user.
        run: Runner of the fits.
    """
    pairs = enumerate(zip(before.point.lights, problem.blocks, strict=True))
    candidates = [k for k, (light, block) in pairs if not (light.curvature or light.fixed.any() or block.place is None)]
    evidence = [Decision(light.curvature > 0) for light in before.point.lights]
    if options.distance == "off" or not candidates:
        return Selection(before, evidence)
    sample = comparison_sample(problem, before, options)

    def fit_with_curvatures(
        curvatures: dict[int, float], start: Fit = before, schedule: FitSchedule = DISTANCE_SCHEDULE
    ) -> Fit:
        """Return the fit with lights of these curvatures, by number of the light."""
        pairs = enumerate(start.point.lights)
        lights = [msgspec.structs.replace(light, curvature=curvatures.get(k, light.curvature)) for k, light in pairs]
        return run.fit("distances", sample, start.with_lights(lights), schedule)

    far = np.array(fit_with_curvatures(dict.fromkeys(candidates, 0.0)).light_values)
    by_curvature = np.full((len(CURVATURES), len(far)), -np.inf)
    supported = candidates
    for row, curvature in zip(by_curvature, CURVATURES, strict=True):
        if supported:
            values = np.array(fit_with_curvatures(dict.fromkeys(supported, curvature)).light_values)
            row[supported] = (far - values)[supported] / 2
            supported = [k for k in supported if row[k] > 0]
    factor = by_curvature.max(0)
    errors = np.zeros(len(far))
    near = {k: float(softmax(by_curvature[:, k]) @ CURVATURES) for k in candidates if factor[k] > VERY_STRONG}
    if near:
        near_fit = fit_with_curvatures(near)
        alternatives = (dict.fromkeys(near, 0.0), near)
        given_materials, errors = log_bayes_factors(
            sample, *(fit_with_curvatures(curvatures, near_fit, LIGHTS_ONLY) for curvatures in alternatives)
        )
        factor[list(near)] = np.minimum(factor, given_materials)[list(near)]
    clear = factor - CLEARLY_FOR * errors
    for k in candidates:
        evidence[k] = Decision(bool(clear[k] > VERY_STRONG), log_bayes_factor=float(factor[k]))
    curvatures = {k: c * near_share(clear[k]) for k, c in near.items() if evidence[k].accepted}
    return Selection(fit_with_curvatures(curvatures) if curvatures else before, evidence)


def near_share(log_bayes_factor: float) -> float:
    """Return the share of its likely curvature that a light gets: 0 up to `VERY_STRONG`, then growing to 1.

    It is 2p − 1, with p the probability of a near light under prior odds of exp(−`VERY_STRONG`).  Without a jump,
    rounding does not decide.
    """
    return float(np.tanh(max(log_bayes_factor - VERY_STRONG, 0.0) / 2))
