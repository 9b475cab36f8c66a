"""What an operator says of special cases: its errors against quadrature, and what float32 rounds away."""

from __future__ import annotations

import torch

from benchmarks.operator.cases import Found, Pairs, found, gradient_error, value_error
from benchmarks.operator.variants import REFERENCE, made
from factorlib.reflection import Operator


def measures(given: Pairs, shown: dict[str, Operator], fast: dict[str, Operator], with_reference: bool) -> dict:
    """By label of `shown`; fast: the same operators in float32 and float64, by which rounding is measured."""
    exactly = {
        name: found(fast[f"{name} float64"], given)
        for name in {label.split()[0] for label in shown}
        if f"{name} float64" in fast
    }
    true = _values(given) if with_reference else None
    return {
        label: _measures(found(operator, given), exactly.get(label.split()[0]), true, given)
        for label, operator in shown.items()
    }


def _values(given: Pairs) -> dict[str, torch.Tensor]:
    """Diffuse and specular of the reference."""
    reference = made(REFERENCE, "float64")
    n, o, z = given.normal, given.view, given.axis
    no, nz, oz = (n * o).sum(1), (n * z).sum(1)[:, None], (o * z).sum(1)[:, None]
    with torch.no_grad():
        specular = reference.specular(given.roughness[:, None], given.sharpness[:, None], no, nz, oz)
        return {"diffuse": reference.diffuse(given.sharpness[:, None], nz)[:, 0], "specular": specular[:, 0]}


def _measures(answer: Found, exactly: Found | None, true: dict | None, given: Pairs) -> dict:
    measures: dict = {"pairs": len(given), "finite": answer.finite()}
    if exactly is not None:
        measures |= {
            "value_rounding": value_error(answer, exactly, given),
            "gradient_rounding": gradient_error(answer, exactly, given),
        }
    if true is not None:
        measures["value"] = value_error(answer, Found(true, answer.turning), given)
    return {k: float(f"{float(v.max()):.3g}") if torch.is_tensor(v) else v for k, v in measures.items()}
