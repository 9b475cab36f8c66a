"""Training of the reflection networks on samples of the reference operator; it has parameters but no inputs.

Writes specular.safetensors and diffuse.safetensors, training.parquet (learning curves) and accuracy.json (held-out
errors).
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
HELD_OUT_TOLERANCE = 1e-5  # relative tolerance of held-out samples; at most a tenth of the median error


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Samples, schedule and sizes of the networks."""

    samples: Annotated[int, Meta(ge=1024, le=1 << 24)] = 524_288
    """Number of reference samples that the specular network is fitted to; half as many are added at grazing views."""
    held_out: Annotated[int, Meta(ge=1024, le=1 << 20)] = 16_384
    """Number of held-out samples, on which the error is measured."""
    tolerance: Annotated[float, Meta(gt=0, le=0.1)] = 1e-3
    """Relative tolerance of the quadrature of training samples."""
    steps: Annotated[int, Meta(ge=40, le=10_000_000)] = 60_000
    """Number of Adam steps, for the specular network."""
    batch: Annotated[int, Meta(ge=64, le=1 << 16)] = 2048
    """Number of samples in a step."""
    rate: Annotated[float, Meta(gt=0, le=0.1)] = 6e-3
    """Largest learning rate of Adam's schedule."""
    width: Annotated[int, Meta(ge=4, le=1024)] = 32
    """Number of units in a hidden layer of the specular network."""
    depth: Annotated[int, Meta(ge=1, le=16)] = 3
    """Number of hidden layers of the specular network."""
    diffuse_samples: Annotated[int, Meta(ge=1024, le=1 << 20)] = 16_384
    """Number of samples that the diffuse network is fitted to."""
    diffuse_steps: Annotated[int, Meta(ge=40, le=10_000_000)] = 3000
    """Number of Adam steps, for the diffuse network."""
    diffuse_width: Annotated[int, Meta(ge=4, le=1024)] = 16
    """Number of units in a hidden layer of the diffuse network."""
    diffuse_depth: Annotated[int, Meta(ge=1, le=16)] = 2
    """Number of hidden layers of the diffuse network."""
    seed: Annotated[int, Meta(ge=0)] = 0
    """Seed of samples, initial weights and batches."""


# ranges of training samples: wider than those of held-out samples, so that none of these lies at an edge
WIDER = {"alpha": (0.008, 1.0), "sharpness": (0.05, 1e4), "least_no": 0.005}


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Train the diffuse and the specular network, and write weights, learning curves and accuracy."""
    threads, accuracy, curves = torch.get_num_threads(), {}, {}
    torch.set_num_threads(1)  # batches are too small for more, and rounding of sums depends on the number
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
    """Train the specular network; return weights, held-out errors and learning curve."""
    progress(0, 1, "specular: samples of the reference")
    even = specular_samples(params.samples, params.seed, tolerance=params.tolerance, **WIDER)
    grazing = specular_samples(params.samples // 2, params.seed + 1, tolerance=params.tolerance, grazing=True, **WIDER)
    held_out = specular_samples(params.held_out, params.seed + 1_000_003, tolerance=HELD_OUT_TOLERANCE)
    problems = specular_problem(even.joined(grazing)), specular_problem(held_out)
    schedule = Schedule(params.steps, params.batch, params.rate, params.width, params.depth, params.seed)
    layers, curve = _trained("specular", problems, schedule, inputs, progress)
    return layers, specular_table(problems[1].float().errors(layers), *held_out.inputs()), curve


def _diffuse(params: Params, inputs: Inputs, progress: Progress) -> tuple[Layers, dict, list[Step]]:
    """Train the diffuse network; return weights, held-out errors and learning curve."""
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
    """Train a network, from the checkpoint of a killed run if there is one; return weights and learning curve.

    Args:
        part: Name of the network: diffuse or specular.
        problems: Training samples and held-out samples.
        schedule: Schedule and sizes.
        inputs: Inputs of the stage.
        progress: Receiver of progress.
    """

    def report(point: Step) -> None:
        """Report the errors of held-out samples at a step."""
        median, p95 = point.held_out_median_error, point.held_out_p95_error
        progress(point.step, schedule.steps, f"{part}: held-out error {median:.2%} (median), {p95:.2%} (p95)")

    checkpoint = Checkpoint(inputs.unfinished / f"{part}.pt" if inputs.unfinished else None)
    return train(*problems, schedule, report, checkpoint)


def _write_curves(path: Path, curves: dict[str, list[Step]]) -> None:
    """Write the learning curves, one row a step."""
    rows = [{"part": part, **msgspec.structs.asdict(point)} for part, curve in curves.items() for point in curve]
    with writing(path):
        pq.write_table(pa.Table.from_pylist(rows), path, compression="zstd")
