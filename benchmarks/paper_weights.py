"""Make the weights of the paper's operator again: `python -m benchmarks.paper_weights`.

200,000 pixels of 4000 spheres rendered by Mitsuba, two networks, a few minutes of one core; prints the errors against the
reference over `factorlib.reflection.samples`, and writes them beside the weights.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.operator.errors import diffuse_errors, specular_errors
from benchmarks.operator.timing import microseconds
from factorlib.conventions import FRONT, half_of_normal_and_view
from factorlib.generate.lobe_spheres import Pixels, Spheres, random_spheres, rendered
from factorlib.jsonfile import write_json
from factorlib.reflection import reflection_operator
from factorlib.reflection.network import SHIPPED, write_layers
from factorlib.reflection.paper_network import diffuse_inputs, specular_inputs
from factorlib.reflection.paper_training import Examples, trained
from factorlib.reflection.samples import diffuse_samples, specular_samples
from factorlib.reflection.training import Schedule

SPHERES, PIXELS = 4000, 50
SCHEDULES = {
    "diffuse": Schedule(steps=8000, batch=1024, rate=2e-3, width=288, depth=2, seed=0),
    "specular": Schedule(steps=24_000, batch=1024, rate=2e-3, width=288, depth=3, seed=0),
}


def main(folder: Path = SHIPPED, spheres: int = SPHERES, schedules: dict[str, Schedule] = SCHEDULES) -> None:
    """Render, train and write into `folder`."""
    torch.set_num_threads(1)  # sums depend on it
    rng, start = np.random.default_rng(0), time.process_time()
    light = random_spheres(rng, spheres)
    pixels = rendered(light, PIXELS, rng)
    print(f"{spheres} spheres rendered in {time.process_time() - start:.0f} s of a core", flush=True)
    for part, examples in examples_of_pixels(light, pixels).items():
        start = time.process_time()
        layers = trained(
            examples,
            schedules[part],
            lambda step, error, part=part: print(f"{part}: step {step}, error {error:.2%}", flush=True),
        )
        print(f"{part}: trained in {time.process_time() - start:.0f} s of a core", flush=True)
        write_layers(
            folder / f"paper_{part}.safetensors", layers, torch.float16, inputs="see factorlib.reflection.paper_network"
        )


def examples_of_pixels(light: Spheres, pixels: Pixels) -> dict[str, Examples]:
    """What each of the two networks is to learn, in the camera frame."""
    half = half_of_normal_and_view(pixels.normal, FRONT)
    each = (light.axis[:, None], light.sharpness[:, None], light.roughness[:, None])
    axis, sharpness, roughness = (np.broadcast_to(t, (*pixels.normal.shape[:2], *t.shape[2:])) for t in each)
    normal, half, axis = (tuple(_flat(v[..., k]) for k in range(3)) for v in (pixels.normal, half, axis))
    sharpness, roughness = _flat(sharpness), _flat(roughness)
    return {
        "diffuse": Examples(diffuse_inputs(normal, axis, sharpness), sharpness, _flat(pixels.diffuse)),
        "specular": Examples(
            specular_inputs(normal, half, axis, sharpness, roughness), sharpness, _flat(pixels.specular)
        ),
    }


def _flat(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.reshape(-1).copy())


def accuracy() -> dict:
    """Errors of the shipped weights against the reference."""
    operator = reflection_operator("paper_network")
    return {
        "diffuse": diffuse_errors(operator, diffuse_samples(16384, 98)),
        "specular": specular_errors(operator, specular_samples(16384, 99, tolerance=1e-6)),
    }


if __name__ == "__main__":
    main()
    found = accuracy()
    write_json(SHIPPED / "paper_accuracy.json", found)
    for part, table in found.items():
        print(part, {name: table[name] for name in ("median", "p95", "p99", "worst")})
    print(
        "microseconds",
        microseconds({"paper_network": reflection_operator("paper_network")}, lambda _: 1024)["paper_network"],
    )
