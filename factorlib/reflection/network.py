"""Reflection operator by networks: each formula times the exponential of a small fully connected network.

    R = closed form · exp(s · tanh(net(features) / s)),     s = 8

Features are smooth functions of the symmetric inputs. Most of them are intermediate results of the formula: the point
p* about which the light was expanded, the distance of the product from the normal, the part above the horizon. For
lobes sharper than in training the correction fades as 1/√λ, so that the formula's limit stays.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.reflection import closed_form
from factorlib.reflection.features import LARGEST, Layers, diffuse_columns, fading, specular_columns
from factorlib.reflection.filtering import Filtered, filtered_specular
from factorlib.reflection.fused import fused
from factorlib.reflection.lobe import gaussian_sharpness, lobe_moments
from factorlib.reflection.operator import MOST, Operator, Response, columns
from factorlib.wholefile import write_bytes

SHIPPED = Path(__file__).parent / "weights"
FEATURES = {"diffuse": 8, "specular": 24}
Features = Float[Tensor, "*b features"]


def correction(layers: Layers, features: Tensor, sharpness: Tensor) -> Tensor:
    """Return the logarithm of the factor on the formula.

    Args:
        layers: The network.
        features: Its inputs, [*b, features].
        sharpness: Sharpness λ of each lobe, [*b].

    Returns:
        A tensor [*b] between −LARGEST and LARGEST.
    """
    return fading(sharpness) * LARGEST * torch.tanh(layers(features) / LARGEST)


def specular_features(alpha: Tensor, no: Tensor, nz: Tensor, oz: Tensor, form: Filtered) -> Features:
    """Return the inputs of the specular network, from tensors that broadcast.

    Args:
        alpha: GGX width α = roughness².
        no: Cosine n·o of the view direction.
        nz: Cosine n·z of the lobe's axis.
        oz: Cosine o·z between view and axis.
        form: Result of `filtered_specular` for the same inputs.

    Returns:
        A tensor [*b, 24].
    """
    return torch.stack(torch.broadcast_tensors(*specular_columns(alpha, no, nz, oz, form)), -1)


def diffuse_features(sharpness: Tensor, nz: Tensor) -> Features:
    """Return the inputs [*b, 8] of the diffuse network, from tensors that broadcast."""
    columns = diffuse_columns(gaussian_sharpness(sharpness), *lobe_moments(sharpness), nz)
    return torch.stack(torch.broadcast_tensors(*columns), -1)


class Network(Operator):
    """Reflection operator by learned corrections of the closed form.

    Args:
        weights: Folder with diffuse.safetensors and specular.safetensors; None takes the shipped ones.
        dtype: Floating-point type; compiled code serves float32 only.
    """

    def __init__(self, weights: str | Path | None = None, dtype: torch.dtype = torch.float32):
        super().__init__(dtype)
        folder = Path(weights) if weights is not None else SHIPPED
        self.layers = {part: read_layers(folder / f"{part}.safetensors", FEATURES[part]).to(dtype) for part in FEATURES}
        compiled = self.layers if dtype == torch.float32 else {}
        self.fused = {part: code for part, layers in compiled.items() if (code := fused(part, layers))}

    def _compiled(self, sharpness: Tensor, *others: Tensor) -> bool:
        """Return whether compiled code can answer.

        It needs one sharpness a column, finite values on the CPU, and no gradient recorded by autograd. Compiled code
        does not pass NaN on as torch does.
        """
        if len(self.fused) < len(FEATURES) or sharpness.ndim != 1:
            return False
        listening = torch.is_grad_enabled() and any(t.requires_grad for t in (sharpness, *others))
        return not listening and all(t.device.type == "cpu" and math.isfinite(t.sum()) for t in (sharpness, *others))

    def response(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Response:
        """Return values and derivatives; in float32 by compiled code, where there is a compiler.

        Args:
            roughness: Roughness √α of the material, [].
            sharpness: Sharpness λ, [p].
            no: Cosine n·o, [n].
            nz: Cosine n·z, [n, p].
            oz: Cosine o·z, [n, p].

        Returns:
            Values and derivatives, [n, p] each, detached from torch's graph.
        """
        if not self._compiled(*(t.detach() for t in (sharpness, roughness, no, nz, oz))):
            return super().response(roughness, sharpness, no, nz, oz)
        diffuse, _, by_log_sharpness, _, by_nz, _ = self.fused["diffuse"](0.0, sharpness, no, nz, oz)
        specular = self.fused["specular"](float(roughness), sharpness, no, nz, oz)
        return Response(diffuse, by_log_sharpness, by_nz, *specular)

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        """Return the diffuse reflection of unit lobes; see `Operator.diffuse`.

        Compiled code answers in float32, where there is a compiler and no derivative is asked for.
        """
        if self._compiled(sharpness, nz):
            return self.fused["diffuse"].value(0.0, sharpness, nz.new_ones(len(nz)), nz, nz)
        nz = nz.clamp(-1, 1)
        formula = closed_form.diffuse(sharpness, nz)
        return formula * torch.exp(correction(self.layers["diffuse"], diffuse_features(sharpness, nz), sharpness))

    def specular(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
        """Return the specular reflection of unit lobes, at most MOST; see `Operator.specular`.

        Compiled code answers in float32, where there is a compiler and no derivative is asked for.

        Args:
            roughness: Roughness √α, [] or [n, p].
            sharpness: Sharpness λ, [p] or [n, p].
            no: Cosine n·o, [n] or [n, p].
            nz: Cosine n·z, [n, p].
            oz: Cosine o·z, [n, p].

        Returns:
            Reflection for k_s = 1, [n, p].
        """
        if roughness.ndim == 0 and no.ndim == 1 and self._compiled(sharpness, no, nz, oz, roughness):
            return self.fused["specular"].value(float(roughness), sharpness, no, nz, oz)
        alpha, sharpness, no, nz, oz = torch.broadcast_tensors(roughness**2, sharpness, columns(no), nz, oz)
        form = filtered_specular(alpha, sharpness, no, nz, oz)
        grown = torch.exp(correction(self.layers["specular"], specular_features(alpha, no, nz, oz, form), sharpness))
        return (form.value * grown).clamp_max(MOST)


def write_layers(path: Path, layers: Layers, dtype: torch.dtype = torch.float32, **metadata: str) -> None:
    """Write a network as safetensors.

    Args:
        path: File to write.
        layers: The network.
        dtype: Type that the weights are rounded to.
        **metadata: Entries of the file's metadata, beside the architecture.
    """
    tensors = {"feature.mean": layers.mean, "feature.scale": layers.scale}
    for k, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        tensors |= {f"layer.{k}.weight": weight, f"layer.{k}.bias": bias}
    sizes = [layers.weights[0].shape[1], *(len(b) for b in layers.biases)]
    about = {"architecture": "standardise, linear, SiLU, …, linear", "sizes": sizes, **metadata}
    one_key = {"factorlib": json_text(about)}  # safetensors writes several in an order that changes from run to run
    write_bytes(path, save({name: t.detach().to(dtype).contiguous() for name, t in tensors.items()}, metadata=one_key))


def read_layers(path: Path, features: int) -> Layers:
    """Read the network of `features` inputs from the file `path`.

    Raises:
        InputError: If the file is missing or holds a network of another number of features.
    """
    if not path.exists():
        cure = "make them by `make train`, or leave `weights` out"
        raise InputError("no weights of the reflection network here", file=path, cure=cure)
    with safe_open(path, framework="pt") as file:
        count = sum(name.endswith(".bias") for name in file.keys())  # noqa: SIM118
        weights, biases = ([file.get_tensor(f"layer.{k}.{kind}") for k in range(count)] for kind in ("weight", "bias"))
        layers = Layers(file.get_tensor("feature.mean"), file.get_tensor("feature.scale"), weights, biases)
    if len(layers.mean) != features:
        fault = f"a network of {len(layers.mean)} features, not {features}"
        raise InputError(fault, file=path, cure="make it again by `make train`")
    return layers
