"""Layers of the reflection networks and the features of a lobe and a material that enter them."""

from __future__ import annotations

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import silu

from factorlib.reflection.filtering import Filtered

LARGEST = 8.0  # greatest logarithm of the correction
SHARPEST = 1e4  # greatest sharpness at which the correction applies in full


class Layers(msgspec.Struct, frozen=True):
    """Fully connected network of SiLU layers; `mean` and `scale` standardise its features."""

    mean: Float[Tensor, " features"]
    scale: Float[Tensor, " features"]
    weights: list[Tensor]  # [out, in] each
    biases: list[Tensor]

    def __call__(self, features: Float[Tensor, "*b features"]) -> Float[Tensor, "*b"]:
        """Return the network's output, one number for each row of features."""
        x = (features - self.mean) * self.scale
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = silu(torch.nn.functional.linear(x, weight, bias))
        return torch.nn.functional.linear(x, self.weights[-1], self.biases[-1])[..., 0]

    def to(self, dtype: torch.dtype) -> Layers:
        """Convert the network to another floating-point type."""
        weights, biases = ([t.to(dtype) for t in tensors] for tensors in (self.weights, self.biases))
        return Layers(self.mean.to(dtype), self.scale.to(dtype), weights, biases)


def fading(sharpness: Tensor) -> Tensor:
    """Return the factor on the correction of each lobe: 1 up to SHARPEST, and √(SHARPEST/λ) beyond it."""
    return torch.rsqrt((sharpness / SHARPEST).clamp_min(1.0))


def specular_columns(alpha: Tensor, no: Tensor, nz: Tensor, oz: Tensor, form: Filtered) -> tuple[Tensor, ...]:
    """Return the features of the specular network, bounded, smooth and of the order of one.

    Args:
        alpha: GGX width α = roughness².
        no: Cosine n·o of the view direction.
        nz: Cosine n·z of the lobe's axis.
        oz: Cosine o·z between view and axis.
        form: Intermediate results of the formula for the same inputs.

    Returns:
        One tensor for each feature, 24 in all.
    """
    alpha = alpha.clamp(0.005, 1)
    log_width = torch.log(form.sharpness.clamp_max(2e4))
    u = form.ni / form.deviation
    height = nz * torch.sqrt(form.sharpness)  # height of the axis above the horizon, in widths of the lobe
    mirror = form.sharpness * (1 + oz - 2 * no * nz).clamp_min(0)  # λ'(1 − z·m), m the mirror direction
    of_inputs = torch.log(alpha), log_width, form.ratio, no, torch.log(no.clamp_min(1e-4) + 0.02), nz, oz
    of_place = form.px, form.py * form.py, form.misfit / (1 + form.misfit)
    of_density = torch.log(form.density + 1e-5), torch.log1p(form.spread), torch.log1p(torch.log1p(form.distance))
    of_light = form.ni, torch.log(form.deviation + 1e-3), u * torch.rsqrt(4 + u * u), u * torch.rsqrt(0.2 + u * u)
    of_horizon = form.cosine / (form.cosine + alpha), form.lit, no / (no + alpha)
    of_height = height * torch.rsqrt(1 + height * height), height * torch.rsqrt(16 + height * height)
    of_mirror = mirror / (1 + mirror), mirror / (16 + mirror)
    return *of_inputs, *of_place, *of_density, *of_light, *of_horizon, *of_height, *of_mirror


def diffuse_columns(lam: Tensor, mean: Tensor, along: Tensor, across: Tensor, nz: Tensor) -> tuple[Tensor, ...]:
    """Return the features of the diffuse network, bounded, smooth and of the order of one.

    Args:
        lam: λ' = λ / (1 − e^{−2λ}), see `gaussian_sharpness`.
        mean: Mean t̄ of i·z over the lobe, as `lobe_moments` returns it.
        along: Variance along the lobe's axis.
        across: Variance in each direction across the axis.
        nz: Cosine n·z of the lobe's axis.

    Returns:
        One tensor for each feature, 8 in all.
    """
    u = nz * mean * torch.rsqrt(across * (1 - nz * nz) + along * nz * nz + 1e-6)
    widths = mean, torch.log(lam.clamp_max(2e4)), across
    return *widths, nz, nz * nz, mean * nz, u * torch.rsqrt(1 + u * u), u * torch.rsqrt(8 + u * u)
