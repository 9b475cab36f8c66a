"""Training of the weights of the paper's operator: `python -m studies.measured.paper_weights`.

200,000 pixels of 4000 spheres rendered by Mitsuba, two networks, a few minutes of one core.  The errors against the
reference over `factorlib.reflection.samples` are written beside the weights, in paper_accuracy.json.
"""

import numpy as np
import torch

from factorlib.conventions import FRONT, half_of_normal_and_view
from factorlib.jsonfile import write_json
from factorlib.reflection import reflection_operator
from factorlib.reflection.network import SHIPPED, write_layers
from factorlib.reflection.paper_network import diffuse_inputs, specular_inputs
from factorlib.reflection.samples import diffuse_samples, specular_samples
from factorlib.reflection.training import Schedule, pixels_problem, trained_plainly
from studies.measured.lobe_spheres import random_spheres, render_spheres
from studies.measured.operator import diffuse_errors, specular_errors

SPHERES = 4000
PIXELS = 50
SCHEDULES = {
    "diffuse": Schedule(steps=8000, batch=1024, rate=2e-3, width=288, depth=2, seed=0),
    "specular": Schedule(steps=24_000, batch=1024, rate=2e-3, width=288, depth=3, seed=0),
}


def main() -> None:
    """Render, train, and write the weights of the paper's operator with their errors."""
    torch.set_num_threads(1)  # sums depend on it
    rng = np.random.default_rng(0)
    light = random_spheres(rng, SPHERES)
    pixels = render_spheres(light, PIXELS, rng)
    each = (light.axis[:, None], light.sharpness[:, None], light.roughness[:, None])
    vectors = (pixels.normal, half_of_normal_and_view(pixels.normal, FRONT), *each)
    shape = pixels.normal.shape[:2]
    normal, half, axis, sharpness, roughness = (np.broadcast_to(t, (*shape, *t.shape[2:])) for t in vectors)
    normal, half, axis = (tuple(_flat(v[..., k]) for k in range(3)) for v in (normal, half, axis))
    sharpness = _flat(sharpness)
    roughness = _flat(roughness)
    inputs = {
        "diffuse": diffuse_inputs(normal, axis, sharpness),
        "specular": specular_inputs(normal, half, axis, sharpness, roughness),
    }
    for part, columns in inputs.items():
        problem = pixels_problem(columns, sharpness, _flat(getattr(pixels, part)))
        layers = trained_plainly(problem, SCHEDULES[part], lambda *words, part=part: print(part, *words, flush=True))
        file = SHIPPED / f"paper_{part}.safetensors"
        note = "see factorlib.reflection.paper_network"
        write_layers(file, layers, torch.float16, inputs=note)
    operator = reflection_operator("paper_network")
    glossy = specular_errors(operator, specular_samples(16384, 99, tolerance=1e-6))
    matte = diffuse_errors(operator, diffuse_samples(16384, 98))
    write_json(SHIPPED / "paper_accuracy.json", {"diffuse": matte, "specular": glossy})


def _flat(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.reshape(-1).copy())


if __name__ == "__main__":
    main()
