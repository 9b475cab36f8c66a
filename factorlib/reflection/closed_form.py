"""The operator by formulas alone: `diffuse` within .03 % of its peak, `filtering` for the specular part."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.diffuse import diffuse
from factorlib.reflection.filtering import filtered_specular
from factorlib.reflection.operator import MOST, Operator, columns


class ClosedForm(Operator):
    """Formulas alone."""

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        """As of `Operator`, by `factorlib.reflection.diffuse`."""
        return diffuse(sharpness, nz)

    def specular(
        self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor
    ) -> Float[Tensor, "n p"]:
        """As of `Operator`, by `factorlib.reflection.filtering`; at most MOST."""
        return filtered_specular(
            *torch.broadcast_tensors(roughness**2, sharpness, columns(no), nz, oz)
        ).value.clamp_max(MOST)
