"""The joint solve: from all observations, one reflectance per material and one light per illumination.

Writes materials.json, lobes.parquet, exposures.json, convergence.parquet, uncertainty.json and coverage/<illumination>.exr.
"""

import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from factorlib.checkpoint import Checkpoint
from factorlib.dataset.schema import LightSlice
from factorlib.errors import InputError
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.light.lobes import Lobes, write_lobes
from factorlib.reflection import reflection_operator
from factorlib.solve.bundle import Joint, candidates, solve
from factorlib.solve.coverage import relative_standard_errors
from factorlib.solve.earlier import Earlier, read_earlier
from factorlib.solve.gauge import RULE
from factorlib.solve.history import Event
from factorlib.solve.normal_equations import Loss
from factorlib.solve.options import Bundle
from factorlib.solve.paper import REPORTS, Paper
from factorlib.solve.paper import solve as solve_as_the_paper
from factorlib.solve.problem import Block, Noise, blocks_of_observations, connected_components, usable
from factorlib.solve.resume import Journal
from factorlib.solve.shadowing import without_shadows
from factorlib.solve.told import beyond_cameras, ill_explained, untold_by_answer, untold_by_observations
from factorlib.solve.uncertainty import GAUGE, standard_errors
from factorlib.solve.unknowns import Materials
from factorlib.solve.warm import from_earlier
from factorlib.stage import Inputs, Progress
from factorlib.urm.exposure import at_one_exposure, relative_exposures
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations, concatenate, read_observations
from factorlib.wholefile import writing

EXPOSURE_DIFFERS = 1.5  # by which factor what is found may differ from EXIF without a word
log = logging.getLogger("factorlib.solve")
Meta = msgspec.Meta


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """solver: `paper` is the baseline, with lobes, samplings of each observation and a prior of its own (paper_…);
    operator: how a lobe's reflection is computed, `auto` being `network`, and `paper_network` for the paper's solver;
    merge_degrees: observations this near are merged before solving.

    lobes: most lobes an illumination may get (held-out pixels may stop earlier);  sample: the least observations per
    illumination that choose the lobes (60 for each lobe where that is more), before four times as many polish the
    answer in `polish` iterations, and all of them in `settle`;  self_shadowing: whether what the meshes hide is taken
    to be dark, `auto` where held-out pixels are explained better so;  specular: whether every material
    has a specular part, `auto` those whose held-out pixels are explained better so;  tone: whether photos may have a tone
    curve beyond their encoding, `auto` where held-out pixels are explained better so;  prior: weight of the paper's tint
    prior;  noise_…: the noise model, in units of an illumination's mean radiance.

    The folder `start`, where one is given, holds an earlier solution: materials and lights that have their names there start
    from it, and whether they have specular parts, and whether there are shadows, stays as it was decided there.
    """

    solver: Literal["bundle", "paper"] = "bundle"
    operator: Literal["auto", "network", "closed_form", "reference", "paper_network"] = "auto"
    merge_degrees: Annotated[float, Meta(ge=0, le=30)] = 2.0
    lobes: Annotated[int, Meta(ge=1, le=1024)] = 72
    insert: Annotated[int, Meta(ge=1, le=64)] = 12
    rounds: Annotated[int, Meta(ge=1, le=100)] = 12
    iterations: Annotated[int, Meta(ge=1, le=1000)] = 10
    polish: Annotated[int, Meta(ge=0, le=1000)] = 20
    settle: Annotated[int, Meta(ge=0, le=1000)] = 2
    sample: Annotated[int, Meta(ge=50)] = 1500
    tolerance: Annotated[float, Meta(gt=0, lt=1)] = 1e-3
    least_gain: Annotated[float, Meta(ge=0, lt=1)] = 0.01
    held_out: Annotated[float, Meta(ge=0, le=0.5)] = 0.1
    self_shadowing: Literal["auto", "on", "off"] = "auto"
    specular: Literal["auto", "on"] = "auto"
    tone: Literal["auto", "off"] = "auto"
    prior: Annotated[float, Meta(ge=0)] = 1e-4
    noise_absolute: Annotated[float, Meta(gt=0)] = 0.05
    noise_relative: Annotated[float, Meta(ge=0)] = 0.05
    paper_lobes: Annotated[int, Meta(ge=1, le=1024)] = 32
    paper_samplings: Annotated[float, Meta(gt=0)] = 5.0
    paper_prior: Annotated[float, Meta(ge=0)] = 0.1
    seed: Annotated[int, Meta(ge=0)] = 0


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # a photo, then an illumination on one thread: how many there are changes no bit
        _main(params, inputs, out, progress, lambda function, items: list(pool.map(function, items)))


