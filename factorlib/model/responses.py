"""What rows of observations reflect of lobes of weight one: where the main solver calls the reflection operator.

    D_ip   diffuse response of observation i to lobe p, for k_d = 1      both with shadows (shadowing)
    S_ip   specular response, for k_s = 1

From them follows radiance: at exposure e, a material k_d, k_s under lobes of weight w shows, before its photo's tone curve,

    y_ic = e_i (k_d,c Σ_p D_ip w_pc + k_s,c Σ_p S_ip w_pc)                                                    (1)

and beside it what other surfaces send there, which the photo itself shows, so without e (interreflection):

    k_d,c G_d,ic + k_s,c G_s,ic                                                                               (2)
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from factorlib.model.blocks import Block
from factorlib.model.lights import UnitLobes
from factorlib.model.shadowing import shadowed_diffuse, shadowed_specular
from factorlib.reflection.operator import Operator

CHUNK = 4096  # observations whose responses are computed at once
A = TypeVar("A", np.ndarray, Tensor)
Rows = slice | Int[np.ndarray, " n"]


def radiance_of(exposure: A, diffuse: A, specular: A, by_diffuse: A, by_specular: A) -> A:
    """Equation (1) [n, 3];  exposure [n, 1];  diffuse, specular: k_d, k_s [3];  by_…: Σ_p D w and Σ_p S w [n, 3]."""
    return exposure * (diffuse * by_diffuse + specular * by_specular)


def diffuse_response(block: Block, rows: Rows, lobes: UnitLobes, operator: Operator) -> Float[np.ndarray, "n p"]:
    """D at `rows`; float64."""
    sharpness, nz = (_tensor(v, operator) for v in (lobes.sharpness, block.normal[rows] @ lobes.axis.T))
    with torch.no_grad():
        return shadowed_diffuse(operator.diffuse(sharpness, nz), block, rows, lobes).double().numpy()


def specular_response(
    block: Block, rows: Rows, lobes: UnitLobes, roughness: float, operator: Operator
) -> Float[np.ndarray, "n p"]:
    """S at `rows`, for a material of that roughness; float64."""
    no, nz, oz = cosines(block.normal[rows], block.view[rows], lobes.axis)
    inputs = (_tensor(v, operator) for v in (np.float64(roughness), lobes.sharpness, no, nz, oz))
    with torch.no_grad():
        return shadowed_specular(operator.specular(*inputs), block, rows, lobes, roughness).double().numpy()


def cosines(normal: A, view: A, axis: A) -> tuple[A, A, A]:
    """n·o [n], n·z and o·z [n, p] of observations [n, 3] and lobes [p, 3], all directions unit."""
    return (normal * view).sum(1), normal @ axis.T, view @ axis.T


def _tensor(values: np.ndarray, operator: Operator) -> Tensor:
    return torch.as_tensor(values).to(operator.dtype)


class UnitReflection(torch.autograd.Function):
    """D and S [n, p] without shadows, for autograd; the derivatives are those of the operator's `response`."""

    @staticmethod
    def forward(
        ctx: torch.autograd.function.FunctionCtx,
        operator: Operator,
        roughness: Tensor,
        log_sharpness: Tensor,
        *cosines: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """D and S;  cosines: n·o [n], n·z and o·z [n, p]."""
        no, nz, oz = cosines
        inputs = [t.detach().to(operator.dtype) for t in (roughness, log_sharpness.exp(), no, nz, oz)]
        response = operator.response(*inputs)
        r = {name: getattr(response, name).to(nz.dtype) for name in response.__struct_fields__}
        slopes = (
            "specular_by_roughness",
            "diffuse_by_log_sharpness",
            "specular_by_log_sharpness",
            "diffuse_by_nz",
            "specular_by_nz",
        )
        ctx.save_for_backward(*(r[name] for name in (*slopes, "specular_by_oz")))
        return r["diffuse"], r["specular"]

    @staticmethod
    def backward(
        ctx: torch.autograd.function.FunctionCtx, diffuse: Tensor, specular: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Gradients by roughness, log sharpness, n·z and o·z; views are given, so there is none by n·o."""
        by_roughness, diffuse_by_sharpness, specular_by_sharpness, diffuse_by_nz, specular_by_nz, specular_by_oz = (
            ctx.saved_tensors
        )
        by_sharpness = (diffuse * diffuse_by_sharpness + specular * specular_by_sharpness).sum(0)
        by_nz = diffuse * diffuse_by_nz + specular * specular_by_nz
        return None, (specular * by_roughness).sum(), by_sharpness, None, by_nz, specular * specular_by_oz
