"""Train the reflection networks on samples of the reference operator; needs nothing but parameters.

Writes specular.safetensors and diffuse.safetensors, training.parquet (the curve) and accuracy.json (held-out errors).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from factorlib.checkpoint import Checkpoint
from factorlib.jsonfile import write_json
from factorlib.reflection.accuracy import diffuse_table, specular_table
from factorlib.reflection.network import write_layers
from factorlib.reflection.samples import diffuse_samples, specular_samples
from factorlib.reflection.training import Schedule, Step, diffuse_problem, specular_problem, train
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
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # batches are too small for more, and sums depend on it
    try:
        curves = {
            "diffuse": _diffuse(params, inputs, out, progress),
            "specular": _specular(params, inputs, out, progress),
        }
    finally:
        torch.set_num_threads(threads)
    write_json(out / "accuracy.json", {part: table for part, (table, _) in curves.items()})
    _write_curves(out / "training.parquet", {part: curve for part, (_, curve) in curves.items()})


def _specular(params: Params, inputs: Inputs, out: Path, progress: Progress) -> tuple[dict, list[Step]]:
    progress(0, 1, "specular: samples of the reference")
    seen = specular_samples(params.samples, params.seed, tolerance=params.tolerance, **WIDER)
    grazing = specular_samples(params.samples // 2, params.seed + 1, tolerance=params.tolerance, grazing=True, **WIDER)
    held_out = specular_samples(params.held_out, params.seed + 1_000_003, tolerance=HELD_OUT_TOLERANCE)
    schedule = Schedule(params.steps, params.batch, params.rate, params.width, params.depth, params.seed)
    problem = specular_problem(held_out)
    layers, curve = train(
        specular_problem(seen.joined(grazing)),
        problem,
        schedule,
        _report(progress, "specular", params.steps),
        _checkpoint(inputs, "specular"),
    )
    write_layers(out / "specular.safetensors", layers, inputs="see factorlib.reflection.network.specular_features")
    return specular_table(problem.float().errors(layers), *held_out.inputs()), curve


def _diffuse(params: Params, inputs: Inputs, out: Path, progress: Progress) -> tuple[dict, list[Step]]:
    seen = diffuse_samples(params.diffuse_samples, params.seed, sharpness=(1e-3, 1e5))
    held_out = diffuse_samples(params.held_out, params.seed + 1_000_003)
    schedule = Schedule(
        params.diffuse_steps, params.batch, params.rate, params.diffuse_width, params.diffuse_depth, params.seed
    )
    problem = diffuse_problem(held_out)
    layers, curve = train(
        diffuse_problem(seen),
        problem,
        schedule,
        _report(progress, "diffuse", params.diffuse_steps),
        _checkpoint(inputs, "diffuse"),
    )
    write_layers(out / "diffuse.safetensors", layers, inputs="see factorlib.reflection.network.diffuse_features")
    return diffuse_table(problem.float().errors(layers), held_out.sharpness, held_out.nz), curve


def _checkpoint(inputs: Inputs, part: str) -> Checkpoint:
    return Checkpoint(inputs.unfinished / f"{part}.pt" if inputs.unfinished else None)


def _report(progress: Progress, part: str, steps: int) -> Callable[[Step], None]:
    def report(point: Step) -> None:
        """Errors of held-out samples at a step."""
        progress(
            point.step,
            steps,
            f"{part}: held-out error {point.held_out_median_error:.2%} (median), {point.held_out_p95_error:.2%} (p95)",
        )

    return report


def _write_curves(path: Path, curves: dict[str, list[Step]]) -> None:
    rows = [{"part": part, **msgspec.structs.asdict(point)} for part, curve in curves.items() for point in curve]
    with writing(path):
        pq.write_table(pa.Table.from_pylist(rows), path, compression="zstd")
