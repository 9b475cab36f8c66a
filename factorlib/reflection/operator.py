"""The interface of every reflection operator."""

from __future__ import annotations

from typing import Any, Literal, Protocol, get_args

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

Name = Literal["reference", "closed_form", "network", "paper_network"]
NAMES = get_args(Name)
MOST = 1.0  # what a unit lobe reflects at most: its radiance is nowhere above 1, nor the albedo
PerLobe = Float[Tensor, "*p"]
PerPoint = Float[Tensor, "*n"]
PerPair = Float[Tensor, "n p"]
CHUNK = 1 << 14  # evaluations whose intermediate results are in memory at once


class LobesLike(Protocol):
    """Lobes weight · exp(λ(ω·axis − 1)), as tensors or arrays: axis [p, 3] unit, sharpness λ [p], weight [p, 3]."""

    axis: Any
    sharpness: Any
    weight: Any


class MaterialLike(Protocol):
    """A reflectance: diffuse k_d [3], specular k_s [3], roughness [] with α = roughness²."""

    diffuse: Any
    specular: Any
    roughness: Any


class Response(msgspec.Struct, frozen=True):
    """Reflection of unit lobes at unit reflectances, and its derivatives; every field [n, p]."""

    diffuse: Tensor
    diffuse_by_log_sharpness: Tensor
    diffuse_by_nz: Tensor
    specular: Tensor
    specular_by_roughness: Tensor
    specular_by_log_sharpness: Tensor
    specular_by_no: Tensor
    specular_by_nz: Tensor
    specular_by_oz: Tensor


class Operator:
    """R(lobe | material) for lobes exp(λ(ω·z − 1)).

    A subclass gives `diffuse` and `specular`, elementwise functions that torch can differentiate; a faster
    `response` where there is one.
    """

    def __init__(self, dtype: torch.dtype = torch.float32):
        self.dtype = dtype

    def diffuse(self, sharpness: PerLobe, nz: PerPair) -> PerPair:
        """(1/π) ∫ exp(λ(i·z − 1)) max(n·i, 0) di."""
        raise NotImplementedError

    def specular(self, roughness: Tensor, sharpness: PerLobe, no: PerPoint, nz: PerPair, oz: PerPair) -> PerPair:
        """∫ exp(λ(i·z − 1)) D G / (4 n·o) di over the upper hemisphere, α = roughness²; every input may be [n, p] as well."""
        raise NotImplementedError

    def response(self, roughness: Tensor, sharpness: PerLobe, no: PerPoint, nz: PerPair, oz: PerPair) -> Response:
        """Values and derivatives together; nothing is left on torch's graph."""
        rows = max(1, CHUNK // max(nz.shape[1], 1))
        chunks = zip(no.split(rows), nz.split(rows), oz.split(rows), strict=True)
        parts = [self._response(roughness, sharpness, *chunk) for chunk in chunks]
        return Response(*(torch.cat([getattr(part, field) for part in parts]) for field in Response.__struct_fields__))

    def _response(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Response:
        with torch.enable_grad():
            given = (roughness, sharpness.log(), columns(no), nz, oz)
            r, log_sharpness, views, nz, oz = (t.detach().expand(nz.shape).clone().requires_grad_() for t in given)
            diffuse = self.diffuse(log_sharpness.exp(), nz)
            specular = self.specular(r, log_sharpness.exp(), views, nz, oz)
            by_diffuse = torch.autograd.grad(diffuse.sum(), [log_sharpness, nz])
            by_specular = torch.autograd.grad(specular.sum(), [r, log_sharpness, views, nz, oz])
        return Response(*[diffuse.detach(), *by_diffuse, specular.detach(), *by_specular])

    def __call__(
        self, lobes: LobesLike, material: MaterialLike, normals: Float[Tensor, "n 3"], views: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Radiance toward the viewer, in the units of the lobes' weights; differentiable in everything.

        normals, views: unit, any common frame; surfaces that face away reflect nothing; NaN anywhere is NaN in what depends on it
        """
        given = lobes.axis, lobes.sharpness, lobes.weight, material.diffuse, material.specular, material.roughness
        tensors = (torch.as_tensor(t).to(self.dtype) for t in (*given, normals, views))
        axis, sharpness, weight, kd, ks, roughness, normals, views = tensors
        no, nz, oz = (normals * views).sum(-1), normals @ axis.T, views @ axis.T
        diffuse, specular = self.diffuse(sharpness, nz), self.specular(roughness, sharpness, no, nz, oz)
        radiance = kd * (diffuse @ weight) + ks * (specular @ weight)
        return torch.where(no[:, None] <= 0, torch.zeros_like(radiance), radiance)  # so that NaN is not zero


def columns(no: Tensor) -> Tensor:
    """n·o as it meets the lobes: [n, 1], or [n, p] as it is."""
    return no if no.ndim == 2 else no[:, None]
