"""How far an operator is from the exact reflection, for roughnesses of a band: a case is an operator, a band, and samples of a seed.

median, p95, worst   of |R − S| / (S + E/100), specular, as in docs/operator.md (`benchmarks.operator`), S exact and E the
                     lobe's integral; float32
rendering            DSSIM of a sphere of k_s = 1 in light of `LOBES` lobes, against the same by `reference`, after the tone map of
                     `factorlib.evaluate.picture`; null: the mean radiance everywhere
microseconds         processor time of value and gradients, an evaluation (`benchmarks.operator`)
"""

from __future__ import annotations

import time

import numpy as np
import torch
from jaxtyping import Bool, Float

from benchmarks.operator import LOBES as TIMED
from benchmarks.operator import point, specular_errors, values_and_gradients
from factorlib.evaluate.ball import VIEW, ball_normals
from factorlib.evaluate.picture import picture_error, white_of
from factorlib.light.lobes import Lobes
from factorlib.reflection import Operator, reflection_operator
from factorlib.reflection.reference import Reference
from factorlib.reflection.samples import specular_samples
from studies.core.band import Band
from studies.core.case import Score

EXACT = 1e-7  # tolerance of the reference for samples
SHOWN = 1e-4  # of the reference that renders
LOBES, SIZE = 6, 40  # of the light; pixels across a sphere
ROWS, REPEATS = 256, 3  # of points that are timed


def score_of(case: Band) -> Score:
    """Errors, a rendering, a time."""
    torch.set_num_threads(1)
    operator = reflection_operator(case.operator, dtype="float32")
    samples = specular_samples(case.samples, case.seed, tolerance=EXACT, alpha=(case.low**2, case.high**2))
    errors = specular_errors(operator, samples)
    light, (normals, inside) = light_of(case.seed), ball_normals(SIZE)
    true, found = (rendered(o, light, normals, case.middle) for o in (Reference(tolerance=SHOWN), operator))
    values = {f"error_{name}": errors[name] for name in ("median", "p95", "worst")}
    values |= {"rendering": _dssim(found, true, inside), "microseconds": microseconds(operator)}
    return Score(values, {"rendering": _dssim(np.broadcast_to(true.mean(axis=0), true.shape), true, inside)})


def light_of(seed: int) -> Lobes:
    """From broad to sharp, most of them before the sphere, y up."""
    rng = np.random.default_rng([14, seed])
    axis = rng.normal(size=(LOBES, 3)) + [0, 0.5, 1]
    sharpness = np.exp(rng.uniform(0, 4.5, LOBES))
    weight = rng.lognormal(0, 0.7, (LOBES, 1)) * rng.lognormal(0, 0.2, (LOBES, 3)) * np.sqrt(sharpness)[:, None]
    return Lobes(axis / np.linalg.norm(axis, axis=1, keepdims=True), sharpness, weight)


def rendered(
    operator: Operator, light: Lobes, normals: Float[np.ndarray, "n 3"], roughness: float
) -> Float[np.ndarray, "n 3"]:
    """Radiance of k_s = 1, seen from z."""
    n, z, o = (torch.as_tensor(t).to(operator.dtype) for t in (normals, light.axis, VIEW))
    sharpness, alike = (torch.as_tensor(t).to(operator.dtype) for t in (light.sharpness, roughness))
    with torch.no_grad():
        unit = operator.specular(alike, sharpness, n @ o, n @ z.T, (z @ o).expand(len(n), -1).contiguous())
    return unit.double().numpy() @ light.weight


def microseconds(operator: Operator) -> float:
    """The least of `REPEATS`, after one that compiles."""
    inputs, taken = point(operator, ROWS), []
    for _ in range(REPEATS + 1):
        start = time.process_time()
        values_and_gradients(operator, *inputs)
        taken.append((time.process_time() - start) / (ROWS * TIMED) * 1e6)
    return min(taken[1:])


def _dssim(found: Float[np.ndarray, "n 3"], true: Float[np.ndarray, "n 3"], inside: Bool[np.ndarray, "h w"]) -> float:
    a, b = (np.zeros((*inside.shape, 3)) for _ in range(2))
    a[inside], b[inside] = found, true
    return picture_error(a, b, inside, white_of(b, inside)).dssim
