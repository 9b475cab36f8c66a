"""The joint solve: from all observations, one reflectance per material and one light per illumination.

Writes materials.json, lobes.parquet, exposures.json, convergence.parquet, uncertainty.json and coverage/<illumination>.exr.
"""

import logging
from collections.abc import Callable, Iterable
from functools import partial
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from jaxtyping import Float

from factorlib.checkpoint import Checkpoint
from factorlib.dataset.schema import KnownSlice, LightSlice
from factorlib.diagnose.answer import Answer
from factorlib.diagnose.identifiability import after_solving, before_solving, unusable_observations
from factorlib.diagnose.uncertainty import (
    Posterior,
    StandardErrors,
    in_gauge_of,
    relative_standard_errors,
    standard_errors,
)
from factorlib.errors import InputError
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.images.light_map import read_light_map
from factorlib.jsonfile import write_json
from factorlib.light.prior import read_light_prior
from factorlib.model.known import Known
from factorlib.model.known_light import light_of_ball, light_of_map
from factorlib.model.loss import Loss
from factorlib.model.materials import ROUGHNESS
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations, gathered, usable
from factorlib.model.problem import JointProblem
from factorlib.parquetfile import write_rows
from factorlib.reflection import reflection_operator
from factorlib.results.lobes import write_lobes
from factorlib.results.solution import Earlier, read_earlier
from factorlib.solve import options
from factorlib.solve.few_lobes.options import FewLobes, LobeChoices
from factorlib.solve.few_lobes.options import Run as FewLobesRun
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.fit import sure_ones
from factorlib.solve.history import Event, Solution, of_parts, of_rounds
from factorlib.solve.options import Choices
from factorlib.solve.paper import REPORTS, Paper, Prior, Samplings
from factorlib.solve.paper import solve as solve_as_the_paper
from factorlib.solve.resume import Journal
from factorlib.solve.solve import Run, solve
from factorlib.solve.start import from_earlier, from_nothing, with_decided
from factorlib.stage import Inputs, Progress
from factorlib.urm.observations import (
    Observations,
    at_one_exposure,
    concatenate,
    read_observations,
    relative_exposures,
    with_exposures,
)

log = logging.getLogger("factorlib.solve")
PAPER, NOISE, LOSS = Paper(), Noise(), Loss()  # where defaults stand
ERRORS = 0.07  # share of the time that standard errors take, on data/eames
LEAST_OF_A_BALL = 1000  # pixels: then what they mirror is 6° apart, and cells are 10° wide


