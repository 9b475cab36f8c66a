"""Network evaluation: how far are the operators from exact reflection, by roughness?

Varied     the operator (this project's network, its closed form, the paper's networks) and the band of roughness, .1 … 1.
Measured   seeds are samples and lights:
           error_…        |R − S| / (S + E/100), specular, as in docs/operator.md, S exact and E the lobe's integral; float32
           rendering      DSSIM of a sphere of k_s = 1 in light of `LOBES` lobes, against the same by the operator `reference`, after the
                          tone map of `factorlib.evaluate.picture`; a guess: the mean radiance everywhere
           microseconds   processor time of value and gradients, an evaluation
"""

from __future__ import annotations

from itertools import pairwise
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


def settings(scale: Scale) -> list[Setting]:
    """Each operator, band by band."""
    edges, made = BANDS[scale.name], []
    for o, words in OPERATORS.items():
        for k, (low, high) in enumerate(pairwise(edges)):
            case = {"operator": o, "low": low, "high": high, "samples": SAMPLES[scale.name]}
            label = f"{words}, {low:g}–{high:g}"
            made.append(Setting(f"{o.replace('_', '-')}-{k}", label, lambda seed, c=case: {"seed": seed, **c}))
    return made


OTHERS = {"closed-form": "the closed form", "paper-network": "the paper's networks"}
STUDY = Study(
    name="network-evaluation",
    title="Network evaluation",
    question="How far are the operators from exact reflection, by roughness?",
    paper="The network's renderings beside true ones, by roughness. (No number is taken over from the paper.)",
    varied="operator and roughness",
    measures=("error_median", "error_p95", "rendering", "microseconds", "error_worst"),
    settings=settings,
    claims=tuple(
        own(m, f"network-{k}", f"{o}-{k}", f"the network is nearer than {words} for the {band} ({of})")
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
    from studies.measured.operator import microseconds, specular_errors
    from studies.scenes.problems import random_light

    torch.set_num_threads(1)
    network, (normals, inside) = reflection_operator(operator, dtype="float32"), ball_normals(SIZE)
    light = random_light(np.random.default_rng([14, seed]), LOBES)

    def picture(by: Any) -> np.ndarray:
        """The sphere of k_s = 1, seen from z: α is spread evenly in its logarithm, so its middle is rendered."""
        given = (normals, light.axis, VIEW, np.exp(light.log_sharpness), (low * high) ** 0.5)
        n, z, o, λ, rough = (torch.as_tensor(t).to(by.dtype) for t in given)
        with torch.no_grad():
            unit = by.specular(rough, λ, n @ o, n @ z.T, (z @ o).expand(len(n), -1).contiguous())
        return unit.double().numpy() @ light.weight

    def dssim(radiance: np.ndarray) -> float:
        """Of a sphere against the reference's."""
        both = np.zeros((2, *inside.shape, 3))
        both[0][inside], both[1][inside] = radiance, true
        return picture_error(*both, inside, white_of(both[1], inside)).dssim

    true = picture(Reference(tolerance=RENDERED))
    errors = specular_errors(network, specular_samples(samples, seed, tolerance=EXACT, alpha=(low**2, high**2)))
    values = {f"error_{name}": errors[name] for name in ("median", "p95", "worst")}
    values |= {
        "rendering": dssim(picture(network)),
        "microseconds": min(microseconds({operator: network}, 256, 3)[operator][1]),
    }
    return Score(values, {"rendering": dssim(np.broadcast_to(true.mean(axis=0), true.shape))})
