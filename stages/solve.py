"""Joint solve: one reflectance per material and one light per illumination, from all observations.

Writes materials.json, lobes.parquet, exposures.json, convergence.parquet, uncertainty.json and
coverage/<illumination>.exr.
"""

import logging
from collections.abc import Collection, Iterable, Mapping
from functools import partial
from itertools import count
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from factorlib.checkpoint import Checkpoint
from factorlib.dataset.schema import KnownSlice, LightSlice, solved_photos
from factorlib.errors import InputError
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.images.light_map import read_light_map
from factorlib.inference import options
from factorlib.inference.answer.answer import Answer
from factorlib.inference.answer.identifiability import after_solving, before_solving, unusable_observations
from factorlib.inference.answer.uncertainty import estimate_uncertainty
from factorlib.inference.fit.fit_runner import Event, FitRunner, Solution, solve_progress, subset_progress
from factorlib.inference.fit.start import (
    InitialFit,
    Start,
    start_from_earlier,
    start_from_photos,
    start_from_surface,
    with_earlier_decisions,
)
from factorlib.inference.held_out_photos import fit_lights_given_materials, predicted_exposures
from factorlib.inference.joint_solver import solve
from factorlib.inference.model.blocks import Block, Noise
from factorlib.inference.model.known import extract_known
from factorlib.inference.model.observed import (
    blocks_of_observations,
    gather_observations,
    read_backgrounds,
    read_grounds,
    usable_observations,
)
from factorlib.inference.model.problem import JointProblem
from factorlib.inference.paper_solver import REPORTS, PaperOptions, Prior, Samplings
from factorlib.inference.paper_solver import solve_paper as solve_as_the_paper
from factorlib.jsonfile import read_result, write_json
from factorlib.light.lobes import Lobes
from factorlib.parquetfile import write_rows
from factorlib.reflection import reflection_operator
from factorlib.reflection.operator import Name
from factorlib.results.lobe_table import write_lobes
from factorlib.results.materials import Channels, Model, vec3
from factorlib.results.solution import EarlierSolution, read_earlier_solution
from factorlib.results.surface_table import BEGINNING, read_surface
from factorlib.stage import Inputs, Progress, part_of
from factorlib.urm import observations as urm

log = logging.getLogger("factorlib.inference")
PAPER = PaperOptions()  # defaults of the paper's solver
# Shares of the stage's time on data/eames.
READING = 0.03
ERRORS = 0.07  # standard errors
LIGHT_COST = 0.4  # of a light that is fitted alone, in those of one that takes part in the solve


