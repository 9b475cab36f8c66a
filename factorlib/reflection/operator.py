"""Interface of every reflection operator."""

from __future__ import annotations

from typing import Any, Literal, Protocol, get_args

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

Name = Literal["reference", "closed_form", "network", "paper_network"]
NAMES = get_args(Name)
MOST = 1.0  # greatest reflection of a unit lobe: its radiance is at most 1, and so is the albedo
PerLobe = Float[Tensor, "*p"]
PerPoint = Float[Tensor, "*n"]
PerPair = Float[Tensor, "n p"]
CHUNK = 1 << 14  # number of evaluations whose intermediate results are in memory at once


class LobesLike(Protocol):
    """Lobes weight · exp(λ(ω·axis − 1)), as tensors or arrays: axis [p, 3] unit, sharpness λ [p], weight [p, 3]."""

    axis: Any
    sharpness: Any
    weight: Any


class MaterialLike(Protocol):
    """Reflectance of a material: diffuse k_d [3], specular k_s [3], roughness [] with α = roughness²."""

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
    """Reflection R(lobe | material) of lobes exp(λ(ω·z − 1)).

    A subclass implements `diffuse` and `specular`, elementwise functions that torch can differentiate. It may override
    `response` by a faster one.
    """

    def __init__(self, dtype: torch.dtype = torch.float32):
        self.dtype = dtype

    def diffuse(self, sharpness: PerLobe, nz: PerPair) -> PerPair:
        """Return (1/π) ∫ exp(λ(i·z − 1)) max(n·i, 0) di."""
        raise NotImplementedError

    def specular(self, roughness: Tensor, sharpness: PerLobe, no: PerPoint, nz: PerPair, oz: PerPair) -> PerPair:
        """Return ∫ exp(λ(i·z − 1)) D G / (4 n·o) di over the upper hemisphere.

        Args:
            roughness: Roughness √α, [] or [n, p].
            sharpness: Sharpness λ, [p] or [n, p].
            no: Cosine n·o, [n] or [n, p].
            nz: Cosine n·z, [n, p].
            oz: Cosine o·z, [n, p].

        Returns:
            Reflection for k_s = 1, [n, p].
        """
        raise NotImplementedError

    def response(self, roughness: Tensor, sharpness: PerLobe, no: PerPoint, nz: PerPair, oz: PerPair) -> Response:
        """Return values and derivatives together.

        Args:
            roughness: Roughness √α of the material, [].
            sharpness: Sharpness λ, [p].
            no: Cosine n·o, [n].
            nz: Cosine n·z, [n, p].
            oz: Cosine o·z, [n, p].

        Returns:
            Values and derivatives, [n, p] each, detached from torch's graph.
        """
        rows = max(1, CHUNK // max(nz.shape[1], 1))
        chunks = zip(no.split(rows), nz.split(rows), oz.split(rows), strict=True)
        parts = [self._response(roughness, sharpness, *chunk) for chunk in chunks]
        return Response(*(torch.cat([getattr(part, field) for part in parts]) for field in Response.__struct_fields__))

    def _response(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Response:
        """Compute `response` of one chunk by automatic differentiation."""
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
        """Return the radiance toward the viewer in the units of the lobes' weights, differentiable in every input.

        Surfaces that face away reflect nothing. A NaN in the input gives NaN in all results that depend on it.

        Args:
            lobes: The light.
            material: The reflectance of all points.
            normals: Unit normals in any frame that is common to lobes, normals and views.
            views: Unit directions from the points to the viewer.

        Returns:
            Radiance of each point, RGB.
        """
        given = lobes.axis, lobes.sharpness, lobes.weight, material.diffuse, material.specular, material.roughness
        tensors = (torch.as_tensor(t).to(self.dtype) for t in (*given, normals, views))
        axis, sharpness, weight, kd, ks, roughness, normals, views = tensors
        no, nz, oz = (normals * views).sum(-1), normals @ axis.T, views @ axis.T
        diffuse, specular = self.diffuse(sharpness, nz), self.specular(roughness, sharpness, no, nz, oz)
        radiance = kd * (diffuse @ weight) + ks * (specular @ weight)
        return torch.where(no[:, None] <= 0, torch.zeros_like(radiance), radiance)  # NaN passes: it is not ≤ 0


def columns(no: Tensor) -> Tensor:
    """Return n·o in a shape that broadcasts over the lobes: [n] becomes [n, 1], [n, p] is left as it is."""
    return no if no.ndim == 2 else no[:, None]