class Params(LobeChoices, frozen=True, forbid_unknown_fields=True):
    """Those of the joint solve, those of the solver of few lobes, those of the paper's solver (paper_…), and what all take.

    The folder `start`, where one is given, holds an earlier solution: materials and lights that have their names there start
    from it, and whether there are shadows, and whether surfaces light each other, stays as it was decided there.
    """

    solver: Literal["bundle", "few_lobes", "paper"] = "bundle"
    """bundle: this project's solver, lights are cells; few_lobes: lights are few lobes, for exact scenes; paper: that of Wang, Ritschel
    and Mitra, the baseline."""
    operator: Literal["auto", "network", "closed_form", "reference", "paper_network"] = "auto"
    """How a lobe's reflection is computed; auto: network, and paper_network for the paper's solver."""
    merge_degrees: Annotated[float, msgspec.Meta(ge=0, le=30)] = 2.0
    """Observations of one material and photo whose normals and views differ by less, in degrees, are merged before solving."""
    held_out: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.1
    """Share of the observations that is not fitted and chooses the model."""
    prior: Prior = LOSS.prior
    """Weight of the paper's prior on the tint of lights, for the solver of few lobes."""
    noise_absolute: Annotated[float, msgspec.Meta(gt=0)] = NOISE.absolute
    """Standard deviation of a radiance, as a share of its illumination's mean radiance."""
    noise_relative: Annotated[float, msgspec.Meta(ge=0)] = NOISE.relative
    """Standard deviation of a radiance, as a share of itself; added in squares."""
    paper_lobes: options.Lobes = PAPER.lobes
    """Lobes of an illumination, for the paper's solver."""
    paper_samplings: Samplings = PAPER.samplings
    """How often, on average, the paper's solver samples an observation."""
    paper_prior: Prior = PAPER.prior
    """Weight of the prior on the tint of lights, for the paper's solver."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Read the observations, solve, say what is uncertain, write."""
    names: list[str] = inputs.facts["dataset.materials"]
    progress(0, 1, "observations")
    files = sorted(inputs["urm"].glob("*.parquet"))
    photos = gathered(files, params.merge_degrees, inputs.map, inputs.folders.get("surface"))
    _warn(unusable_observations(photos))
    given = _known(params, inputs)
    seen = with_exposures(concatenate([photo.merged for photo in photos]), given.exposure)
    if params.solver != "bundle":  # the others know no detail of reflectance
        seen = msgspec.structs.replace(seen, detail=None)
    relative = relative_exposures(seen)
    earlier = _earlier(params, inputs, relative)
    seen, known = _held(inputs, given, at_one_exposure(seen, relative), relative)
    problem = _problem(params, inputs, seen, known)
    _warn(before_solving(names, seen.photos, problem.blocks, problem.known))
    solution = _solved(params, problem, earlier, inputs, partial(_share, progress, 1 - ERRORS))
    answer = Answer(names, problem, solution, relative, params.solver, earlier)
    systems, made = 2 * len(problem.blocks), count(1)

    def tick() -> None:
        """Say that one more of the systems that standard errors are made of is there."""
        progress(1 - ERRORS + ERRORS * next(made) / systems, 1, "standard errors")

    errors, coverages = _uncertainty(solution, solution.shown(problem), params, tick)
    _warn(after_solving(answer, errors))
    write_json(out / "materials.json", answer.material_table(errors))
    write_json(out / "uncertainty.json", answer.uncertainty(errors))
    write_lobes(out / "lobes.parquet", answer.lights())
    write_json(out / "exposures.json", answer.exposures())
    write_rows(out / "convergence.parquet", Event, solution.history)
    (out / "coverage").mkdir()
    for name, coverage in coverages.items():
        write_rgb_exr(out / "coverage" / f"{name}.exr", coverage, LAT_LONG)


def _share(progress: Progress, share: float, done: float, total: float, text: str = "") -> None:
    progress(share * done, total, text)


def _problem(params: Params, inputs: Inputs, seen: Observations, known: Known) -> JointProblem:
    lights = _lights(inputs)
    worlds = {photo: light.world_from_camera for photo, light in lights.items()}
    rotations = {photo: np.array(world) for photo, world in worlds.items() if world is not None}
    noise, given = (
        Noise(params.noise_absolute, params.noise_relative),
        {"held_out": params.held_out, "seed": params.seed},
    )
    blocks = blocks_of_observations(seen, noise, world_from_camera=rotations, **given)
    automatic = "paper_network" if params.solver == "paper" else "network"
    operator = automatic if params.operator == "auto" else params.operator
    reflection = reflection_operator(operator, weights=inputs["train"])
    return JointProblem(blocks, reflection, Loss(prior=params.prior), inputs.map, known)


def _lights(inputs: Inputs) -> dict[str, LightSlice]:
    return msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])


def _known(params: Params, inputs: Inputs) -> KnownSlice:
    """What dataset.yaml says is known; InputError where the solver holds nothing."""
    known = msgspec.convert(inputs.facts.get("dataset.known", {}), KnownSlice)
    if known != KnownSlice() and params.solver != "bundle":
        cure = "leave `known` out of dataset.yaml, or set solve.solver=bundle"
        raise InputError(f"the solver {params.solver} finds everything itself", key="known", cure=cure)
    return known


