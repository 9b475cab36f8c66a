"""Samples of the reflection operator's inputs for training and measuring, and tables of an operator's errors there.

Errors are |R − S| / (S + E/100). The samples spread evenly over what occurs in a solve: α log-uniform in [0.01, 1],
sharpness log-uniform in [0.3, 5000], n·o uniform in [0.02, 1]. The lobe's axis is about the mirror direction with a
spread of 2√(α²/2 + 1/λ) for two thirds of the samples, and uniform on the sphere for one third.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import qmc
from torch import Tensor

from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.reference import converged, diffuse_quadrature

Range = tuple[float, float]  # least and greatest
GRAZING = 0.3  # most of the hard cases have an n·o below this
QUANTILES = {"median": 0.5, "p95": 0.95, "p99": 0.99, "worst": 1.0}
ROUGHNESS = (0.1, 0.18, 0.32, 0.56, 1.0)  # edges of the bins of tables
SHARPNESS = (0.3, 3.0, 30.0, 300.0, 5000.0)
COSINE = (0.0, 0.1, 0.3, 0.6, 1.0)
DEGREES = (0.0, 10.0, 30.0, 90.0, 180.0)


class DiffuseSamples(msgspec.Struct, frozen=True):
    """Two scalars of the diffuse part and its value, float64."""

    sharpness: Float[Tensor, " n"]
    nz: Float[Tensor, " n"]
    value: Float[Tensor, " n"]

    def scale(self) -> Float[Tensor, " n"]:
        """Return S + E/100, the unit of errors; E is the lobe's integral."""
        return self.value + lobe_integral(self.sharpness) / 100


class Samples(DiffuseSamples, frozen=True):
    """Five scalars of the specular part and its value, float64."""

    alpha: Float[Tensor, " n"]
    no: Float[Tensor, " n"]
    oz: Float[Tensor, " n"]

    def inputs(self) -> tuple[Tensor, ...]:
        """Return α, λ, n·o, n·z, o·z: the arguments of the specular formula."""
        return self.alpha, self.sharpness, self.no, self.nz, self.oz

    def joined(self, other: Samples) -> Samples:
        """Concatenate these samples and the others."""
        return Samples(*(torch.cat([getattr(self, name), getattr(other, name)]) for name in self.__struct_fields__))


def diffuse_samples(count: int, seed: int, *, sharpness: Range = (0.3, 5000.0)) -> DiffuseSamples:
    """Draw samples of the diffuse part and compute their values by quadrature.

    Half of the n·z are uniform, half lie within three widths of the horizon.

    Args:
        count: Number of samples.
        seed: Seed of the Sobol sequence.
        sharpness: Range of λ, which is log-uniform.

    Returns:
        Samples with values.
    """
    u = torch.from_numpy(_sobol(3, count, seed))
    lam = sharpness[0] * (sharpness[1] / sharpness[0]) ** u[:, 0]
    even = 2 * u[:, 1] - 1
    nz = torch.where(u[:, 2] < 0.5, even, (3 * even / torch.sqrt(lam)).clamp(-1, 1))
    value = torch.cat([diffuse_quadrature(a, c) for a, c in zip(lam.split(4096), nz.split(4096), strict=True)])
    return DiffuseSamples(lam, nz, value)


def specular_inputs(
    count: int,
    seed: int,
    *,
    alpha: Range = (0.01, 1.0),
    sharpness: Range = (0.3, 5000.0),
    least_no: float = 0.02,
    grazing: bool = False,
) -> tuple[Tensor, ...]:
    """Draw inputs of the specular part from the distribution above, by a scrambled Sobol sequence.

    Args:
        count: Number of samples.
        seed: Seed of the Sobol sequence.
        alpha: Range of α, which is log-uniform.
        sharpness: Range of λ, which is log-uniform.
        least_no: Least n·o.
        grazing: Draw n·o log-uniform up to GRAZING instead of uniform up to 1.

    Returns:
        α, λ, n·o, n·z, o·z, [count] each.
    """
    # the material's α, the lobe's λ and the view's n·o
    u = _sobol(6, count, seed)
    a = alpha[0] * (alpha[1] / alpha[0]) ** u[:, 0]
    lam = sharpness[0] * (sharpness[1] / sharpness[0]) ** u[:, 1]
    no = least_no * (GRAZING / least_no) ** u[:, 2] if grazing else least_no + (1 - least_no) * u[:, 2]
    view = np.stack([np.sqrt(1 - no**2), 0 * no, no], 1)
    spread = 2 * np.sqrt(a**2 / 2 + 1 / lam)
    # the lobe's axis: two thirds near the mirror direction (Rayleigh distribution), one third uniform on the sphere
    rayleigh = np.sqrt(-2 * np.log1p(-u[:, 3]))
    near = _turned(view * [-1, 1, 1], spread * rayleigh, 2 * np.pi * u[:, 4])
    far = _turned(np.tile([0.0, 0.0, 1.0], (count, 1)), np.arccos(1 - 2 * u[:, 3]), 2 * np.pi * u[:, 4])
    z = np.where(u[:, 5:] < 2 / 3, near, far)
    return tuple(torch.from_numpy(t.copy()) for t in (a, lam, no, z[:, 2], (z * view).sum(1)))


