"""The joint solve: from all observations, one reflectance per material and one light per illumination.

Writes materials.json, lobes.parquet, exposures.json, convergence.parquet, uncertainty.json and coverage/<illumination>.exr.
"""

import logging
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from factorlib.checkpoint import Checkpoint
from factorlib.dataset.schema import LightSlice
from factorlib.diagnose.coverage import relative_standard_errors
from factorlib.diagnose.identifiability import poorly_explained, undetermined_by_answer, undetermined_by_observations, unlikely_curves
from factorlib.diagnose.uncertainty import GAUGE, StandardErrors, standard_errors
from factorlib.diagnose.warnings import photos_without_light, unlinked_sets, unseen_materials
from factorlib.errors import InputError
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.light.lobes import Lobes, write_lobes
from factorlib.model.components import connected_components
from factorlib.model.gauge import RULE
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations, usable
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem, Spread
from factorlib.reflection import reflection_operator
from factorlib.solve import options
from factorlib.solve.bundle import Solution, models, solve
from factorlib.solve.earlier import Earlier, read_earlier
from factorlib.solve.evidence import Evidence
from factorlib.solve.history import Event, Report, Run
from factorlib.solve.options import Bundle
from factorlib.solve.paper import REPORTS, Paper, Prior, Samplings
from factorlib.solve.paper import solve as solve_as_the_paper
from factorlib.solve.resume import Journal
from factorlib.solve.rounds import from_nothing
from factorlib.solve.warm import from_earlier
from factorlib.stage import Inputs, Progress
from factorlib.urm.exposure import at_one_exposure, relative_exposures
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations, concatenate, read_observations
from factorlib.wholefile import writing

EXPOSURE_DIFFERS = 1.5  # by which factor what is found may differ from EXIF without a word
log = logging.getLogger("factorlib.solve")
BUNDLE, PAPER, NOISE, LOSS = Bundle(), Paper(), Noise(), Loss()  # where defaults stand
OF_BUNDLE = frozenset(Bundle.__struct_fields__)


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """solver: `paper` is the baseline, with lobes, samplings of each observation and a prior of its own (paper_…);
    operator: how a lobe's reflection is computed, `auto` being `network`, and `paper_network` for the paper's solver;
    merge_degrees: observations this near are merged before solving;  held_out: share of observations that choose the model;
    prior: weight of the paper's tint prior;  noise_…: the noise model, in units of an illumination's mean radiance;
    all others: `factorlib.solve.options.Bundle`.

    The folder `start`, where one is given, holds an earlier solution: materials and lights that have their names there start
    from it, and whether they have specular parts, and whether there are shadows, stays as it was decided there.
    """

    solver: Literal["bundle", "paper"] = "bundle"
    operator: Literal["auto", "network", "closed_form", "reference", "paper_network"] = "auto"
    merge_degrees: Annotated[float, msgspec.Meta(ge=0, le=30)] = 2.0
    lobes: options.Lobes = BUNDLE.lobes
    insert: options.Inserted = BUNDLE.insert
    rounds: options.Rounds = BUNDLE.rounds
    iterations: options.Iterations = BUNDLE.iterations
    polish: options.Polish = BUNDLE.polish
    settle: options.Polish = BUNDLE.settle
    sample: options.Sample = BUNDLE.sample
    tolerance: options.Tolerance = BUNDLE.tolerance
    least_gain: options.Share = BUNDLE.least_gain
    held_out: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.1
    self_shadowing: options.SelfShadowing = BUNDLE.self_shadowing
    specular: options.SpecularParts = BUNDLE.specular
    tone: options.ToneCurves = BUNDLE.tone
    prior: Prior = LOSS.prior
    noise_absolute: Annotated[float, msgspec.Meta(gt=0)] = NOISE.absolute
    noise_relative: Annotated[float, msgspec.Meta(ge=0)] = NOISE.relative
    paper_lobes: options.Lobes = PAPER.lobes
    paper_samplings: Samplings = PAPER.samplings
    paper_prior: Prior = PAPER.prior
    seed: options.Seed = BUNDLE.seed

    @property
    def bundle(self) -> Bundle:
        """What the bundle solver takes of them."""
        return Bundle(**{name: getattr(self, name) for name in self.__struct_fields__ if name in OF_BUNDLE})

    @property
    def paper(self) -> Paper:
        """What the paper's solver takes of them."""
        return Paper(self.paper_lobes, self.paper_samplings, prior=self.paper_prior, seed=self.seed)


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Read the observations, solve, say what is uncertain, write."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # a photo, then an illumination on one thread: how many there are changes no bit
        _main(params, inputs, out, progress, lambda function, items: list(pool.map(function, items)))


def _main(params: Params, inputs: Inputs, out: Path, progress: Progress, spread: Spread) -> None:
    names: list[str] = inputs.facts["dataset.materials"]
    seen = _observations(params, inputs, spread)
    relative = relative_exposures(seen)
    earlier = _earlier(params, inputs, relative)
    problem = _problem(params, inputs, at_one_exposure(seen, relative), spread)
    _warn(undetermined_by_observations(names, problem.blocks))
    if params.solver == "paper":
        solution = solve_as_the_paper(problem, len(names), params.paper, _subsets_to(progress))
    else:
        solution = _solved(params.bundle, problem, names, earlier, inputs, progress)
    _write(out, _Answer(names, problem, solution, relative, params.solver, earlier))