def _main(params: Params, inputs: Inputs, out: Path, progress: Progress, spread: Callable) -> None:
    materials: list[str] = inputs.facts["dataset.materials"]
    earlier = _earlier(params, inputs)
    read = spread(partial(_merged, degrees=params.merge_degrees), sorted(inputs["urm"].glob("*.parquet")))
    seen = concatenate([photo.merged for photo in read])
    relative = relative_exposures(seen)
    seen, earlier = at_one_exposure(seen, relative), earlier and _at_one_exposure(earlier, relative)
    _warn_of_unusable(read)
    blocks = blocks_of_observations(
        seen,
        Noise(params.noise_absolute, params.noise_relative),
        held_out=params.held_out,
        world_from_camera=_rotations(inputs),
        seed=params.seed,
    )
    _warn_of_gaps(materials, blocks, seen)
    _warn(untold_by_observations(materials, blocks))
    operator = reflection_operator(operator_of(params), weights=inputs["train"])
    journal = Journal(Checkpoint(inputs.unfinished / "solve.pt" if inputs.unfinished else None))
    joint = _solved(params, blocks, materials, operator, spread, progress, journal, earlier)
    shown = blocks if joint.self_shadowing else [without_shadows(block) for block in blocks]
    _write(out, materials, shown, joint, operator, params.solver, earlier, relative)


def operator_of(params: Params) -> str:
    """The name of the operator that the solver takes."""
    automatic = {"bundle": "network", "paper": "paper_network"}[params.solver]
    return automatic if params.operator == "auto" else params.operator


def _solved(
    params: Params,
    blocks: list[Block],
    materials: list[str],
    operator,
    spread: Callable,
    progress: Progress,
    journal: Journal,
    earlier: Earlier | None,
) -> Joint:
    if params.solver == "paper":
        paper = Paper(params.paper_lobes, params.paper_samplings, prior=params.paper_prior, seed=params.seed)
        said = lambda event: progress(event.round + 1, REPORTS + 1, f"subset {event.iteration}: loss {event.loss:.3g}")  # noqa: E731
        return solve_as_the_paper(blocks, len(materials), operator, paper, spread, said)
    bundle, start = _bundle(params), None
    if earlier:
        start = from_earlier(earlier, materials, bundle.specular)
        decided = earlier.self_shadowing if bundle.self_shadowing == "auto" else None
        bundle = msgspec.structs.replace(bundle, self_shadowing=decided or bundle.self_shadowing)
    said = _to_progress(progress, params, len(candidates(blocks, bundle.self_shadowing)))
    return solve(blocks, len(materials), operator, bundle, spread, said, start=start, journal=journal)


def _earlier(params: Params, inputs: Inputs) -> Earlier | None:
    """The solution to start from, where one is given."""
    if "start" not in inputs.folders:
        return None
    if params.solver == "paper":
        raise InputError("the paper's solver starts from nothing", key="solve.start", cure="leave it out, or set solve.solver=bundle")
    return read_earlier(inputs["start"])


def _at_one_exposure(earlier: Earlier, relative: dict[str, float]) -> Earlier:
    exposures = {photo: tuple(e / relative.get(photo, 1.0) for e in channels) for photo, channels in earlier.exposures.items()}
    return msgspec.structs.replace(earlier, exposures=exposures)


