"""Suns: light from one direction, where photographs support it.

The sun's disc is half a degree wide and holds a quarter to two thirds of the light where it shines.  Cells spread that
energy over all directions that the observations cannot distinguish, ten degrees and more.  An object in such a light
has no crisp shadow.  The observations determine direction and energy far better than width, and the width of the sun is
known.  Three lights are therefore compared: cells alone, cells with a sun, and, if that is accepted and is not
sunlight, cells with a wide lobe in its place (`replace_brightest`).  In the latter two, cells within `DISC_RADIUS` of
the brightest direction take the radiance of their surroundings, and one lobe is added.  The lobe is as narrow as the
sun, or as wide (`WIDE_SHARPNESS`) as a window or a lamp.  Its direction z and its weight w ≥ 0 minimise

    Σ_i t_i² (r_i + A_i(z) w)²                                                                                       (1)

channel by channel, with t² the weight of the robust loss (0 where clipped and bright enough), A the whitened response.
The residual is linear in w; z is searched over grids, coarse and then fine.  Then cells are fitted anew, around either
lobe and alone; a sun that gains too little in one step is not fitted further.  The sun is kept if its light explains
the observations better than cells alone, holds a share of the light, and is no bluer than the rest (`accept_sun`): air
scatters blue light from the sun into the sky.  Where it is strong and redder than the rest (`is_sunlight`), it is kept
unless the evidence is clearly against it: on a hull, hard shadows lie beside the true ones, and softer light explains
photographs as well.  A lamp is replaced by the wide lobe only if that is clearly better.  All observations decide, not
the held-out ones alone: a sun has five unknowns and replaces those of dozens of cells, so it hardly overfits.
"""

from __future__ import annotations

from functools import partial

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.inference.choices.model_selection import (
    CLEARLY_AGAINST,
    WEAKLY_FOR,
    Losses,
    Selection,
    compare_models,
    gains,
)
from factorlib.inference.fit.fit import LIGHT_TEMPERATURE, Fit, FitSchedule, Hyperparameters
from factorlib.inference.fit.fit_runner import FitRunner
from factorlib.inference.model.blocks import COMPARISON_LOSS, FIT_LOSS
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.lights import Light, UnitLobes
from factorlib.inference.model.materials import Point
from factorlib.inference.model.problem import JointProblem
from factorlib.light.lobes import SUN
from factorlib.results.materials import Decision, FitStatus
from factorlib.robust import TINY

# Radii about the brightest direction: of the cells that a sun replaces, and of those whose radiance they take.
DISC_RADIUS, RING_RADIUS = np.radians([14, 28])
WIDE_SHARPNESS = 1 / np.radians(4) ** 2  # λ of a lobe of 8° between its inflections
BLUR_SHARPNESS = 1 / np.radians(5) ** 2  # λ of the blur under which the brightest direction is found
# Radius and step of the searches, degrees; each is centred on the best direction of the previous one.
GRIDS = ((15.0, 3.0), (4.0, 0.8), (1.0, 0.2))
# Least relative gain of the loss, and least share of the light.  On data/eames and the synthetic sets of seeds 11, 12
# and 13, true suns hold 9 % of the light or more and lower the loss by 1.2 to 15 %.
LEAST_SUN_GAIN = 0.01
LEAST_SUN_SHARE = 0.07
# Least sum of a sun's share of the light and of its warmth, in sunlight.  Of 33 captured maps, by their brightest 15°,
# seven with a sun and a dawn have .95 and more, and the others .66 at most (`studies.measured.captured_lights`).
SUNLIGHT = 0.8
ONE_STEP = FitSchedule(light_steps=1, materials_fixed=True)
AROUND_SUNS = FitSchedule(
    descents=(0, 2), least_temperature=0.1, temperature_factor=LIGHT_TEMPERATURE, materials_fixed=True
)


