"""Reflection networks: the closed forms times exp(a small perceptron of symmetric features).

The closed form keeps the limits right, so the perceptron only has to learn a smooth factor.  Its features are smooth
functions of the 2 (diffuse) and 5 (specular) scalars on which reflection depends.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from factorlib.errors import InputError
from factorlib.reflection.brdf import LEAST_COSINE, lobe_integral
from factorlib.reflection.closed_form import filtered_specular, lobe_moments, mean_cosine
from factorlib.reflection.operator import Operator

SHIPPED = Path(__file__).parent / "weights"
PARTS = ("diffuse", "specular")
MOST = 6.0  # the learned factor stays within exp(±6)
ROUGHNESS, SHARPNESS = (0.1, 1.0), (0.05, 10000.0)  # beyond, the factor is that of the nearest trained input


class Correction(nn.Module):
    """log factor = perceptron((features − mean) / deviation), SiLU between layers, bounded by ±MOST."""

    def __init__(self, inputs: int, width: int, depth: int):
        super().__init__()
        sizes = [inputs, *[width] * depth, 1]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False))
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("deviation", torch.ones(inputs))

    def forward(self, features: Float[Tensor, "n f"]) -> Float[Tensor, "n"]:
        x = (features - self.mean) / self.deviation
        for layer in self.layers[:-1]:
            x = nn.functional.silu(layer(x))
        return MOST * torch.tanh(self.layers[-1](x)[:, 0] / MOST)


def diffuse_features(sharpness: Tensor, nz: Tensor) -> Float[Tensor, "n f"]:
    """n flat cases."""
    sharpness = sharpness.clamp(*SHARPNESS)
    mean, along, across = lobe_moments(sharpness)
    u = mean * nz / torch.sqrt(across * (1 - nz**2).clamp_min(0) + along * nz**2 + 1e-9)
    return torch.stack([mean, nz, mean * nz, torch.log1p(sharpness), torch.tanh(u / 2), torch.log1p((0.5 * u) ** 2)], -1)


def specular_features(roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Float[Tensor, "n f"]:
    """n flat cases."""
    roughness, sharpness = roughness.clamp(*ROUGHNESS), sharpness.clamp(*SHARPNESS)
    alpha2 = roughness**4
    mean, _, across = lobe_moments(sharpness)
    mirror = (2 * no * nz - oz).clamp(-1, 1)
    length = torch.sqrt((2 + 2 * oz).clamp_min(1e-4))
    off2 = (1 - ((no + nz) / length) ** 2).clamp_min(0)
    horizon = nz / torch.sqrt(across)
    return torch.stack([
        torch.log(roughness), torch.log1p(sharpness), no, torch.log(no), nz, oz, mirror, mean * nz, length,
        torch.log(alpha2 + across), torch.log(alpha2 / (alpha2 + across)),
        torch.log1p((1 - mirror) / (alpha2 + across)), torch.log1p(off2 / (alpha2 + across / 2)),
        torch.tanh(horizon / 2), torch.tanh(nz / (alpha2 + 0.05)),
    ], -1)  # fmt: skip


FEATURES = {"diffuse": 6, "specular": 15}


class Network(Operator):
    """Closed forms times learned corrections.  `weights`: folder of the two files, None for the shipped ones."""

    def __init__(self, weights: str | Path | None = None, dtype: torch.dtype = torch.float32):
        super().__init__(dtype)
        folder = Path(weights) if weights is not None else SHIPPED
        self.corrections = {part: read_correction(folder / f"{part}.safetensors", part).to(dtype) for part in PARTS}

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        return corrected_diffuse(self.corrections["diffuse"], sharpness.expand(nz.shape).reshape(-1), nz.reshape(-1)).reshape(nz.shape)

    def specular(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Float[Tensor, "n p"]:
        flat = [t.expand(nz.shape).reshape(-1) for t in (roughness, sharpness, no[:, None], nz, oz)]
        return corrected_specular(self.corrections["specular"], *flat).reshape(nz.shape)


def corrected_diffuse(correction: Correction, sharpness: Tensor, nz: Tensor) -> Float[Tensor, "n"]:
    nz = nz.clamp(-1, 1)
    factor = torch.exp(correction(diffuse_features(sharpness, nz)))
    return lobe_integral(sharpness) / torch.pi * mean_cosine(sharpness, nz) * factor


def corrected_specular(correction: Correction, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Float[Tensor, "n"]:
    no, nz, oz = no.clamp(LEAST_COSINE, 1), nz.clamp(-1, 1), oz.clamp(-1, 1)
    factor = torch.exp(correction(specular_features(roughness, sharpness, no, nz, oz)))
    return filtered_specular(roughness**2, sharpness, no, nz, oz) * factor


def write_correction(path: str | Path, correction: Correction) -> None:
    save_file({name: tensor.contiguous() for name, tensor in correction.state_dict().items()}, str(path))


def read_correction(path: str | Path, part: str) -> Correction:
    """Raises InputError where the file is missing or of another architecture."""
    try:
        state = load_file(str(path))
        layers = [state[f"layers.{k}.weight"] for k in range(sum(name.endswith("weight") for name in state))]
        correction = Correction(layers[0].shape[1], layers[0].shape[0], len(layers) - 1)
        correction.load_state_dict(state)
        _expect(layers, FEATURES[part])
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        raise InputError(f"not the weights of a {part} network ({error})", file=path, cure="run the stage `train` again") from error
    return correction.eval().requires_grad_(False)


def _expect(layers: Sequence[Tensor], inputs: int) -> None:
    if layers[0].shape[1] != inputs:
        raise ValueError(f"{layers[0].shape[1]} features, {inputs} expected")
