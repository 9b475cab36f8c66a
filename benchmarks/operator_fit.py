"""The constants of the closed forms, fitted to quadrature: `python -m benchmarks.operator_fit` prints them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from scipy.optimize import least_squares

from factorlib.reflection.closed_form import REMAINDER, normal_mean_cosine
from factorlib.reflection.filtering import TAIL
from factorlib.reflection.lobe import lobe_integral, lobe_moments
from factorlib.reflection.reference import diffuse_quadrature


def diffuse_remainder(orders: int = 8, powers: int = 5) -> tuple[np.ndarray, float]:
    """Coefficients of T_i(2t̄ − 1) c^2j (1 − t̄)² in what the normal law leaves of E[max(n·i, 0)], and the worst error."""
    sharpness, cosine = torch.logspace(-3, 6, 90, dtype=torch.float64), torch.linspace(-1, 1, 161, dtype=torch.float64)
    lam, c = (t.reshape(-1) for t in torch.meshgrid(sharpness, cosine, indexing="ij"))
    exact = diffuse_quadrature(lam, c, 80) * math.pi / lobe_integral(lam)
    peak = exact.reshape(90, 161).amax(1).repeat_interleave(161)
    mean = lobe_moments(lam)[0]
    basis = [
        (1 - mean) ** 2 * torch.cos(i * torch.arccos(2 * mean - 1)) * torch.cos(2 * j * torch.arccos(c)) / peak
        for i, j in itertools.product(range(orders), range(powers))
    ]
    matrix, target = torch.stack(basis, 1), (exact - normal_mean_cosine(lam, c)) / peak
    weight = torch.ones_like(target)
    for _ in range(60):  # reweighted least squares, toward the least maximum
        found = torch.linalg.lstsq(matrix * weight[:, None], (target * weight)[:, None]).solution[:, 0]
        error = (matrix @ found - target).abs()
        weight = weight * torch.sqrt(1 + error / error.max())
        weight = weight / weight.mean()
    even = np.array(
        [
            np.polynomial.chebyshev.cheb2poly([0.0] * (2 * j) + [1.0]).tolist() + [0.0] * (2 * (powers - 1 - j))
            for j in range(powers)
        ]
    )
    return found.reshape(orders, powers).numpy() @ even[:, ::2], float(error.max())


def ggx_as_gaussians(count: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Rates τ and weights w of 1/(1 + x)² ≈ Σ w exp(−τ x) + 1/((1 + x)² + TAIL²), in relative error."""
    x = np.concatenate([[0.0], np.logspace(-2.5, 7.0, 500)])
    importance = np.where(x == 0, 30, 1)

    def parameters(p):
        return np.exp(np.cumsum(np.r_[p[0], np.exp(p[1:count])])), np.exp(p[count:])

    def residual(p):
        rate, weight = parameters(p)
        return ((np.exp(-np.outer(x, rate)) @ weight + 1 / ((1 + x) ** 2 + TAIL**2)) * (1 + x) ** 2 - 1) * importance

    first = np.log(np.geomspace(3 / TAIL, 5, count))
    found = least_squares(
        residual, np.r_[first[0], np.log(np.diff(first)), np.log(np.geomspace(TAIL**-1.5, 0.5, count))], max_nfev=20000
    )
    return parameters(found.x)


if __name__ == "__main__":
    coefficients, error = diffuse_remainder()
    print("REMAINDER, error of the peak", error)
    print(np.array2string(coefficients, separator=", ", precision=9, max_line_width=120))
    print(
        "in use differs by",
        np.abs(coefficients - REMAINDER.numpy()).max() if REMAINDER.shape == coefficients.shape else "shape",
    )
    for row in zip(*ggx_as_gaussians(), strict=True):
        print("({:.9g}, {:.9g})".format(*row))