def operator_of(params: Params) -> str:
    """The name of the operator that the solver takes."""
    automatic = {"bundle": "network", "paper": "paper_network"}[params.solver]
    return automatic if params.operator == "auto" else params.operator


class _Read(msgspec.Struct, frozen=True):
    """A photo's usable observations, merged, how many there were, and how many of those were unusable."""

    merged: Observations
    count: int
    unusable: int


def _observations(params: Params, inputs: Inputs, spread: Spread) -> Observations:
    """Of all photos, merged."""
    read = spread(partial(_merged, degrees=params.merge_degrees), sorted(inputs["urm"].glob("*.parquet")))
    for photo in read:
        if photo.unusable:
            log.warning(
                "photo '%s': %d of %d observations are left out, their radiance, normal or view not finite or their weight not positive",
                ", ".join(photo.merged.photos), photo.unusable, photo.count,
            )  # fmt: skip
    return concatenate([photo.merged for photo in read])


def _merged(path: Path, degrees: float) -> _Read:
    read = read_observations(path)
    seen = usable(read)
    return _Read(merge(seen, degrees), len(read), len(read) - len(seen))


def _problem(params: Params, inputs: Inputs, seen: Observations, spread: Spread) -> JointProblem:
    """The joint problem of the observations; what they lack is said."""
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    rotations = {photo: np.array(light.world_from_camera) for photo, light in lights.items() if light.world_from_camera is not None}
    noise = Noise(params.noise_absolute, params.noise_relative)
    blocks = blocks_of_observations(seen, noise, held_out=params.held_out, world_from_camera=rotations, seed=params.seed)
    names = inputs.facts["dataset.materials"]
    _warn([*unseen_materials(names, blocks), *photos_without_light(seen.photos, blocks), *unlinked_sets(names, blocks)])
    operator = reflection_operator(operator_of(params), weights=inputs["train"])
    return JointProblem(blocks, operator, Loss(prior=params.prior), spread)


def _earlier(params: Params, inputs: Inputs, relative: dict[str, float]) -> Earlier | None:
    """The solution to start from, where one is given, its exposures beside what EXIF says."""
    if "start" not in inputs.folders:
        return None
    if params.solver == "paper":
        raise InputError("the paper's solver starts from nothing", key="solve.start", cure="leave it out, or set solve.solver=bundle")
    earlier = read_earlier(inputs["start"])
    exposures = {photo: tuple(e / relative.get(photo, 1.0) for e in channels) for photo, channels in earlier.exposures.items()}
    return msgspec.structs.replace(earlier, exposures=exposures)


def _solved(
    bundle: Bundle, problem: JointProblem, names: list[str], earlier: Earlier | None, inputs: Inputs, progress: Progress
) -> Solution:
    start = from_earlier(earlier, names, bundle.specular) if earlier else from_nothing(len(names))
    if earlier and bundle.self_shadowing == "auto" and earlier.self_shadowing:
        bundle = msgspec.structs.replace(bundle, self_shadowing=earlier.self_shadowing)
    report = _rounds_to(progress, bundle, len(models(problem, bundle.self_shadowing)))
    journal = Journal(Checkpoint(inputs.unfinished / "solve.pt" if inputs.unfinished else None))
    return solve(problem, start, Run(bundle, report, journal=journal))


def _subsets_to(progress: Progress) -> Report:
    return lambda event: progress(event.round + 1, REPORTS + 1, f"subset {event.iteration}: loss {event.loss:.3g}")


def _rounds_to(progress: Progress, bundle: Bundle, models: int) -> Report:
    total, fitted, round_ = models * bundle.rounds + 1, 0, 0  # of the models to choose from, those that are done

    def report(event: Event) -> None:
        """Say how many of all rounds are done."""
        nonlocal fitted, round_
        fitted, round_ = fitted + (event.round < round_), event.round
        of_round = (event.iteration + 1) / bundle.iterations if event.phase == "descent" else 1.0
        done = fitted * bundle.rounds + event.round + min(of_round, 1.0) if event.phase != "polish" else total - 1
        progress(done, total, f"{event.phase} {event.round}: loss {event.loss:.3g}, {event.lobes} lobes")

    return report


def _warn(sentences: Iterable[str]) -> None:
    for sentence in sentences:
        log.warning("%s", sentence)


class _Answer(msgspec.Struct, frozen=True):
    """What is written: the solution of a problem, and where it came from.

    relative: exposure of each photo by EXIF, which the problem's radiances were divided by
    """

    names: list[str]
    problem: JointProblem
    solution: Solution
    relative: dict[str, float]
    solver: str
    earlier: Earlier | None


