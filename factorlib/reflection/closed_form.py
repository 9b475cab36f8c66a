"""Reflection operator in closed form.

`diffuse` below is within 0.03 % of its peak; the module `filtering` has the formula of the specular part.

The diffuse reflection of a lobe is E[max(n·i, 0)] over the lobe, times the lobe's integral, over π. Over the lobe, n·i
has mean m = t̄ c and variance τ² = v⊥ s² + v∥ c² (c = n·z, s² = 1 − c²). If n·i were normally distributed,

    E[max(n·i, 0)] = m Φ(m/τ) + τ φ(m/τ)                                                                   (1)

Equation (1) is exact as λ → ∞ and 8 % low for constant light. Both (1) and the exact value satisfy
E[max(x, 0)] − E[max(−x, 0)] = E[x], so their difference is even in c. The polynomial
(1 − t̄)² Σ_ij a_ij T_i(2t̄ − 1) c^2j approximates it within 0.03 % of the peak for every λ.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from factorlib.reflection.filtering import filtered_specular
from factorlib.reflection.lobe import gaussian_sharpness, lobe_moments
from factorlib.reflection.operator import MOST, Operator, columns

# a_ij: row i belongs to T_i, column j to c^2j; fitted by studies/measured/operator_fit.py of version 0.1.0
REMAINDER = torch.tensor(
    [
        [0.117057442, 0.883729683, -4.79232173, 6.88170859, -3.04039177],
        [0.152959793, 1.50928847, -8.74204502, 12.7903947, -5.69348136],
        [0.0906702928, 0.932421699, -6.60403835, 10.2107753, -4.64868484],
        [0.057811445, 0.385699861, -4.05794491, 6.87872462, -3.25317072],
        [0.0361563157, 0.0507886126, -1.93222626, 3.76897173, -1.88566548],
        [0.0198825938, -0.0728109554, -0.627304577, 1.5632297, -0.850259332],
        [0.00842138421, -0.0663660836, -0.0854222051, 0.422190347, -0.263981407],
        [0.00206693641, -0.0229556863, 0.016476301, 0.0493346973, -0.0417152035],
    ],
    dtype=torch.float64,
)


def diffuse_of_moments(lam: Tensor, mean: Tensor, along: Tensor, across: Tensor, nz: Tensor) -> Tensor:
    """Return `diffuse` from λ' and the lobe's moments.

    Args:
        lam: λ' = λ / (1 − e^{−2λ}), see `gaussian_sharpness`.
        mean: Mean t̄ of i·z over the lobe.
        along: Variance v∥ along the lobe's axis.
        across: Variance v⊥ in each direction across the axis.
        nz: Cosine n·z of the lobe's axis.

    Returns:
        A tensor of the arguments' broadcast shape.
    """
    c = nz.clamp(-1, 1)
    m, deviation = mean * c, torch.sqrt(across * (1 - c * c) + along * c * c + 1e-30)
    # E[max(n·i, 0)] of a normal distribution, (1)
    u = m / deviation
    inside = 0.5 * m * torch.special.erfc(u * -math.sqrt(0.5))
    normal = inside + deviation * torch.exp(-0.5 * u * u) / math.sqrt(2 * math.pi)
    # the even remainder: Chebyshev polynomials of x = 2t̄ − 1, then Horner's scheme in c²
    x, square = 2 * mean - 1, c * c
    chebyshev: list[Tensor | float] = [1.0, x]
    for _ in range(len(REMAINDER) - 2):
        chebyshev.append(2 * x * chebyshev[-1] - chebyshev[-2])
    value: Tensor | float = 0.0
    for column in reversed(REMAINDER.T.tolist()):
        value = value * square + sum(t * a for a, t in zip(column, chebyshev, strict=True))
    return 2 / lam * (normal + (1 - mean) * (1 - mean) * value).clamp_min(0)


def diffuse(sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
    """Return (1/π) ∫ exp(λ(i·z − 1)) max(n·i, 0) di."""
    return diffuse_of_moments(gaussian_sharpness(sharpness), *lobe_moments(sharpness), nz)


class ClosedForm(Operator):
    """Reflection operator that evaluates formulas alone."""

    def diffuse(self, sharpness: Float[Tensor, "*p"], nz: Float[Tensor, "n p"]) -> Float[Tensor, "n p"]:
        """Return the diffuse reflection of unit lobes; see `Operator.diffuse`."""
        return diffuse(sharpness, nz)

    def specular(self, roughness: Tensor, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
        """Return the specular reflection of unit lobes, at most MOST; see `Operator.specular`.

        Args:
            roughness: Roughness √α, [] or [n, p].
            sharpness: Sharpness λ, [p] or [n, p].
            no: Cosine n·o, [n] or [n, p].
            nz: Cosine n·z, [n, p].
            oz: Cosine o·z, [n, p].

        Returns:
            Reflection for k_s = 1, [n, p].
        """
        scalars = torch.broadcast_tensors(roughness**2, sharpness, columns(no), nz, oz)
        return filtered_specular(*scalars).value.clamp_max(MOST)