def specular_samples(count: int, seed: int, *, tolerance: float, **ranges: Any) -> Samples:
    """Draw samples of the specular part and compute their reference values.

    Args:
        count: Number of samples.
        seed: Seed of the Sobol sequence.
        tolerance: Relative tolerance of the quadrature.
        **ranges: Further arguments of `specular_inputs`.

    Returns:
        Samples with values.
    """
    alpha, sharpness, no, nz, oz = inputs = specular_inputs(count, seed, **ranges)
    return Samples(sharpness, nz, converged(*inputs, tolerance=tolerance), alpha, no, oz)


def _sobol(dimensions: int, count: int, seed: int) -> Float[np.ndarray, "count d"]:
    """Return scrambled Sobol points in the unit cube."""
    sequence = qmc.Sobol(dimensions, rng=np.random.default_rng(seed))
    return sequence.random_base2(max(1, math.ceil(math.log2(count))))[:count]


def _turned(axis: np.ndarray, angle: np.ndarray, azimuth: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Turn each `axis` (in the plane y = 0) by `angle` in the direction `azimuth`, both in radians."""
    across = np.stack([axis[:, 2], 0 * angle, -axis[:, 0]], 1)
    sin, cos = np.sin(angle)[:, None], np.cos(angle)[:, None]
    return cos * axis + sin * (np.cos(azimuth)[:, None] * across + np.sin(azimuth)[:, None] * np.array([0.0, 1.0, 0.0]))


def quantiles(error: Float[Tensor, " n"]) -> dict[str, float | int]:
    """Return quantiles of |error|, rounded to 4 digits, and the number of samples."""
    size = error.abs().double()
    return {name: float(f"{float(size.quantile(q)):.4g}") for name, q in QUANTILES.items()} | {"samples": len(size)}


def binned(error: Float[Tensor, " n"], value: Float[Tensor, " n"], edges: tuple[float, ...]) -> dict[str, dict]:
    """Return the `quantiles` of each bin that has samples, keyed by the bin's edges.

    Args:
        error: Error of each sample.
        value: Quantity of each sample that selects its bin.
        edges: Edges of the bins, ascending.

    Returns:
        Quantiles of each bin.
    """
    table = {}
    for k, (low, high) in enumerate(zip(edges, edges[1:], strict=False)):
        inside = (value >= low) & ((value < high) | (k == len(edges) - 2))
        if inside.any():
            table[f"{low:g} to {high:g}"] = quantiles(error[inside])
    return table


def specular_table(error: Tensor, alpha: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> dict:
    """Tabulate errors over all samples, and by roughness, sharpness, view cosine and angle from the mirror direction.

    Args:
        error: Error of each sample, [n].
        alpha: GGX width α, [n].
        sharpness: Sharpness λ, [n].
        no: Cosine n·o, [n].
        nz: Cosine n·z, [n].
        oz: Cosine o·z, [n].

    Returns:
        Quantiles of all samples and of each bin.
    """
    angle = torch.rad2deg(torch.arccos((2 * no * nz - oz).clamp(-1, 1)))
    return quantiles(error) | {
        "roughness": binned(error, alpha.sqrt(), ROUGHNESS),
        "sharpness": binned(error, sharpness, SHARPNESS),
        "cosine of the view": binned(error, no, COSINE),
        "degrees from the mirror direction": binned(error, angle, DEGREES),
    }


def diffuse_table(error: Tensor, sharpness: Tensor, nz: Tensor) -> dict:
    """Tabulate errors over all samples, and by sharpness and the lobe's angle from the normal.

    Args:
        error: Error of each sample, [n].
        sharpness: Sharpness λ, [n].
        nz: Cosine n·z, [n].

    Returns:
        Quantiles of all samples and of each bin.
    """
    angle = torch.rad2deg(torch.arccos(nz.clamp(-1, 1)))
    return quantiles(error) | {
        "sharpness": binned(error, sharpness, SHARPNESS),
        "degrees from the normal": binned(error, angle, DEGREES),
    }