def _write(out: Path, answer: _Answer) -> None:
    """All files of the stage."""
    names, problem, point = answer.names, answer.solution.shown(answer.problem), answer.solution.point
    errors = standard_errors(problem, point)
    _warn(undetermined_by_answer(names, problem.blocks, point.materials, errors.materials))
    _warn(poorly_explained(problem, point))
    _warn(unlikely_curves(problem.blocks, point.lights))
    components = connected_components(problem.blocks, len(names))
    component = {names[m]: k for k, (members, _) in enumerate(components) for m in members}
    gauge = {"rule": RULE, "component": component, "stderr": GAUGE}
    materials = _as_json(names, point.materials, errors.materials)
    write_json(out / "materials.json", {"materials": materials, "gauge": gauge, "model": _model(answer)})
    uncertainty = {"residual_sigma": errors.deviation, "materials": _as_json(names, errors.materials, None), "gauge": GAUGE}
    write_json(out / "uncertainty.json", uncertainty)
    lights = list(zip(problem.blocks, point.lights, strict=True))
    write_lobes(out / "lobes.parquet", {b.name: Lobes(light.axis, light.sharpness, light.weight * b.unit) for b, light in lights})
    _write_exposures(out / "exposures.json", answer)
    _write_history(out / "convergence.parquet", answer.solution.history)
    _write_coverage(out / "coverage", problem, point, errors)


LOBES_CHOSEN_BY = {"bundle": "held-out loss per round, see convergence.parquet", "paper": "given"}


def _model(answer: _Answer) -> dict[str, Any]:
    """What was decided of the model, and by what: `model` of materials.json."""
    names, solution, blocks = answer.names, answer.solution, answer.problem.blocks
    lights = list(zip(blocks, solution.point.lights, strict=True))
    shadows = {"with": solution.shadows.held_out_loss_with, "without": solution.shadows.held_out_loss_without}
    model = {
        "solver": answer.solver,
        "lobes": {block.name: len(light) for block, light in lights},
        "lobes_chosen_by": LOBES_CHOSEN_BY[answer.solver],
        "held_out_loss": [event.held_out for event in solution.history if event.phase in ("round", "subset")],
        "specular": {name: not bool(solution.lambertian[m]) for m, name in enumerate(names)},
        "specular_chosen_by": _by_name(names, solution.specular),
        "self_shadowing": solution.shadows.kept,
        "self_shadowing_chosen_by": {f"held_out_loss_{name}": loss for name, loss in shadows.items() if loss is not None},
        "tone": {
            photo: {"exponent": float(np.exp(log_tone)), "pivot": block.unit * answer.relative[photo]}
            for block, light in lights
            for photo, log_tone in zip(block.photos, light.log_tone, strict=False)
        },
        "tone_chosen_by": _by_name([block.name for block in blocks], solution.tone),
    }
    if answer.earlier is None:
        return model
    known = set(names) & set(answer.earlier.table.materials), {block.name for block in blocks} & set(answer.earlier.lights)
    return model | {"started_from": {"materials": sorted(known[0]), "illuminations": sorted(known[1])}}


def _by_name(names: list[str], evidence: list[Evidence]) -> dict[str, Any]:
    return {name: msgspec.to_builtins(one) for name, one in zip(names, evidence, strict=False)}


def _as_json(names: list[str], materials: Materials, errors: Materials | None) -> dict[str, Any]:
    """The fixed form of materials.json; standard errors in the same shape, where given."""
    table = {}
    for m, name in enumerate(names):
        diffuse, specular, roughness = materials.diffuse[m].tolist(), materials.specular[m].tolist(), float(materials.roughness[m])
        table[name] = {"diffuse": diffuse, "specular": specular, "roughness": roughness}
        if errors is not None:
            table[name] |= {"alpha": roughness**2, "stderr": _as_json(names, errors, None)[name]}
    return table


def _write_exposures(path: Path, answer: _Answer) -> None:
    """Factors on the lights, and a warning where they differ much from what EXIF says."""
    relative, lights = answer.relative, zip(answer.problem.blocks, answer.solution.point.lights, strict=True)
    beside = {photo: float(np.exp(light.log_exposure[k])) for block, light in lights for k, photo in enumerate(block.photos)}
    for photo, factor in beside.items():
        if relative[photo] != 1 and abs(np.log(factor)) > np.log(EXPOSURE_DIFFERS):
            log.warning(
                "photo '%s': by its EXIF its exposure is %.3g of its light's first photo, by its pixels %.3g: was it made brighter or darker later?",
                photo, relative[photo], factor * relative[photo],
            )  # fmt: skip
    write_json(path, {photo: [factor * relative[photo]] * 3 for photo, factor in beside.items()})


def _write_history(path: Path, history: list[Event]) -> None:
    columns = {name: [getattr(event, name) for event in history] for name in Event.__struct_fields__}
    with writing(path):
        pq.write_table(pa.table(columns), path, compression="zstd")


def _write_coverage(folder: Path, problem: JointProblem, point: Point, errors: StandardErrors) -> None:
    folder.mkdir()
    for illumination in problem.illuminations(point):
        coverage = relative_standard_errors(illumination, problem.loss, errors.deviation)
        write_rgb_exr(folder / f"{illumination.block.name}.exr", coverage, LAT_LONG)