def _rotations(inputs: Inputs) -> dict[str, np.ndarray]:
    lights = msgspec.convert(inputs.facts["dataset.light"], dict[str, LightSlice])
    return {photo: np.array(light.world_from_camera) for photo, light in lights.items() if light.world_from_camera is not None}


def _bundle(params: Params) -> Bundle:
    same = {
        name: getattr(params, name)
        for name in (
            "lobes",
            "insert",
            "rounds",
            "iterations",
            "polish",
            "settle",
            "sample",
            "tolerance",
            "least_gain",
            "self_shadowing",
            "specular",
            "tone",
            "seed",
        )
    }
    return Bundle(loss=Loss(prior=params.prior), **same)


def _to_progress(progress: Progress, params: Params, models: int):
    total, fitted, round_ = models * params.rounds + 1, 0, 0  # of the models to choose from, those that are done

    def report(event: Event) -> None:
        nonlocal fitted, round_
        fitted, round_ = fitted + (event.round < round_), event.round
        of_round = (event.iteration + 1) / params.iterations if event.phase == "descent" else 1.0
        done = fitted * params.rounds + event.round + min(of_round, 1.0) if event.phase != "polish" else total - 1
        progress(done, total, f"{event.phase} {event.round}: loss {event.loss:.3g}, {event.lobes} lobes")

    return report


def _warn(sentences: list[str]) -> None:
    for sentence in sentences:
        log.warning("%s", sentence)


class _Read(msgspec.Struct, frozen=True):
    """A photo's usable observations, merged, how many there were, and how many of those were unusable."""

    merged: Observations
    count: int
    unusable: int


def _merged(path: Path, degrees: float) -> _Read:
    read = read_observations(path)
    seen = usable(read)
    return _Read(merge(seen, degrees), len(read), len(read) - len(seen))


def _warn_of_unusable(read: list[_Read]) -> None:
    for photo in read:
        if photo.unusable:
            log.warning(
                "photo '%s': %d of %d observations are left out, their radiance, normal or view not finite or their weight not positive",
                ", ".join(photo.merged.photos), photo.unusable, photo.count,
            )  # fmt: skip


def _warn_of_gaps(materials: list[str], blocks: list[Block], seen: Observations) -> None:
    """Say what the observations cannot tell: unseen materials, unseen photos, sets that are not linked."""
    observed = {int(m) for block in blocks for m in np.unique(block.material)}
    for index, name in enumerate(materials):
        if index not in observed:
            log.warning("material '%s' is observed in no photo: its reflectance is only a guess", name)
    for photo in set(seen.photos) - {photo for block in blocks for photo in block.photos}:
        log.warning("photo '%s' has no valid observation and gets no light", photo)
    linked = [c for c in connected_components(blocks, len(materials)) if c[1]]
    if len(linked) > 1:
        groups = "; ".join(f"{', '.join(lights)} (with {', '.join(materials[m] for m in members)})" for members, lights in linked)
        log.warning(
            "the photos fall into %d sets that share no material, so their reflectances cannot be compared: %s. "
            "A photo that shows a material of each would link them",
            len(linked), groups,
        )  # fmt: skip


