"""Cells of a light that split in four while the light's marginal likelihood rises.

Smaller cells obey the same Gaussian process as larger ones.  So, given the materials and the hyperparameters, a light
has a marginal likelihood with either, and lights are independent of each other.  Let F be minus twice the log marginal
likelihood of a light, (1) of `factorlib.inference.fit.likelihood`.  The log Bayes factor of light i for smaller cells
is

    log B_i = (F_i(cells) − F_i(smaller cells))/2                                                                  (1)

The cells of a light split if log B_i exceeds `VERY_STRONG`, and the smaller ones may split again.  Materials and lights
are fitted together after that.  (1) uses all fitted observations.  The few that are held out decide differently from
draw to draw: on three exact spheres they refuse the first splitting (margin −0.24), which (1) supports by 1,200.
"""

from __future__ import annotations

import numpy as np

from factorlib.inference.choices.model_selection import LIGHTS_ONLY, VERY_STRONG
from factorlib.inference.fit.fit import Fit
from factorlib.inference.fit.fit_runner import FitRunner
from factorlib.inference.model.lights import Light
from factorlib.inference.model.materials import Point
from factorlib.inference.model.problem import JointProblem
from factorlib.results.materials import Decision

SPLIT_CELLS = 24  # number of a light's cells that split at once
# Least distance between cells, degrees: the sun's width.  A cell splits only if its neighbours are twice as far.
LEAST_SPACING_DEG = 0.5


def split_cells(phase: str, problem: JointProblem, fit: Fit, limit: int, run: FitRunner) -> tuple[Fit, list[Decision]]:
    """Split the cells with most energy while (1) supports it; return the fit, materials unchanged, and the decisions.

    Args:
        phase: Name of the phase.
        problem: Observations that are fitted, under the chosen effects.
        fit: Fit of the lights.
        limit: Largest number of splittings.
        run: Runner of the fits.
    """
    lights = list(fit.point.lights)
    candidates = list(range(len(lights)))
    evidence: list[Decision] = []
    for _ in range(limit):
        chosen = problem.select_lights(candidates)
        point = Point(fit.point.materials, [lights[k] for k in candidates])
        coarse = Fit(point, [fit.hyperparameters[k] for k in candidates])
        finer = coarse.with_lights([split_brightest(light) for light in coarse.point.lights])
        trials = [run.fit(phase, chosen, start, LIGHTS_ONLY) for start in (coarse, finer)]
        coarse_values, fine_values = (np.array(trial.light_values) for trial in trials)
        log_bayes_factor = (coarse_values - fine_values) / 2  # (1)
        supported = log_bayes_factor > VERY_STRONG
        total = float(log_bayes_factor.sum(where=supported) if supported.any() else log_bayes_factor.max())
        evidence.append(Decision(bool(supported.any()), log_bayes_factor=total))
        for k, *pair, split in zip(candidates, *(trial.point.lights for trial in trials), supported, strict=True):
            lights[k] = pair[int(split)]
        candidates = [candidates[i] for i in np.flatnonzero(supported)]
        if not candidates:
            break
    return fit.with_lights(lights), evidence


def split_brightest(light: Light) -> Light:
    """Return the light with its `SPLIT_CELLS` cells of most energy split; unchanged if some of its cells are known."""
    if light.fixed.any():
        return light
    return light.split(light.brightest_cells(SPLIT_CELLS, 2 * np.radians(LEAST_SPACING_DEG)))
