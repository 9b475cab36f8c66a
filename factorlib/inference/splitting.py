"""Cells of a light that split in four while the light's marginal likelihood rises.

Smaller cells obey the same Gaussian process as larger ones.  So, given the materials and the hyperparameters, a light
has a marginal likelihood with either, and lights are independent of each other.  Let F be minus twice the log marginal
likelihood of a light, (1) of `factorlib.inference.likelihood`.  The log Bayes factor of light i for smaller cells is

    log B_i = (F_i(cells) − F_i(smaller cells))/2                                                                  (1)

The cells of a light split if log B_i exceeds `VERY_STRONG`; then materials and lights are fitted anew.  This uses all
fitted observations.  The few that are held out decide differently from draw to draw: on three exact spheres they refuse
the first splitting (margin −0.24), which (1) supports by 1,200.
"""

from __future__ import annotations

import msgspec
import numpy as np

from factorlib.inference.fit import FitSchedule
from factorlib.inference.fit_runner import FitRunner, SolveState
from factorlib.inference.lights import Light
from factorlib.inference.model_selection import LIGHTS_ONLY, VERY_STRONG
from factorlib.inference.options import SolveOptions
from factorlib.inference.problem import JointProblem
from factorlib.results.materials import Decision

AFTER_SPLITTING = FitSchedule(light_steps=2, descents=(3, 2), estimate_first=False)
SPLIT_CELLS = 24  # number of a light's cells that split at once
# Least distance between cells, degrees: the sun's width.  A cell splits only if its neighbours are twice as far.
LEAST_SPACING_DEG = 0.5
# Where the model explains the fitted observations closely, errors of few observations matter: k_d of data/synthetic is
# 13 % wrong with 1,000, 2.6 % with 4,000 and 1.0 % with 8,000.
OBSERVATION_FACTOR = 8  # factor on the number of observations there
# Mean robust loss of a fitted value below which it does, after the first splitting: 0.1 to 0.2 on exact sets, at least
# 0.5 on 17 sets of rendered photographs with wrong normals.
SMALL_LOSS = 0.3


def split_cells(problem: JointProblem, state: SolveState, options: SolveOptions, run: FitRunner) -> SolveState:
    """Split the cells with most energy, at most `SolveOptions.splittings` times, while (1) of any light supports it.

    If the loss after the first splitting is below `SMALL_LOSS`, all later fits use `OBSERVATION_FACTOR` times as many
    observations.

    Args:
        problem: Observations with reliable normals, under the chosen effects.
        state: State with a fit of materials and lights.
        options: Options of the user.
        run: Runner of the fits.
    """
    fit = state.fit
    observations = state.observations
    sample = problem.subsample(observations, options.seed)
    evidence: list[Decision] = []
    for number in range(options.splittings):
        phase = f"splitting {number + 1}"
        finer = [split_brightest(light) for light in fit.point.lights]
        trials = [run.fit(phase, sample, fit.with_lights(lights), LIGHTS_ONLY) for lights in (fit.point.lights, finer)]
        coarse_values, fine_values = (np.array(trial.light_values) for trial in trials)
        log_bayes_factor = (coarse_values - fine_values) / 2  # (1)
        supported = log_bayes_factor > VERY_STRONG
        total = float(log_bayes_factor.sum(where=supported) if supported.any() else log_bayes_factor.max())
        evidence.append(Decision(bool(supported.any()), log_bayes_factor=total))
        if not supported.any():
            break
        # start from the radiance of the replaced cells: the trial's lights fit the previous materials
        pairs = zip(fit.point.lights, finer, strict=True)
        selected = [pair[int(split)] for pair, split in zip(pairs, supported, strict=True)]
        fit = run.fit_and_report(phase, sample, fit.with_lights(selected), AFTER_SPLITTING)
        if number == 0 and sample.fitted_loss(fit.point) < SMALL_LOSS:
            observations = OBSERVATION_FACTOR * observations
            sample = problem.subsample(observations, options.seed)
            fit = run.fit_and_report(phase, sample, fit, AFTER_SPLITTING)
    return msgspec.structs.replace(state.with_fit(fit, splitting=evidence), observations=observations)


def split_brightest(light: Light) -> Light:
    """Return the light with its `SPLIT_CELLS` cells of most energy split; unchanged if some of its cells are known."""
    if light.fixed.any():
        return light
    return light.split(light.brightest_cells(SPLIT_CELLS, 2 * np.radians(LEAST_SPACING_DEG)))
