"""Train the reflection networks on samples of the reference operator; needs nothing but parameters.

Writes specular.safetensors and diffuse.safetensors, training.parquet (the curve) and accuracy.json (held-out errors).
"""

from pathlib import Path
from typing import Annotated

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from factorlib.checkpoint import Checkpoint
from factorlib.jsonfile import write_json
from factorlib.reflection.network import Layers, write_layers
from factorlib.reflection.samples import diffuse_samples, diffuse_table, specular_samples, specular_table
from factorlib.reflection.training import Problem, Schedule, Step, diffuse_problem, specular_problem, train
from factorlib.stage import Inputs, Progress
from factorlib.wholefile import writing

Meta = msgspec.Meta
HELD_OUT_TOLERANCE = 1e-5  # of the reference; a tenth of the median error that is measured with it, or less


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What networks are trained on, how long, and their sizes."""

    samples: Annotated[int, Meta(ge=1024, le=1 << 24)] = 524_288
    """Samples of the reference that the specular network is fitted to; half as many more lie at grazing views."""
    held_out: Annotated[int, Meta(ge=1024, le=1 << 20)] = 16_384
    """Other samples, which the error is measured on."""
    tolerance: Annotated[float, Meta(gt=0, le=0.1)] = 1e-3
    """Relative tolerance of the reference's quadrature on `samples`."""
    steps: Annotated[int, Meta(ge=40, le=10_000_000)] = 60_000
    """Steps of Adam, for the specular network."""
    batch: Annotated[int, Meta(ge=64, le=1 << 16)] = 2048
    """Samples of a step."""
    rate: Annotated[float, Meta(gt=0, le=0.1)] = 6e-3
    """Largest learning rate of Adam."""
    width: Annotated[int, Meta(ge=4, le=1024)] = 32
    """Units of a hidden layer of the specular network."""
    depth: Annotated[int, Meta(ge=1, le=16)] = 3
    """Hidden layers of the specular network."""
    diffuse_samples: Annotated[int, Meta(ge=1024, le=1 << 20)] = 16_384
    """Samples that the diffuse network is fitted to."""
    diffuse_steps: Annotated[int, Meta(ge=40, le=10_000_000)] = 3000
    """Steps of Adam, for the diffuse network."""
    diffuse_width: Annotated[int, Meta(ge=4, le=1024)] = 16
    """Units of a hidden layer of the diffuse network."""
    diffuse_depth: Annotated[int, Meta(ge=1, le=16)] = 2
    """Hidden layers of the diffuse network."""
    seed: Annotated[int, Meta(ge=0)] = 0
    """Seed of samples, first weights and batches."""


# What training sees beyond what is measured, so that the edges of the domain are not the edges of the training set.
WIDER = {"alpha": (0.008, 1.0), "sharpness": (0.05, 1e4), "least_no": 0.005}


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Train the diffuse and the specular network, and write weights, curves and accuracy."""
    threads, accuracy, curves = torch.get_num_threads(), {}, {}
    torch.set_num_threads(1)  # batches are too small for more, and sums depend on it
    try:
        for part, fit in (("diffuse", _diffuse), ("specular", _specular)):
            layers, accuracy[part], curves[part] = fit(params, inputs, progress)
            write_layers(
                out / f"{part}.safetensors", layers, inputs=f"see factorlib.reflection.network.{part}_features"
            )
    finally:
        torch.set_num_threads(threads)
    write_json(out / "accuracy.json", accuracy)
    _write_curves(out / "training.parquet", curves)


def _specular(params: Params, inputs: Inputs, progress: Progress) -> tuple[Layers, dict, list[Step]]:
    progress(0, 1, "specular: samples of the reference")
    even = specular_samples(params.samples, params.seed, tolerance=params.tolerance, **WIDER)
    grazing = specular_samples(params.samples // 2, params.seed + 1, tolerance=params.tolerance, grazing=True, **WIDER)
    held_out = specular_samples(params.held_out, params.seed + 1_000_003, tolerance=HELD_OUT_TOLERANCE)
    problems = specular_problem(even.joined(grazing)), specular_problem(held_out)
    schedule = Schedule(params.steps, params.batch, params.rate, params.width, params.depth, params.seed)
    layers, curve = _trained("specular", problems, schedule, inputs, progress)
    return layers, specular_table(problems[1].float().errors(layers), *held_out.inputs()), curve


def _diffuse(params: Params, inputs: Inputs, progress: Progress) -> tuple[Layers, dict, list[Step]]:
    samples = diffuse_samples(params.diffuse_samples, params.seed, sharpness=(1e-3, 1e5))
    held_out = diffuse_samples(params.held_out, params.seed + 1_000_003)
    problems = diffuse_problem(samples), diffuse_problem(held_out)
    sizes = params.diffuse_width, params.diffuse_depth
    schedule = Schedule(params.diffuse_steps, params.batch, params.rate, *sizes, params.seed)
    layers, curve = _trained("diffuse", problems, schedule, inputs, progress)
    return layers, diffuse_table(problems[1].float().errors(layers), held_out.sharpness, held_out.nz), curve


def _trained(
    part: str, problems: tuple[Problem, Problem], schedule: Schedule, inputs: Inputs, progress: Progress
) -> tuple[Layers, list[Step]]:
    """problems: what is fitted, and what the error is measured on; it goes on where a killed run was."""

    def report(point: Step) -> None:
        """Errors of held-out samples at a step."""
        median, p95 = point.held_out_median_error, point.held_out_p95_error
        progress(point.step, schedule.steps, f"{part}: held-out error {median:.2%} (median), {p95:.2%} (p95)")

    checkpoint = Checkpoint(inputs.unfinished / f"{part}.pt" if inputs.unfinished else None)
    return train(*problems, schedule, report, checkpoint)


def _write_curves(path: Path, curves: dict[str, list[Step]]) -> None:
    rows = [{"part": part, **msgspec.structs.asdict(point)} for part, curve in curves.items() for point in curve]
    with writing(path):
        pq.write_table(pa.Table.from_pylist(rows), path, compression="zstd")
