"""Errors of an operator against the reference, |R − S| / (S + E/100), as quantiles over bins of its inputs."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

QUANTILES = {"median": 0.5, "p95": 0.95, "p99": 0.99, "worst": 1.0}
ROUGHNESS = (0.1, 0.18, 0.32, 0.56, 1.0)
SHARPNESS = (0.3, 3.0, 30.0, 300.0, 5000.0)
COSINE = (0.0, 0.1, 0.3, 0.6, 1.0)
DEGREES = (0.0, 10.0, 30.0, 90.0, 180.0)


def quantiles(error: Float[Tensor, " n"]) -> dict[str, float | int]:
    """Quantiles of |error| and the number of samples; 4 digits, since more say nothing."""
    size = error.abs().double()
    return {name: float(f"{float(size.quantile(q)):.4g}") for name, q in QUANTILES.items()} | {"samples": len(size)}


def binned(error: Float[Tensor, " n"], value: Float[Tensor, " n"], edges: tuple[float, ...]) -> dict[str, dict]:
    """`quantiles` of each bin that has samples, by its edges."""
    table = {}
    for k, (low, high) in enumerate(zip(edges, edges[1:], strict=False)):
        inside = (value >= low) & ((value < high) | (k == len(edges) - 2))
        if inside.any():
            table[f"{low:g} to {high:g}"] = quantiles(error[inside])
    return table


def specular_table(error: Tensor, alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> dict:
    """Errors over all samples, and by roughness, sharpness, cosine of the view and the lobe's angle from the mirror direction."""
    angle = torch.rad2deg(torch.arccos((2 * no * nz - oz).clamp(-1, 1)))
    return quantiles(error) | {
        "roughness": binned(error, alpha.sqrt(), ROUGHNESS),
        "sharpness": binned(error, sharpness, SHARPNESS),
        "cosine of the view": binned(error, no, COSINE),
        "degrees from the mirror direction": binned(error, angle, DEGREES),
    }


def diffuse_table(error: Tensor, sharpness: Tensor, nz: Tensor) -> dict:
    """Errors over all samples, and by sharpness and the lobe's angle from the normal."""
    angle = torch.rad2deg(torch.arccos(nz.clamp(-1, 1)))
    return quantiles(error) | {
        "sharpness": binned(error, sharpness, SHARPNESS),
        "degrees from the normal": binned(error, angle, DEGREES),
    }
