"""What ships with the library and was made by measurement, made again: `python -m benchmarks.shipped constants`, or `paper`.

constants   of the closed forms, fitted to quadrature: printed beside their distance from those in use
paper       weights of the paper's operator: 200,000 pixels of 4000 spheres rendered by Mitsuba, two networks, a few minutes of one core.
            Their errors against the reference over `factorlib.reflection.samples` are written beside them, in paper_accuracy.json
"""

from __future__ import annotations

import itertools
import math
import sys

import numpy as np
import torch
from numpy.polynomial.chebyshev import cheb2poly
from scipy.optimize import least_squares

from benchmarks.operator import diffuse_errors, specular_errors
from factorlib.conventions import FRONT, half_of_normal_and_view
from factorlib.generate.lobe_spheres import random_spheres, rendered
from factorlib.jsonfile import write_json
from factorlib.reflection import reflection_operator
from factorlib.reflection.diffuse import REMAINDER, normal_mean_cosine
from factorlib.reflection.filtering import TAIL
from factorlib.reflection.lobe import lobe_integral, lobe_moments
from factorlib.reflection.network import SHIPPED, write_layers
from factorlib.reflection.paper_network import diffuse_inputs, specular_inputs
from factorlib.reflection.paper_training import Examples, trained
from factorlib.reflection.reference import diffuse_quadrature
from factorlib.reflection.samples import diffuse_samples, specular_samples
from factorlib.reflection.training import Schedule

SPHERES, PIXELS = 4000, 50
SCHEDULES = {
    "diffuse": Schedule(steps=8000, batch=1024, rate=2e-3, width=288, depth=2, seed=0),
    "specular": Schedule(steps=24_000, batch=1024, rate=2e-3, width=288, depth=3, seed=0),
}


def diffuse_remainder(orders: int = 8, powers: int = 5) -> tuple[np.ndarray, float]:
    """Coefficients of T_i(2t̄ − 1) c^2j (1 − t̄)² in what the normal law leaves of E[max(n·i, 0)], and the worst error."""
    sharpness, cosine = torch.logspace(-3, 6, 90, dtype=torch.float64), torch.linspace(-1, 1, 161, dtype=torch.float64)
    lam, c = (t.reshape(-1) for t in torch.meshgrid(sharpness, cosine, indexing="ij"))
    exact = diffuse_quadrature(lam, c, 80) * math.pi / lobe_integral(lam)
    peak, mean = exact.reshape(90, 161).amax(1).repeat_interleave(161), lobe_moments(lam)[0]
    basis = [
        (1 - mean) ** 2 * torch.cos(i * torch.arccos(2 * mean - 1)) * torch.cos(2 * j * torch.arccos(c)) / peak
        for i, j in itertools.product(range(orders), range(powers))
    ]
    matrix, target = torch.stack(basis, 1), (exact - normal_mean_cosine(lam, c)) / peak
    weight = torch.ones_like(target)
    for _ in range(60):  # reweighted least squares, toward the least maximum
        found = torch.linalg.lstsq(matrix * weight[:, None], (target * weight)[:, None]).solution[:, 0]
        error = (matrix @ found - target).abs()
        weight = weight * torch.sqrt(1 + error / error.max())
        weight = weight / weight.mean()
    even = np.zeros((powers, 2 * powers - 1))
    for j in range(powers):
        even[j, : 2 * j + 1] = cheb2poly([0.0] * (2 * j) + [1.0])
    return found.reshape(orders, powers).numpy() @ even[:, ::2], float(error.max())


def ggx_as_gaussians(count: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Rates τ and weights w of 1/(1 + x)² ≈ Σ w exp(−τ x) + 1/((1 + x)² + TAIL²), in relative error."""
    x = np.concatenate([[0.0], np.logspace(-2.5, 7.0, 500)])

    def parameters(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.exp(np.cumsum(np.r_[p[0], np.exp(p[1:count])])), np.exp(p[count:])

    def residual(p: np.ndarray) -> np.ndarray:
        rate, weight = parameters(p)
        ratio = (np.exp(-np.outer(x, rate)) @ weight + 1 / ((1 + x) ** 2 + TAIL**2)) * (1 + x) ** 2
        return (ratio - 1) * np.where(x == 0, 30, 1)

    first = np.log(np.geomspace(3 / TAIL, 5, count))
    start = np.r_[first[0], np.log(np.diff(first)), np.log(np.geomspace(TAIL**-1.5, 0.5, count))]
    return parameters(least_squares(residual, start, max_nfev=20000).x)


def constants() -> None:
    """Print the constants of the closed forms."""
    coefficients, error = diffuse_remainder()
    print("REMAINDER, error of the peak", error, "in use differs by", np.abs(coefficients - REMAINDER.numpy()).max())
    print(np.array2string(coefficients, separator=", ", precision=9, max_line_width=120))
    for row in zip(*ggx_as_gaussians(), strict=True):
        print("({:.9g}, {:.9g})".format(*row))


def paper() -> None:
    """Render, train, and write the weights of the paper's operator with their errors."""
    torch.set_num_threads(1)  # sums depend on it
    rng = np.random.default_rng(0)
    light = random_spheres(rng, SPHERES)
    pixels = rendered(light, PIXELS, rng)
    each = (light.axis[:, None], light.sharpness[:, None], light.roughness[:, None])
    vectors = (pixels.normal, half_of_normal_and_view(pixels.normal, FRONT), *each)
    shape = pixels.normal.shape[:2]
    normal, half, axis, sharpness, roughness = (np.broadcast_to(t, (*shape, *t.shape[2:])) for t in vectors)
    normal, half, axis = (tuple(_flat(v[..., k]) for k in range(3)) for v in (normal, half, axis))
    sharpness, roughness = _flat(sharpness), _flat(roughness)
    inputs = {
        "diffuse": diffuse_inputs(normal, axis, sharpness),
        "specular": specular_inputs(normal, half, axis, sharpness, roughness),
    }
    for part, of in inputs.items():
        examples = Examples(of, sharpness, _flat(getattr(pixels, part)))
        layers = trained(examples, SCHEDULES[part], lambda *at, part=part: print(part, *at, flush=True))
        file, note = SHIPPED / f"paper_{part}.safetensors", "see factorlib.reflection.paper_network"
        write_layers(file, layers, torch.float16, inputs=note)
    operator = reflection_operator("paper_network")
    glossy = specular_errors(operator, specular_samples(16384, 99, tolerance=1e-6))
    matte = diffuse_errors(operator, diffuse_samples(16384, 98))
    write_json(SHIPPED / "paper_accuracy.json", {"diffuse": matte, "specular": glossy})


def _flat(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values.reshape(-1).copy())


if __name__ == "__main__":
    {"constants": constants, "paper": paper}[sys.argv[1]]()
