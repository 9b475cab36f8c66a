"""The paper's operator: plain fully connected networks, one for the diffuse and one for the specular part.

Wang, Ritschel and Mitra (arXiv 1710.08313) compute the reflection of one lobe by networks of 288-wide layers, applied
to every pixel and colour channel alike. They train them on 200,000 pixels of rendered spheres. This is the baseline of
every comparison: no formula of reflection is built in. Its 12 inputs, in the camera frame:

    n, half       normal and half vector, (2(n·o)n − o + (0, 0, −1)) / 2      3 + 3    half: specular only
    z, log σ      the lobe's axis and precision, λ = 2σ                       3 + 1
    roughness                                                                  1       specular only
    k · w         reflectance and weight of the channel                        1

The paper, as far as it is known here, leaves these points open; they are chosen:

Inputs        the product k · w as one number, since reflection is linear in both, and log σ rather than σ.
Linearity     k · w multiplies the result of the other inputs, and so does the lobe's integral E(λ): the operator is
              linear in light and in reflectance to the last digit, as solvers assume. A channel is one multiplication.
Depth         three hidden layers for the specular part, two for the diffuse one.
Activation    SiLU, so that derivatives are continuous; at the end s tanh(x/s), s = 8, and an exponential: radiance is
              never negative, and bounded.
Range         sharpness and roughness are clamped to the rendered range, `SHARPNESS` and `ROUGHNESS`.
Pixels        50 of each of 4000 spheres, lobes uniform in direction, camera far away, so that every view is
              (0, 0, −1): `studies.measured.lobe_spheres`; Mitsuba renders them in place of Blender.
Training      `training.trained_plainly`: relative error, Adam.
Frame         normals and lobes of every azimuth about the camera's axis, as in photographs. An operator receives
              scalars only, so the networks are evaluated in the frame where the view is (0, 0, −1) and the normal is
              in the plane y = 0, or, for the diffuse part, where the normal is (0, 0, −1). Training on that azimuth
              alone would more than halve the specular error (in runs half as long, a median of 1.9 % fell to 0.8 %).

`python -m studies.measured.paper_weights` trains the weights again; paper_accuracy.json beside them has their errors.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.network import SHIPPED, correction, read_layers
from factorlib.reflection.operator import Operator, columns

INPUTS = {"diffuse": 7, "specular": 11}  # beside k · w
SHARPNESS, ROUGHNESS = (0.05, 1e4), (0.09, 1.0)
Vector = tuple[Tensor, ...]  # three components
SOFTENED = 1e-5  # added under roots, whose derivatives are unbounded otherwise


class PaperNetwork(Operator):
    """Baseline operator by the paper's networks."""

    def __init__(self, dtype: torch.dtype = torch.float32):
        super().__init__(dtype)
        read = {part: read_layers(SHIPPED / f"paper_{part}.safetensors", count) for part, count in INPUTS.items()}
        self.layers = {part: layers.to(dtype) for part, layers in read.items()}

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        """Return the diffuse reflection of unit lobes, λ clamped to SHARPNESS; see `Operator.diffuse`."""
        sharpness, nz = torch.broadcast_tensors(sharpness, nz.clamp(-1, 1))
        zero = torch.zeros_like(nz)
        normal, axis = (zero, zero, zero - 1), (soft_root(1 - nz * nz), zero, -nz)
        return self._reflected("diffuse", sharpness, diffuse_inputs(normal, axis, sharpness))

    def specular(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
        """Return the specular reflection of unit lobes; see `Operator.specular`.

        Args:
            roughness: Roughness √α, [] or [n, p], clamped to ROUGHNESS.
            sharpness: Sharpness λ, [p] or [n, p], clamped to SHARPNESS.
            no: Cosine n·o, [n] or [n, p].
            nz: Cosine n·z, [n, p].
            oz: Cosine o·z, [n, p].

        Returns:
            Reflection for k_s = 1, [n, p].
        """
        roughness, sharpness, no, nz, oz = torch.broadcast_tensors(roughness, sharpness, columns(no), nz, oz)
        normal, half, axis = frame_of_cosines(no, nz, oz)
        return self._reflected("specular", sharpness, specular_inputs(normal, half, axis, sharpness, roughness))

    def _reflected(self, part: str, sharpness: Tensor, inputs: Tensor) -> Tensor:
        """Return the lobe's integral times the exponential of the network's output."""
        return lobe_integral(sharpness) * torch.exp(correction(self.layers[part], inputs, sharpness.clamp(*SHARPNESS)))


def frame_of_cosines(no: Tensor, nz: Tensor, oz: Tensor) -> tuple[Vector, ...]:
    """Return normal, half vector and lobe axis as components in the frame of the networks.

    In this frame the view is (0, 0, −1), the normal has y = 0, and the axis has y > 0.

    Args:
        no: Cosine n·o of the view direction.
        nz: Cosine n·z of the lobe's axis.
        oz: Cosine o·z between view and axis.

    Returns:
        Normal, half vector and axis, three components each.
    """
    no, nz, oz = (t.clamp(-1, 1) for t in (no, nz, oz))
    zero, across = torch.zeros_like(no), soft_root(1 - no * no)
    along = ((nz - no * oz) / across).clamp(-1, 1)
    axis = along, soft_root(1 - oz * oz - along * along), -oz
    return (across, zero, -no), (no * across, zero, -no * no), axis


def soft_root(square: Tensor) -> Tensor:
    """Return √(max(x, 0) + SOFTENED), a root of bounded derivative."""
    return torch.sqrt(square.clamp_min(0) + SOFTENED)


def diffuse_inputs(normal: Vector, axis: Vector, sharpness: Tensor) -> Float[Tensor, "*b 7"]:
    """Return the inputs of the diffuse network: normal, axis and log σ.

    Args:
        normal: Normal, three components in the camera frame.
        axis: Axis of the lobe, three components in the camera frame.
        sharpness: Sharpness λ = 2σ, clamped to SHARPNESS.

    Returns:
        A tensor [*b, 7].
    """
    return torch.stack([*normal, *axis, torch.log(sharpness.clamp(*SHARPNESS) / 2)], -1)


def specular_inputs(normal: Vector, half: Vector, axis: Vector, sharpness: Tensor, roughness: Tensor) -> Tensor:
    """Return the inputs of the specular network: normal, half vector, axis, log σ and roughness.

    Args:
        normal: Normal, three components in the camera frame.
        half: Half vector, three components in the camera frame.
        axis: Axis of the lobe, three components in the camera frame.
        sharpness: Sharpness λ = 2σ, clamped to SHARPNESS.
        roughness: Roughness √α, clamped to ROUGHNESS.

    Returns:
        A tensor [*b, 11].
    """
    precision = torch.log(sharpness.clamp(*SHARPNESS) / 2)
    return torch.stack([*normal, *half, *axis, precision, roughness.clamp(*ROUGHNESS)], -1)