def _write(
    out: Path,
    names: list[str],
    blocks: list[Block],
    joint: Joint,
    operator,
    solver: str,
    earlier: Earlier | None,
    relative: dict[str, float],
) -> None:
    errors, deviation = standard_errors(blocks, joint.solution, operator, joint.loss)
    _warn(untold_by_answer(names, blocks, joint.solution.materials, errors))
    _warn(ill_explained(blocks, joint.solution.materials, joint.solution.lights, operator))
    _warn(beyond_cameras(blocks, joint.solution.lights))
    found, components = joint.solution.materials, connected_components(blocks, len(names))
    component_of = {m: k for k, (members, _) in enumerate(components) for m in members}
    model = {
        "solver": solver,
        "lobes": {block.name: len(light) for block, light in zip(blocks, joint.solution.lights, strict=True)},
        "lobes_chosen_by": {"bundle": "held-out loss per round, see convergence.parquet", "paper": "given"}[solver],
        "held_out_loss": [event.held_out for event in joint.history if event.phase in ("round", "subset")],
        "specular": {name: not bool(joint.matte[m]) for m, name in enumerate(names)},
        "specular_chosen_by": {name: msgspec.to_builtins(told) for name, told in zip(names, joint.specular, strict=False)},
        "self_shadowing": joint.self_shadowing,
        "self_shadowing_chosen_by": {f"held_out_loss_{name}": loss for name, loss in joint.held_out.items()},
    }
    model["tone"] = {
        photo: {"exponent": float(np.exp(log_tone)), "pivot": block.unit * relative[photo]}
        for block, light in zip(blocks, joint.solution.lights, strict=True)
        for photo, log_tone in zip(block.photos, light.log_tone, strict=False)
    }
    model["tone_chosen_by"] = {block.name: msgspec.to_builtins(told) for block, told in zip(blocks, joint.tone, strict=False)}
    if earlier:
        known = {"materials": set(names) & set(earlier.table.materials), "illuminations": {b.name for b in blocks} & set(earlier.lights)}
        model["started_from"] = {of: sorted(names) for of, names in known.items()}
    gauge = {"rule": RULE, "component": {name: component_of[m] for m, name in enumerate(names)}, "stderr": GAUGE}
    write_json(out / "materials.json", {"materials": _as_json(names, found, errors), "gauge": gauge, "model": model})
    write_json(out / "uncertainty.json", {"residual_sigma": deviation, "materials": _as_json(names, errors, None), "gauge": GAUGE})
    lights = list(zip(blocks, joint.solution.lights, strict=True))
    write_lobes(out / "lobes.parquet", {b.name: Lobes(light.axis, light.sharpness, light.weight * b.unit) for b, light in lights})
    found_beside = {photo: float(np.exp(light.log_exposure[k])) for b, light in lights for k, photo in enumerate(b.photos)}
    _warn_of_exposures(found_beside, relative)
    write_json(out / "exposures.json", {photo: [factor * relative[photo]] * 3 for photo, factor in found_beside.items()})
    _write_history(out / "convergence.parquet", joint.history)
    (out / "coverage").mkdir()
    for block, light in lights:
        coverage = relative_standard_errors(block, light, found, operator, joint.loss, deviation)
        write_rgb_exr(out / "coverage" / f"{block.name}.exr", coverage, LAT_LONG)


def _warn_of_exposures(found: dict[str, float], relative: dict[str, float]) -> None:
    """found: of each photo, beside what EXIF says."""
    for photo, factor in found.items():
        if relative[photo] != 1 and abs(np.log(factor)) > np.log(EXPOSURE_DIFFERS):
            log.warning(
                "photo '%s': by its EXIF its exposure is %.3g of its light's first photo, by its pixels %.3g: was it made brighter or darker later?",
                photo, relative[photo], factor * relative[photo],
            )  # fmt: skip


def _as_json(names: list[str], materials: Materials, errors: Materials | None) -> dict:
    """The fixed form of materials.json; standard errors in the same shape, where given."""
    table = {}
    for m, name in enumerate(names):
        diffuse, specular, roughness = materials.diffuse[m].tolist(), materials.specular[m].tolist(), float(materials.roughness[m])
        table[name] = {"diffuse": diffuse, "specular": specular, "roughness": roughness}
        if errors is not None:
            table[name] |= {"alpha": roughness**2, "stderr": _as_json([name], _one(errors, m), None)[name]}
    return table


def _one(materials: Materials, m: int) -> Materials:
    return Materials(materials.diffuse[[m]], materials.specular[[m]], materials.roughness[[m]])


def _write_history(path: Path, history: list[Event]) -> None:
    columns = {name: [getattr(event, name) for event in history] for name in Event.__struct_fields__}
    with writing(path):
        pq.write_table(pa.table(columns), path, compression="zstd")
