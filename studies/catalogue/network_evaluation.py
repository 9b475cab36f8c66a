"""Network evaluation: how far are the operators from exact reflection, by roughness?

Varied     the operator (this project's network, its closed form, the paper's networks) and the band of roughness, .1 … 1.
Measured   seeds are samples and lights:
           error_…        |R − S| / (S + E/100), specular, as in docs/operator.md, S exact and E the lobe's integral; float32
           rendering      DSSIM of a sphere of k_s = 1 in light of `LOBES` lobes, against the same by the operator `reference`, after the
                          tone map of `factorlib.evaluate.picture`; a guess: the mean radiance everywhere
           microseconds   processor time of value and gradients, an evaluation
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from factorlib.jsonfile import write_json
from factorlib.stage import Inputs, Progress
from studies.steps import Params
from studies.study import Scale, Score, Setting, Study, own

OPERATORS = {"network": "network", "closed_form": "closed form", "paper_network": "paper's"}
BANDS = {"full": (0.1, 0.14, 0.2, 0.3, 0.45, 0.65, 1.0), "quick": (0.1, 0.3, 1.0)}
SAMPLES = {"full": 4096, "quick": 256}
EXACT, RENDERED = 1e-7, 1e-4  # tolerances of the reference, for samples and for the rendering
LOBES, SIZE = 6, 40  # of the light; pixels across a sphere
ROWS, REPEATS = 256, 3  # of points that are timed


def name_of(operator: str, band: int) -> str:
    """The name of a setting."""
    return f"{operator.replace('_', '-')}-{band}"


def settings(scale: Scale) -> list[Setting]:
    """Each operator, band by band."""
    edges, fields = BANDS[scale.name], ("operator", "low", "high", "samples")
    cases = {
        (name_of(o, k), f"{words}, {edges[k]:g}–{edges[k + 1]:g}"): (o, *edges[k : k + 2], SAMPLES[scale.name])
        for o, words in OPERATORS.items()
        for k in range(len(edges) - 1)
    }
    return [
        Setting(*n, lambda seed, c=c: {"seed": seed, **dict(zip(fields, c, strict=True))}) for n, c in cases.items()
    ]


OTHERS = {"closed_form": "the closed form", "paper_network": "the paper's networks"}
STUDY = Study(
    name="network-evaluation",
    title="Network evaluation",
    question="How far are the operators from exact reflection, by roughness?",
    paper="The network's renderings beside true ones, by roughness. (No number is taken over from the paper.)",
    varied="operator and roughness",
    measures=("error_median", "error_p95", "rendering", "microseconds", "error_worst"),
    settings=settings,
    claims=tuple(
        own(m, name_of("network", k), name_of(o, k), f"the network is nearer than {words} for the {band} ({of})")
        for k, band in {0: "smoothest", 5: "roughest"}.items()
        for o, words in OTHERS.items()
        for m, of in {"error_median": "median error", "rendering": "sphere"}.items()
    ),
    steps=(),
)


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sample, render, time: writes <case>.json."""
    write_json(out / f"{inputs.photo}.json", score_of(**inputs.facts["dataset.case"]))


def score_of(seed: int, operator: str, low: float, high: float, samples: int) -> Score:
    """Errors, a rendering and a time of an operator, for roughnesses from `low` to `high`."""
    import numpy as np
    import torch

    from factorlib.evaluate.ball import VIEW
    from factorlib.evaluate.picture import picture_error, white_of
    from factorlib.geometry.sphere import ball_normals
    from factorlib.reflection import reflection_operator
    from factorlib.reflection.reference import Reference
    from factorlib.reflection.samples import specular_samples
    from studies.measured.operator import LOBES as TIMED
    from studies.measured.operator import point, specular_errors, values_and_gradients

    torch.set_num_threads(1)
    network = reflection_operator(operator, dtype="float32")
    drawn = specular_samples(samples, seed, tolerance=EXACT, alpha=(low**2, high**2))
    errors = specular_errors(network, drawn)
    (normals, inside), (axis, sharpness, weight) = ball_normals(SIZE), light_of(seed)

    def picture(by: Any) -> np.ndarray:
        """The sphere of k_s = 1, seen from z: α is spread evenly in its logarithm, so its middle is rendered."""
        n, z, o, λ = (torch.as_tensor(t).to(by.dtype) for t in (normals, axis, VIEW, sharpness))
        rough = torch.as_tensor((low * high) ** 0.5).to(by.dtype)
        with torch.no_grad():
            unit = by.specular(rough, λ, n @ o, n @ z.T, (z @ o).expand(len(n), -1).contiguous())
        return unit.double().numpy() @ weight

    def dssim(radiance: np.ndarray) -> float:
        """Of a sphere against the reference's."""
        both = np.zeros((2, *inside.shape, 3))
        both[0][inside], both[1][inside] = radiance, true
        return picture_error(*both, inside, white_of(both[1], inside)).dssim

    true, times, timed = picture(Reference(tolerance=RENDERED)), [], point(network, ROWS)
    for _ in range(REPEATS + 1):  # the first one compiles
        start = time.process_time()
        values_and_gradients(network, *timed)
        times.append((time.process_time() - start) / (ROWS * TIMED) * 1e6)
    values = {f"error_{name}": errors[name] for name in ("median", "p95", "worst")}
    values |= {"rendering": dssim(picture(network)), "microseconds": min(times[1:])}
    return Score(values, {"rendering": dssim(np.broadcast_to(true.mean(axis=0), true.shape))})


def light_of(seed: int) -> tuple[Any, Any, Any]:
    """Axes, sharpnesses and weights of lobes from broad to sharp, most of them before the sphere, y up."""
    import numpy as np

    rng = np.random.default_rng([14, seed])
    axis = rng.normal(size=(LOBES, 3)) + [0, 0.5, 1]
    sharpness = np.exp(rng.uniform(0, 4.5, LOBES))
    weight = rng.lognormal(0, 0.7, (LOBES, 1)) * rng.lognormal(0, 0.2, (LOBES, 3)) * np.sqrt(sharpness)[:, None]
    return axis / np.linalg.norm(axis, axis=1, keepdims=True), sharpness, weight