def _held(
    inputs: Inputs, given: KnownSlice, seen: Observations, relative: dict[str, float]
) -> tuple[Observations, Known]:
    """The observations without those of mirror balls, and what the solver holds.  Raises InputError where nothing shows what is known."""
    names, slices, shown = list(seen.materials), _lights(inputs), set(np.unique(seen.material).tolist())
    for name in given.materials:
        if names.index(name) not in shown:
            cure = "look at its mask and at the overlays of `align`: both must show it at the same place"
            raise InputError(f"no observation shows material '{name}'", key=f"known.materials.{name}", cure=cure)
    unknown, chrome = (np.nan,) * 3, {ball.material for ball in given.balls.values()}
    rows = {
        names.index(name): np.array(
            [*of.diffuse, *(of.specular or unknown), of.roughness or (ROUGHNESS[0] if name in chrome else np.nan)]
        )
        for name, of in given.materials.items()
    }
    lights = {name: light_of_map(read_light_map(inputs.file(file))) for name, file in given.maps.items()}
    for name, ball in given.balls.items():
        m, photo, world = names.index(ball.material), ball.photo, slices[ball.photo].world_from_camera
        pixels = usable(read_observations(inputs["urm"] / f"{photo}.parquet"))
        pixels = at_one_exposure(pixels.take(pixels.material == m), relative)
        of_photo = seen.photo == seen.photos.index(photo)
        rest = ~(of_photo & (seen.material == m))
        if len(pixels) < LEAST_OF_A_BALL or not (of_photo & rest).any():
            fault = f"photo '{photo}' shows {len(pixels)} pixels of the ball, and {(of_photo & rest).sum()} observations of other objects"
            cure = f"the ball needs {LEAST_OF_A_BALL}, and something beside it: look at the overlay of `align`"
            raise InputError(fault, key=f"known.illumination.{name}.chrome", cure=cure)
        turn = np.eye(3) if world is None else np.array(world)
        lights[name], seen = light_of_ball(pixels, rows[m][3:6], turn), seen.take(rest)
    return seen, Known(rows, lights, tuple(sorted({slices[photo].illumination for photo in given.exposure})))


def _earlier(params: Params, inputs: Inputs, relative: dict[str, float]) -> Earlier | None:
    """The solution to start from, where one is given, its exposures beside what EXIF says."""
    if "start" not in inputs.folders:
        return None
    if params.solver != "bundle":
        cure = "leave it out, or set solve.solver=bundle"
        raise InputError(f"the solver {params.solver} starts from nothing", key="solve.start", cure=cure)
    return read_earlier(inputs["start"]).beside(relative)


def _solved(
    params: Params, problem: JointProblem, earlier: Earlier | None, inputs: Inputs, progress: Progress
) -> Solution:
    names = inputs.facts["dataset.materials"]
    if params.solver == "paper":
        paper = Paper(params.paper_lobes, params.paper_samplings, prior=params.paper_prior, seed=params.seed)
        return solve_as_the_paper(problem, len(names), paper, of_rounds(progress, REPORTS))
    if params.solver == "few_lobes":
        few = FewLobes(**_own(params, LobeChoices))
        return few_lobes(problem, len(names), FewLobesRun(few, of_rounds(progress, few.rounds)))
    journal = Journal(Checkpoint(inputs.unfinished / "solve.pt" if inputs.unfinished else None))
    choices = Choices(**_own(params, Choices))
    start = from_earlier(earlier, names) if earlier else from_nothing(len(names))
    choices = with_decided(choices, earlier) if earlier else choices
    return solve(problem, start, Run(choices, of_parts(progress, choices), journal))


def _own(params: Params, struct: type[msgspec.Struct]) -> dict[str, Any]:
    """The parameters that `struct` has."""
    return {name: getattr(params, name) for name in struct.__struct_fields__}


def _uncertainty(
    solution: Solution, problem: JointProblem, params: Params, tick: Callable[[], None]
) -> tuple[StandardErrors, dict[str, Float[np.ndarray, "h w 3"]]]:
    """Standard errors of the materials, and relative ones of each light."""
    if solution.materials:
        of_materials, of_lights = (
            Posterior(of.sampled(params.observations, params.seed), fit, read_light_prior(), tick)
            for of, fit in ((sure_ones(problem), solution.materials), (problem, solution.lights))
        )
        standard, fitted = of_materials.standard_errors(), solution.materials.point.materials
        return in_gauge_of(standard, fitted, solution.point.materials), of_lights.relative_standard_errors()
    errors = standard_errors(problem, solution.point)
    of_light = partial(relative_standard_errors, loss=problem.loss, sigma=errors.deviation)
    relative = problem.spread(of_light, problem.illuminations(solution.point))
    return errors, {block.name: error for block, error in zip(problem.blocks, relative, strict=True)}


def _warn(sentences: Iterable[str]) -> None:
    for sentence in sentences:
        log.warning("%s", sentence)