class Params(options.SolveOptions, frozen=True, forbid_unknown_fields=True):
    """Parameters of the joint solver, of the paper's solver (paper_…), and of both.

    The optional folder `start` holds an earlier solution.  Materials and lights of the same names start from it.
    Its decisions on shadows and interreflection are kept.
    """

    solver: Literal["joint", "paper"] = "joint"
    """Solver; joint: this project's; paper: that of Wang, Ritschel and Mitra, the baseline."""
    operator: Literal["auto", "network", "closed_form", "reference", "paper_network"] = "auto"
    """Reflection operator; auto: network, or paper_network for the paper's solver."""
    merge_degrees: Annotated[float, msgspec.Meta(ge=0, le=30)] = 2.0
    """Angle, in degrees.  Observations of one material and photo whose normals and views differ by less are merged."""
    held_out: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.1
    """Share of held-out observations: they choose the model, and are fitted after that (not by the paper's)."""
    paper_lobes: options.Lobes = PAPER.lobes
    """Number of an illumination's lobes, for the paper's solver."""
    paper_samplings: Samplings = PAPER.samplings
    """Average number of times that the paper's solver samples an observation."""
    paper_prior: Prior = PAPER.prior
    """Weight of the prior on the tint of lights, for the paper's solver."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress, decided: bool = False) -> None:
    """Read the observations, solve, estimate standard errors, and write all of it.

    Args:
        params: Parameters of the stage.
        inputs: Inputs of the stage.
        out: Folder to write to.
        progress: Called with the completed work, its total and the current activity.
        decided: True to keep all choices of the model of the earlier solution in the folder `start`.
    """
    names: list[str] = inputs.facts["dataset.materials"]
    progress(0, 1, "observations")
    read = count(1)
    check(params)
    declared = _known_values(params, inputs)
    slices = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    solved_lights = select_photos(inputs, slices, declared)
    files = sorted(inputs["urm"].glob("*.parquet"))
    photos = gather_observations(
        files,
        params.merge_degrees,
        inputs.map,
        inputs.folders.get("surface"),
        lambda: progress(READING * next(read) / len(files), 1, "observations"),
    )
    solved = [photo for photo, file in zip(photos, files, strict=True) if file.stem in solved_lights]
    _warn(unusable_observations(solved))
    apart = {light.illumination for light in slices.values()} - set(solved_lights.values())
    share = 1 / (1 + LIGHT_COST * len(apart) / len(set(solved_lights.values())))
    progress, last = part_of(progress, 0, share), part_of(progress, share, 1)
    observations = urm.with_exposures(urm.concatenate([photo.merged for photo in solved]), declared.exposure)
    relative = urm.relative_exposures(observations)
    earlier = (
        read_earlier_solution(inputs["start"]).with_relative_exposures(relative) if "start" in inputs.folders else None
    )
    problem = _build_problem(params, inputs, declared, observations, relative)
    _warn(before_solving(names, observations.photos, problem))
    model = earlier.table.model if earlier and decided else None
    solution = _run_solver(params, problem, earlier, inputs, partial(_share, progress), model)
    systems = len(problem.blocks) * (1 if params.solver == "joint" else 2)
    counter = count(1)

    def tick() -> None:
        """Report that one more system of normal equations for the standard errors is done."""
        progress(1 - ERRORS + ERRORS * next(counter) / systems, 1, "standard errors")

    errors, coverages = estimate_uncertainty(solution, problem, params, tick)
    answer = Answer(names, problem, solution, errors, relative, params.solver, earlier)
    _warn(after_solving(answer))
    write_json(out / "materials.json", answer.material_table())
    write_json(out / "uncertainty.json", answer.uncertainty())
    everything = urm.with_exposures(urm.concatenate([photo.merged for photo in photos]), declared.exposure)
    unsolved = UnsolvedPhotos(params, inputs, everything, answer)
    lights, exposures = unsolved.lights_and_exposures(slices, solved_lights, last)
    write_lobes(out / "lobes.parquet", lights)
    write_json(out / "exposures.json", exposures)
    write_rows(out / "convergence.parquet", Event, solution.history)
    (out / "coverage").mkdir()
    for name, coverage in coverages.items():
        write_rgb_exr(out / "coverage" / f"{name}.exr", coverage, LAT_LONG)


def select_photos(inputs: Inputs, slices: Mapping[str, LightSlice], declared: KnownSlice) -> dict[str, str]:
    """Return the photos that materials are solved from, with their lights: the selected ones, and known ones."""
    selected = read_surface(inputs.folders.get("surface")).lights
    chosen = {*selected, *declared.maps, *declared.balls} if selected is not None else None
    lights = {name: slices[name].illumination for name in solved_photos(slices)}
    return {name: light for name, light in lights.items() if chosen is None or light in chosen}


def check(params: Params) -> None:
    """Raise InputError if an option that only the other solver reads differs from its default."""
    joint = set(options.SolveOptions.__struct_fields__) - {"seed"}
    for field in msgspec.structs.fields(Params):
        owner = "paper" if field.name.startswith("paper_") else "joint" if field.name in joint else params.solver
        if owner != params.solver and getattr(params, field.name) != field.default:
            cure = f"leave it out, or set solve.solver={owner}"
            raise InputError(
                f"this option belongs to solve.solver={owner}, but solve.solver={params.solver} is chosen",
                key=f"solve.{field.name}",
                cure=cure,
            )


def _known_values(params: Params, inputs: Inputs) -> KnownSlice:
    """Return the known materials, lights and exposures of dataset.yaml.

    Raises:
        InputError: If something is known, or an earlier solution is given, and the solver is the paper's.
    """
    known = msgspec.convert(inputs.facts.get("dataset.known", {}), KnownSlice)
    if params.solver == "paper" and known != KnownSlice():
        cure = "leave `known` out of dataset.yaml, or set solve.solver=joint"
        raise InputError(
            f"`known` is given, but solve.solver={params.solver} cannot hold quantities fixed", key="known", cure=cure
        )
    if params.solver == "paper" and "start" in inputs.folders:
        cure = "leave it out, or set solve.solver=joint"
        raise InputError(
            f"an earlier solution is given, but solve.solver={params.solver} always starts from the photos alone",
            key="solve.start",
            cure=cure,
        )
    return known


def _share(progress: Progress, done: float, total: float, text: str = "") -> None:
    """Report progress between reading and standard errors."""
    progress(READING * total + (1 - READING - ERRORS) * done, total, text)


def _build_problem(
    params: Params, inputs: Inputs, declared: KnownSlice, observations: urm.Observations, relative: dict[str, float]
) -> JointProblem:
    """Return the problem: blocks of observations at one exposure, operator and known quantities.

    Args:
        params: Parameters of the stage.
        inputs: Inputs of the stage.
        declared: Known quantities of dataset.yaml.
        observations: Observations of all photos.
        relative: Relative exposures, by photo.
    """
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    worlds = {photo: light.world_from_camera for photo, light in lights.items()}
    maps = {name: read_light_map(inputs.file(file)) for name, file in declared.maps.items()}
    tables = {name: inputs["urm"] / f"{ball.photo}.parquet" for name, ball in declared.balls.items()}
    balls = {
        name: urm.at_one_exposure(usable_observations(urm.read_observations(t)), relative) for name, t in tables.items()
    }
    observations, known = extract_known(declared, maps, balls, urm.at_one_exposure(observations, relative), lights)
    if params.solver == "paper":  # its materials are uniform
        observations = msgspec.structs.replace(observations, detail=None)
    rotations = {photo: np.array(world) for photo, world in worlds.items() if world is not None}
    blocks = blocks_of_observations(
        observations,
        Noise(),
        held_out=params.held_out,
        world_from_camera=rotations,
        seed=params.seed,
        backgrounds=read_backgrounds(inputs["urm"], relative),
        grounds=read_grounds(inputs["urm"]),
    )
    automatic: Name = "paper_network" if params.solver == "paper" else "network"
    operator = automatic if params.operator == "auto" else params.operator
    reflection = reflection_operator(operator, weights=inputs["train"])
    return JointProblem(blocks, reflection, inputs.map, known)


def _run_solver(
    params: Params,
    problem: JointProblem,
    earlier: EarlierSolution | None,
    inputs: Inputs,
    progress: Progress,
    decided: Model | None,
) -> Solution:
    """Return the solution of the chosen solver.

    Args:
        params: Parameters of the stage.
        problem: Observations and model.
        earlier: Earlier solution to start from, or None.
        inputs: Inputs of the stage.
        progress: Called with the completed work, its total and the current activity.
        decided: Choices that are not made again; None to make them.
    """
    names = inputs.facts["dataset.materials"]
    if params.solver == "paper":
        paper = PaperOptions(params.paper_lobes, params.paper_samplings, params.paper_prior, params.seed)
        return solve_as_the_paper(problem, len(names), paper, subset_progress(progress, REPORTS))
    unfinished = Checkpoint(inputs.unfinished / "solve.pt" if inputs.unfinished else None)
    start = (
        start_from_earlier(earlier, names)
        if earlier
        else _surface_start(inputs, problem) or start_from_photos(len(names))
    )
    choices = with_earlier_decisions(params, earlier) if earlier else params
    return solve(problem, start, choices, FitRunner(unfinished, solve_progress(progress)), decided)


class UnsolvedPhotos(msgspec.Struct, frozen=True):
    """Observations of all photos, some of which had no part in a solution.

    Attributes:
        params: Parameters of the stage.
        inputs: Inputs of the stage.
        observations: Observations of all photos.
        answer: Solution.
    """

    params: Params
    inputs: Inputs
    observations: urm.Observations
    answer: Answer

    def lights_and_exposures(
        self, slices: Mapping[str, LightSlice], solved: Mapping[str, str], progress: Progress
    ) -> tuple[dict[str, Lobes], dict[str, Channels]]:
        """Return all lights, and the exposures of all photos.

        Args:
            slices: Illumination of each photo.
            solved: Illumination of each photo of the solution.
            progress: Called with the completed work, its total and the current activity.
        """
        # photos of lights that were not selected, then those held-out photos whose light no other photo shows
        further = {name: slices[name].illumination for name in solved_photos(slices) if name not in solved}
        lights, exposures = self.fit_lights(further, progress)
        lights, exposures = self.answer.lights() | lights, self.answer.exposures() | exposures
        held_out = {name: light.illumination for name, light in slices.items() if light.held_out}
        shared = {name: light for name, light in held_out.items() if light in lights}
        exposures |= predicted_exposures(self.observations, shared, {**solved, **further}, exposures)
        apart = self.fit_lights(held_out.keys() - shared.keys(), progress)
        return lights | apart[0], exposures | apart[1]

    def fit_lights(self, photos: Collection[str], progress: Progress) -> tuple[dict[str, Lobes], dict[str, Channels]]:
        """Fit the lights of photos one by one, given the materials, and return them with the photos' exposures.

        A black or empty photo gets no light, as `export` says.
        """
        numbers = [k for k, name in enumerate(self.observations.photos) if name in photos]
        apart = usable_observations(self.observations.take(np.isin(self.observations.photo, numbers)))
        if not (apart.radiance > 0).any():
            return {}, {}
        slices = msgspec.convert(self.inputs.facts["dataset.light"], dict[str, LightSlice])
        relative = urm.relative_exposures(apart)
        blocks = blocks_of_observations(
            urm.at_one_exposure(apart, relative),
            Noise(),
            held_out=0.0,
            world_from_camera={n: np.array(s.world_from_camera) for n, s in slices.items() if s.world_from_camera},
            seed=self.params.seed,
            backgrounds=read_backgrounds(self.inputs["urm"], relative),
        )
        fitted = count(1)
        folder = self.inputs.unfinished

        def fit(block: Block) -> tuple[dict[str, Lobes], dict[str, Channels]]:
            """Fit one light."""
            problem = JointProblem([block], self.answer.problem.operator)
            unfinished = Checkpoint(folder / f"{block.name}.pt" if folder else None)
            lights, factors = fit_lights_given_materials(problem, self.answer.solution, self.params, unfinished)
            progress(next(fitted), len(blocks), f"light of {block.name}, given the materials")
            return lights, {photo: vec3(relative[photo] * np.array(factor)) for photo, factor in factors.items()}

        lights, exposures = dict[str, Lobes](), dict[str, Channels]()
        for light, exposure in self.inputs.map(fit, blocks):
            lights |= light
            exposures |= exposure
        return lights, exposures


def _surface_start(inputs: Inputs, problem: JointProblem) -> Start | None:
    """Return the start at the fit of `surface`; None without one, or with known quantities, which it ignores."""
    surface = inputs.folders.get("surface")
    if surface is None or not problem.known.is_empty or not (surface / BEGINNING).is_file():
        return None
    return start_from_surface(read_result(surface / BEGINNING, InitialFit, "surface"))


def _warn(sentences: Iterable[str]) -> None:
    """Log each sentence as a warning."""
    for sentence in sentences:
        log.warning("%s", sentence)