def select_suns(problem: JointProblem, fit: Fit, run: FitRunner) -> Selection:
    """Choose suns; lights without one stay as they are.

    Args:
        problem: Observations.
        fit: Fit of the lights.
        run: Runner of the fits.
    """
    without_suns = problem.tabulated(fit.point)
    candidates = list(problem.spread(partial(replace_brightest, sharpness=SUN), without_suns))
    evidence = [Decision(bool(cells.light.suns.any())) for cells in without_suns]
    changed = [k for k, cells in enumerate(without_suns) if candidates[k] is not cells.light]
    if not changed:
        return Selection(fit, evidence)

    def fit_anew(
        numbers: list[int], lights: list[Light], schedule: FitSchedule = AROUND_SUNS
    ) -> list[tuple[Illumination, Hyperparameters, FitStatus]]:
        """Fit some lights, by their numbers; return their illuminations, hyperparameters and status."""
        chosen = problem.select_lights(numbers)
        start = Fit(Point(fit.point.materials, lights), [fit.hyperparameters[k] for k in numbers])
        result = run.fit("suns", chosen, start, schedule)
        return list(zip(chosen.tabulated(result.point), result.hyperparameters, result.status, strict=True))

    # cells are fitted anew around each sun, and as much without it; for one step, and if that supports the sun, further
    for schedule, share in ((ONE_STEP, 0.5), (AROUND_SUNS, 1.0)):
        alone = fit_anew(changed, [fit.point.lights[k] for k in changed], schedule)
        with_suns = fit_anew(changed, [candidates[k] for k in changed], schedule)
        for k, cells, sun in zip(changed, alone, with_suns, strict=True):
            evidence[k] = accept_sun(cells[0], sun[0], share)
        kept = {k: sun for k, sun in zip(changed, with_suns, strict=True) if evidence[k].accepted}
        changed = list(kept)
        if not kept:
            return Selection(fit, evidence)
    # a wide lobe in place of each accepted lamp
    lamps = [k for k, sun in kept.items() if not is_sunlight(sun[0].light)]
    replace_widely = partial(replace_brightest, sharpness=WIDE_SHARPNESS)
    wide = fit_anew(lamps, list(problem.spread(replace_widely, [without_suns[k] for k in lamps]))) if lamps else []
    for k, with_wide_lobe in zip(lamps, wide, strict=True):
        decision = compare_illuminations(with_wide_lobe[0], kept[k][0], CLEARLY_AGAINST)
        if not decision.accepted:
            evidence[k] = msgspec.structs.replace(decision, share=evidence[k].share, warmth=evidence[k].warmth)
            del kept[k]
    lights = list(fit.point.lights)
    hyperparameters = list(fit.hyperparameters)
    status = list(fit.status)
    for k, sun in kept.items():
        illumination, hyperparameters[k], status[k] = sun
        lights[k] = illumination.light
    fit = msgspec.structs.replace(fit.with_lights(lights), hyperparameters=hyperparameters, status=status)
    return Selection(fit, evidence)


