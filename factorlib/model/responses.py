"""What rows of observations reflect of lobes of weight one: the only place that calls the reflection operator.

    D_ip   diffuse response of observation i to lobe p, for k_d = 1      both with shadows (shadowing)
    S_ip   specular response, for k_s = 1

From them follows radiance: at exposure e, a material k_d, k_s under lobes of weight w shows, before its photo's tone curve,

    y_ic = e_i (k_d,c Σ_p D_ip w_pc + k_s,c Σ_p S_ip w_pc)                                                    (1)

and beside it what other surfaces send there, which the photo itself shows, so without e (interreflection):

    k_d,c G_d,ic + k_s,c G_s,ic                                                                               (2)
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.model.blocks import Block
from factorlib.model.lights import Light, UnitLobes
from factorlib.model.materials import Materials
from factorlib.model.shadowing import Turning, shadowed, shadowed_response
from factorlib.reflection.operator import Operator

CHUNK = 4096  # observations whose responses are computed at once
A = TypeVar("A", np.ndarray, Tensor)
Rows = slice | Int[np.ndarray, " n"]


def radiance_of(exposure: A, diffuse: A, specular: A, by_diffuse: A, by_specular: A) -> A:
    """Equation (1) [n, 3];  exposure [n, 1];  diffuse, specular: k_d, k_s [3];  by_…: Σ_p D w and Σ_p S w [n, 3]."""
    return exposure * (diffuse * by_diffuse + specular * by_specular)


def bounced_of(block: Block, rows: Rows, materials: Materials, m: int) -> Float[np.ndarray, "n 3"] | float:
    """Equation (2) at `rows`, which show material m; 0 for a block without bounces."""
    if block.bounced is None:
        return 0.0
    sent = block.bounced[rows]
    return materials.diffuse[m] * sent[:, :3] + materials.specular[m] * sent[:, 3:]


def cosines(normal: A, view: A, axis: A) -> tuple[A, A, A]:
    """n·o [n], n·z and o·z [n, p] of observations [n, 3] and lobes [p, 3], all directions unit."""
    return (normal * view).sum(1), normal @ axis.T, view @ axis.T


def operator_inputs(block: Block, rows: Rows, lobes: UnitLobes, roughness: float, dtype: torch.dtype) -> list[Tensor]:
    """roughness, λ, n·o, n·z, o·z of lobes at the observations `rows`, as an operator of that `dtype` takes them."""
    inputs = np.float64(roughness), lobes.sharpness, *cosines(block.normal[rows], block.view[rows], lobes.axis)
    return [torch.as_tensor(value).to(dtype) for value in inputs]


def unit_values(
    block: Block, rows: Rows, lobes: UnitLobes, roughness: float, operator: Operator
) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, "n p"]]:
    """D and S at `rows`, for a material of that roughness; float64."""
    roughness_, sharpness, no, nz, oz = operator_inputs(block, rows, lobes, roughness, operator.dtype)
    with torch.no_grad():
        parts = operator.diffuse(sharpness, nz), operator.specular(roughness_, sharpness, no, nz, oz)
        diffuse, specular = shadowed(parts, block, rows, lobes, roughness)
    return diffuse.double().numpy(), specular.double().numpy()


class Responses(msgspec.Struct, frozen=True):
    """What `rows` of one material reflect of each lobe of weight one, with shadows and exposure, and the derivatives.

    parts    the fields of the operator's Response [n, p]
    turning  how shadows alone change them as lobes turn; None without shadows
    """

    material: int
    rows: slice
    parts: dict[str, Float[Tensor, "n p"]]
    turning: Turning | None

    def basis(self, materials: Materials, c: int) -> Float[Tensor, "n p"]:
        """Radiance in channel c by the lobes' weights there: k_d D + k_s S, exposed."""
        return materials.diffuse[self.material, c] * self.parts["diffuse"] + materials.specular[self.material, c] * self.parts["specular"]


def responses(block: Block, light: Light, materials: Materials, operator: Operator) -> Iterator[Responses]:
    """The responses of all observations of a block, in chunks of rows."""
    for m, rows in material_slices(block):
        roughness = float(materials.roughness[m])
        exposure = torch.from_numpy(np.exp(light.log_exposure)[block.photo[rows]])[:, None]
        response = operator.response(*operator_inputs(block, rows, light.unit_lobes, roughness, operator.dtype))
        parts = {name: getattr(response, name).double() * exposure for name in response.__struct_fields__}
        yield Responses(m, rows, *shadowed_response(parts, block, rows, light, roughness))


def material_slices(block: Block) -> list[tuple[int, slice]]:
    """(material, rows) of runs of one material, of at most CHUNK rows."""
    starts = np.flatnonzero(np.diff(block.material, prepend=-1))
    ends = np.append(starts, len(block))[1:]
    return [
        (int(block.material[a]), slice(i, min(i + CHUNK, b)))
        for a, b in zip(starts.tolist(), ends.tolist(), strict=True)
        for i in range(a, b, CHUNK)
    ]


class UnitReflection(torch.autograd.Function):
    """D and S [n, p] without shadows, for autograd; the derivatives are those of the operator's `response`."""

    @staticmethod
    def forward(
        ctx: torch.autograd.function.FunctionCtx, operator: Operator, roughness: Tensor, log_sharpness: Tensor, *cosines: Tensor
    ) -> tuple[Tensor, Tensor]:
        """D and S;  cosines: n·o [n], n·z and o·z [n, p]."""
        no, nz, oz = cosines
        inputs = [t.detach().to(operator.dtype) for t in (roughness, log_sharpness.exp(), no, nz, oz)]
        response = operator.response(*inputs)
        r = {name: getattr(response, name).to(nz.dtype) for name in response.__struct_fields__}
        slopes = ("specular_by_roughness", "diffuse_by_log_sharpness", "specular_by_log_sharpness", "diffuse_by_nz", "specular_by_nz")
        ctx.save_for_backward(*(r[name] for name in (*slopes, "specular_by_oz")))
        return r["diffuse"], r["specular"]

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, diffuse: Tensor, specular: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients by roughness, log sharpness, n·z and o·z; views are given, so there is none by n·o."""
        by_roughness, diffuse_by_sharpness, specular_by_sharpness, diffuse_by_nz, specular_by_nz, specular_by_oz = ctx.saved_tensors
        by_sharpness = (diffuse * diffuse_by_sharpness + specular * specular_by_sharpness).sum(0)
        by_nz = diffuse * diffuse_by_nz + specular * specular_by_nz
        return None, (specular * by_roughness).sum(), by_sharpness, None, by_nz, specular * specular_by_oz
