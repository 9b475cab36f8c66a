"""Error and time of every reflection operator, as JSON: `python -m benchmarks.operator [--samples 16384]`.

Errors are |R − S| / (S + E/100) over the distribution of `factorlib.reflection.samples`, those of gradients
|∂R − ∂S| / (|∂S| + S + E/100).  Time is a core's, per (observation, lobe), of `response`: values and all gradients.
"""

from __future__ import annotations

import time
from typing import Annotated

import torch
import typer

from factorlib.jsonfile import json_text
from factorlib.reflection import reflection_operator
from factorlib.reflection.accuracy import diffuse_table, quantiles, specular_table
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.samples import diffuse_samples, specular_inputs, specular_samples

OPERATORS = (
    ("closed_form", "float32"),
    ("closed_form", "float64"),
    ("network", "float32"),
    ("network", "float64"),
    ("paper_network", "float32"),
    ("reference", "float64"),
)
SLOPES = ("roughness", "log_sharpness", "no", "nz", "oz")


def errors(operator, samples) -> dict:
    a, lam, no, nz, oz = (t.to(operator.dtype) for t in samples.inputs())
    with torch.no_grad():
        value = operator.specular(a.sqrt()[:, None], lam[:, None], no, nz[:, None], oz[:, None])[:, 0]
    return specular_table((value.double() - samples.value) / samples.scale(), *samples.inputs())


def diffuse_errors(operator, samples) -> dict:
    sharpness, nz = (t.to(operator.dtype)[:, None] for t in (samples.sharpness, samples.nz))
    with torch.no_grad():
        value = operator.diffuse(sharpness, nz)[:, 0]
    return diffuse_table((value.double() - samples.value) / samples.scale(), samples.sharpness, samples.nz)


def gradient_errors(operator, reference, count: int = 512) -> dict:
    found, exact = (gradients(o, *specular_inputs(count, 5)) for o in (operator, reference))
    scale = exact[0] + lobe_integral(specular_inputs(count, 5)[1]) / 100
    return {name: quantiles((f - e) / (e.abs() + scale)) for name, f, e in zip(SLOPES, found[1:], exact[1:], strict=True)}


def gradients(operator, alpha, sharpness, no, nz, oz) -> list[torch.Tensor]:
    """Value and derivatives of samples that share nothing, each a problem of one lobe and one point; float64."""
    leaves = [t.to(operator.dtype)[:, None].clone().requires_grad_() for t in (alpha.sqrt(), sharpness.log(), no, nz, oz)]
    value = operator.specular(leaves[0], leaves[1].exp(), *leaves[2:])
    return [t.detach()[:, 0].double() for t in (value, *torch.autograd.grad(value.sum(), leaves))]


def microseconds(operator, rows: int, lobes: int = 64) -> float:
    """Least of five repeats, processor time, after one that compiles."""
    g = torch.Generator().manual_seed(0)
    n, o, z = (torch.nn.functional.normalize(torch.randn(k, 3, generator=g, dtype=torch.float64), dim=1) for k in (rows, rows, lobes))
    o = torch.where(((n * o).sum(1) > 0)[:, None], o, -o)
    point = (torch.tensor(0.4), torch.logspace(-0.5, 3.5, lobes), (n * o).sum(1), n @ z.T, o @ z.T)
    point = tuple(t.to(operator.dtype) for t in point)
    operator.response(*point)
    taken = []
    for _ in range(5):
        start = time.process_time()
        operator.response(*point)
        taken.append(time.process_time() - start)
    return min(taken) / (rows * lobes) * 1e6


def main(samples: Annotated[int, typer.Option(help="of the reference")] = 16384) -> None:
    torch.set_num_threads(1)
    specular, diffuse, reference = (
        specular_samples(samples, 99, tolerance=1e-6),
        diffuse_samples(samples, 98),
        reflection_operator("reference"),
    )
    table = {}
    for name, dtype in OPERATORS:
        operator = reflection_operator(name, dtype=dtype)
        row = table[f"{name} {dtype}"] = {"microseconds": microseconds(operator, 8 if name == "reference" else 2048)}
        if name != "reference":
            row |= {"specular": errors(operator, specular), "gradients": gradient_errors(operator, reference)}
            row["diffuse"] = diffuse_errors(operator, diffuse)
    print(json_text(table), end="")


if __name__ == "__main__":
    typer.run(main)
