"""Lights and exposures of photos that take no part in a solve, given its materials.

These are held-out photos, and those of lights that were not selected (`factorlib.inference.surface.light_selection`).
The latter have their lights fitted.

A held-out photo is predicted.  If solved photos share its light, it has that light.
Its exposure relative to them is that of EXIF or `known` where both have one, and else 1.  Otherwise its
light is fitted to its own pixels and surroundings with the materials fixed, so that it tests materials and shape alone.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np

from factorlib.checkpoint import Checkpoint
from factorlib.inference.fit.fit import FitSchedule, initial_fit
from factorlib.inference.fit.fit_runner import FitRunner, Solution, SolveState
from factorlib.inference.fit.start import constant_light
from factorlib.inference.joint_solver import CHOICES, FITS, SolveRequest
from factorlib.inference.model.known import KnownValues
from factorlib.inference.model.materials import Point
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.options import SolveOptions
from factorlib.light.lobes import Lobes
from factorlib.results.materials import Channels, vec3
from factorlib.urm.observations import Observations

LIGHT_STEPS = {name: FITS[name] for name in ("lights", "suns")}
FROM_CONSTANT = FitSchedule(light_steps=10, materials_fixed=True)


def fit_lights_given_materials(
    problem: JointProblem, solution: Solution, options: SolveOptions, checkpoint: Checkpoint = Checkpoint(None)
) -> tuple[dict[str, Lobes], dict[str, Channels]]:
    """Fit lights to the photos of a problem, with the materials of a solution, and return them with the exposures.

    The steps are those of the joint solve, and the materials are known.  Backgrounds are used if the solution uses
    some: otherwise the scale of its materials is arbitrary, and that of a background is not.

    Args:
        problem: Observations of photos whose lights no solved photo shows.
        solution: Result of the solver.
        options: Options of the user.
        checkpoint: File of the states.

    Returns:
        The lobes by illumination, in scene radiance, and each photo's factor on its light.
    """
    materials = solution.point.materials
    problem = msgspec.structs.replace(problem, known=KnownValues(dict(enumerate(materials.rows()))))
    if not any(decision.accepted for decision in solution.backgrounds):
        problem = problem.keep_backgrounds([])
    run = FitRunner(checkpoint, prior=solution.prior)
    start = Point(materials, [constant_light(block, materials, options.cells) for block in problem.blocks])
    first = initial_fit(start)
    state = SolveState(first, first, solution.shadows, solution.interreflection, observations=solution.observations)
    steps = {"start": fit_from_constant, "background": CHOICES["background"]} | LIGHT_STEPS
    point = run.run_steps(steps, SolveRequest(problem, [first], options, run), state).fit.point
    pairs = list(zip(problem.blocks, point.lights, strict=True))
    lobes = {block.name: light.lobes.scale(block.unit) for block, light in pairs}
    factors = [pair for block, light in pairs for pair in zip(block.photos, np.exp(light.log_exposure), strict=True)]
    return lobes, {photo: vec3([factor] * 3) for photo, factor in factors}


def fit_from_constant(request: SolveRequest, state: SolveState) -> SolveState:
    """Fit lights from constant ones."""
    return state.with_fit(request.run.fit("lights", request.light_problem(state), state.fit, FROM_CONSTANT))


def predicted_exposures(
    observations: Observations,
    held_out: Mapping[str, str],
    solved: Mapping[str, str],
    exposures: Mapping[str, Channels],
) -> dict[str, Channels]:
    """Return the exposures of held-out photos of solved lights.

    They are the geometric mean over the solved photos of a light, of each one's exposure times the ratio of both
    exposures by EXIF.

    Args:
        observations: Observations of all photos, with their exposures by EXIF.
        held_out: Illumination by held-out photo.
        solved: Illumination by solved photo.
        exposures: Factor of each solved photo on its light.
    """
    exif = dict(zip(observations.photos, observations.exposures or (None,) * len(observations.photos), strict=True))
    result = {}
    for name, light in held_out.items():
        references = [photo for photo, its_light in solved.items() if its_light == light and photo in exposures]
        known = [exif.get(photo) or np.nan for photo in [name, *references]]
        ratios = np.nan_to_num(known[0] / np.array(known[1:]), nan=1.0)
        if references:
            logs = [np.log(exposures[p]) + np.log(ratio) for p, ratio in zip(references, ratios, strict=True)]
            result[name] = vec3(np.exp(np.mean(logs, axis=0)))
    return result