def replace_brightest(illumination: Illumination, sharpness: float) -> Light:
    """Return the light with one lobe of the given sharpness in place of its brightest cells.

    The light is unchanged if it already has a sun, if it is known, or if its cells are larger than `RING_RADIUS`.
    """
    light = illumination.light
    if light.suns.any() or light.fixed.any() or not len(illumination.block):
        return light
    # brightest direction z of the blurred light, and the ring about it
    overlap = np.exp(BLUR_SHARPNESS * (light.axis @ light.axis.T - 1))
    z = light.axis[int(np.argmax(overlap @ light.energy.sum(1)))]
    away = np.arccos(np.clip(light.axis @ z, -1, 1))
    u = light.log_radiance
    ring = (away >= DISC_RADIUS) & (away < RING_RADIUS)
    if not ring.any():
        return light
    # replace the brightest cells by the median of the ring
    u[:, away < DISC_RADIUS] = np.median(u[:, ring], axis=1)[:, None]
    dimmed = msgspec.structs.replace(illumination, light=light.with_log_radiance(u))
    residual = dimmed.residuals()
    bright_enough = illumination.block.clipped & (residual >= 0)
    trust = np.sqrt(FIT_LOSS.weights(illumination.residuals()) * ~bright_enough)
    # (1): for each z of the grid, w = max(−Σ t² A r, 0)/Σ t² A² by channel
    for radius, step in GRIDS:
        grid = UnitLobes(axes := _grid_around(z, radius, step), np.full(len(axes), sharpness), light.curvature)
        A = dimmed.unit_responses(np.arange(len(illumination.block)), grid) * trust.T[:, :, None]  # [3, n, q]
        along = np.einsum("cnq,nc->cq", A, trust * residual)
        size = np.einsum("cnq,cnq->cq", A, A)
        weight = np.maximum(-along, 0) / np.maximum(size, TINY)
        best = int(np.argmax((weight**2 * size).sum(0)))  # decrease of (1)
        z = axes[best]
        w = weight[:, best]
    return dimmed.light.with_lobes(UnitLobes(z[None], np.array([sharpness])), w)


def compare_illuminations(simpler: Illumination, richer: Illumination, least: float) -> Decision:
    """Return the evidence of all observations for one light against another.

    Args:
        simpler: Observations in the simpler light.
        richer: Observations in the richer light.
        least: Threshold in standard errors.
    """
    number = richer.block.clusters()
    losses = [Losses([illumination.losses(COMPARISON_LOSS)], [number]) for illumination in (simpler, richer)]
    return compare_models(losses[0], losses[1], least)


def accept_sun(cells: Illumination, sun: Illumination, share: float = 1.0) -> Decision:
    """Return the evidence for a sun; it is kept if the light with it is better than cells alone.

    The gain must exceed `WEAKLY_FOR` standard errors and the share `LEAST_SUN_GAIN` of the loss.  A sun in sunlight is
    kept unless the evidence is clearly against it.  The sun must hold at least the share `LEAST_SUN_SHARE` of the light
    and be no bluer than the rest.

    Args:
        cells: Observations in the light of cells alone.
        sun: Observations in the light with a sun.
        share: Factor on the thresholds.
    """
    light = sun.light
    if is_sunlight(light, share):
        evidence = compare_illuminations(cells, sun, CLEARLY_AGAINST)
        accepted = evidence.accepted
    else:
        evidence = compare_illuminations(cells, sun, share * WEAKLY_FOR)
        accepted = evidence.accepted and gains(evidence, share * LEAST_SUN_GAIN) and warmth(light) >= 0
    strong = sun_share(light) >= share * LEAST_SUN_SHARE
    return msgspec.structs.replace(
        evidence, accepted=bool(accepted and strong), share=sun_share(light), warmth=warmth(light)
    )


def is_sunlight(light: Light, share: float = 1.0) -> bool:
    """Return True if the colour and the share of a light's suns are those of the sun, by `share` of the threshold."""
    return sun_share(light) + warmth(light) >= share * SUNLIGHT


def sun_share(light: Light) -> float:
    """Return the share of a light's energy that its suns hold."""
    return float(light.energy[light.suns].sum() / light.energy.sum())


def warmth(light: Light) -> float:
    """Return the logarithm of the ratio of red over blue of a light's suns, less that of the rest."""
    suns = light.energy[light.suns].sum(0)
    by_part = np.log(np.maximum([light.energy.sum(0) - suns, suns], TINY))
    rest, own = by_part[:, 0] - by_part[:, 2]
    return float(own - rest)


def _grid_around(z: Float[np.ndarray, "3"], radius: float, step: float) -> Float[np.ndarray, "q 3"]:
    """Return the directions of a lattice within `radius` of z; radius and spacing `step` are in degrees."""
    lattice = fibonacci_sphere(round(4 * np.pi / np.radians(step) ** 2))
    return lattice[lattice @ z >= np.cos(np.radians(radius))]
