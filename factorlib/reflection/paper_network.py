"""The paper's operator: plain fully connected networks, one for the diffuse part and one for the specular one.

Wang, Ritschel and Mitra (arXiv 1710.08313) let networks of 288-wide layers, applied to every pixel and colour channel
alike, compute the reflection of one lobe; they are trained on 200,000 pixels of rendered spheres.  This is the baseline of every
comparison: no formula of reflection is built in.  Its 12 inputs, in the camera frame:

    n, half       normal and half vector, (2(n·o)n − o + (0, 0, −1)) / 2      3 + 3    half: specular only
    z, log σ      the lobe's axis and precision, λ = 2σ                       3 + 1
    roughness                                                                  1       specular only
    k · w         reflectance and weight of the channel                        1

Left open by the paper, or by what is known of it here, and chosen:

Inputs        the product k · w as one number, since reflection is linear in both, and log σ rather than σ.
Linearity     k · w multiplies what the other inputs give, and so does the lobe's integral E(λ): linear in light and in
              reflectance to the last digit, which solvers rely on.  A channel is then one multiplication.
Depth         three hidden layers for the specular part, two for the diffuse one.
Activation    SiLU, so that derivatives are continuous; at the end s tanh(x/s), s = 8, and an exponential: radiance is
              never negative, and bounded.
Range         sharpness and roughness are clamped to what was rendered, `SHARPNESS` and `ROUGHNESS`.
Pixels        50 of each of 4000 spheres, lobes uniform in direction, seen from afar, so that every view is (0, 0, −1):
              `factorlib.generate.lobe_spheres`; Mitsuba renders them in place of Blender.
Training      `training.trained_plainly`: relative error, Adam.
Frame         normals and lobes of every azimuth about the camera's axis, as in photographs.  An operator is asked for
              scalars only, so the networks are asked in the frame where the view is (0, 0, −1) and the normal in the
              plane y = 0, or, for the diffuse part, where the normal is (0, 0, −1).  To have seen that azimuth alone
              would more than halve the specular error (in runs half as long, a median of 1.9 % fell to 0.8 %): the price
              of the symmetry.

`python -m studies.measured.paper_weights` makes the weights again; paper_accuracy.json beside them says what they reach.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.network import SHIPPED, correction, read_layers
from factorlib.reflection.operator import Operator, columns

INPUTS = {"diffuse": 7, "specular": 11}  # and k · w
SHARPNESS, ROUGHNESS = (0.05, 1e4), (0.09, 1.0)  # of `factorlib.generate.lobe_spheres`
Vector = tuple[Tensor, ...]  # three components
SOFTENED = 1e-5  # added under roots, whose derivatives have no bound without it


class PaperNetwork(Operator):
    """The baseline; see above."""

    def __init__(self, dtype: torch.dtype = torch.float32):
        super().__init__(dtype)
        read = {part: read_layers(SHIPPED / f"paper_{part}.safetensors", count) for part, count in INPUTS.items()}
        self.layers = {part: layers.to(dtype) for part, layers in read.items()}

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        """Compute it as `Operator` says; λ is clamped to SHARPNESS."""
        sharpness, nz = torch.broadcast_tensors(sharpness, nz.clamp(-1, 1))
        zero = torch.zeros_like(nz)
        normal, axis = (zero, zero, zero - 1), (soft_root(1 - nz * nz), zero, -nz)
        return self._reflected("diffuse", sharpness, diffuse_inputs(normal, axis, sharpness))

    def specular(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
        """Compute it as `Operator` says; λ is clamped to SHARPNESS, the roughness to ROUGHNESS."""
        roughness, sharpness, no, nz, oz = torch.broadcast_tensors(roughness, sharpness, columns(no), nz, oz)
        normal, half, axis = frame_of_cosines(no, nz, oz)
        return self._reflected("specular", sharpness, specular_inputs(normal, half, axis, sharpness, roughness))

    def _reflected(self, part: str, sharpness: Tensor, inputs: Tensor) -> Tensor:
        return lobe_integral(sharpness) * torch.exp(correction(self.layers[part], inputs, sharpness.clamp(*SHARPNESS)))


def frame_of_cosines(no: Tensor, nz: Tensor, oz: Tensor) -> tuple[Vector, ...]:
    """Components of normal, half vector and axis where the view is (0, 0, −1), the normal at y = 0 and the axis at y > 0."""
    no, nz, oz = (t.clamp(-1, 1) for t in (no, nz, oz))
    zero, across = torch.zeros_like(no), soft_root(1 - no * no)
    along = ((nz - no * oz) / across).clamp(-1, 1)
    axis = along, soft_root(1 - oz * oz - along * along), -oz
    return (across, zero, -no), (no * across, zero, -no * no), axis


def soft_root(square: Tensor) -> Tensor:
    """√(max(x, 0) + SOFTENED): a root whose derivative is bounded."""
    return torch.sqrt(square.clamp_min(0) + SOFTENED)


def diffuse_inputs(normal: Vector, axis: Vector, sharpness: Tensor) -> Float[Tensor, "*b 7"]:
    """Inputs of the diffuse network: normal, axis (three components each, camera frame), log σ."""
    return torch.stack([*normal, *axis, torch.log(sharpness.clamp(*SHARPNESS) / 2)], -1)


def specular_inputs(normal: Vector, half: Vector, axis: Vector, sharpness: Tensor, roughness: Tensor) -> Tensor:
    """Inputs [*b, 11] of the specular network: normal, half vector, axis (three components each, camera frame), log σ, roughness."""
    precision = torch.log(sharpness.clamp(*SHARPNESS) / 2)
    return torch.stack([*normal, *half, *axis, precision, roughness.clamp(*ROUGHNESS)], -1)
