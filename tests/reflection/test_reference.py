import numpy as np
import pytest
import torch

from factorlib.reflection import reflection_operator
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.reference import about_half_vector, about_lobe, converged
from factorlib.reflection.samples import specular_inputs
from factorlib.results.materials import Reflectance
from tests.integral import reflected

R = reflection_operator("reference")


def brute_force(roughness, sharpness, no, nz, oz, size=1500) -> np.ndarray:
    """Diffuse and specular reflection of a unit lobe, over a fine grid of the hemisphere in vectors."""
    so = np.sqrt(1 - no**2)
    zx = (oz - no * nz) / so
    n, o, z = np.array([0, 0, 1.0]), np.array([so, 0, no]), np.array([zx, np.sqrt(max(1 - nz**2 - zx**2, 0)), nz])
    c, phi = (np.arange(size)[:, None] + 0.5) / size, (np.arange(2 * size) + 0.5) / size * np.pi
    s = np.sqrt(1 - c**2)
    i = np.stack(np.broadcast_arrays(s * np.cos(phi), s * np.sin(phi), c), -1).reshape(-1, 3)  # of one solid angle each
    light = np.exp(-0.5 * sharpness * ((i - z) ** 2).sum(-1)) * np.pi / size**2
    return reflected(Reflectance((1, 0, 0), (0, 1, 0), roughness), n[None], o[None], i, light[:, None])[0, :2]


def scalars(*values):
    return tuple(torch.tensor([v], dtype=torch.float64) for v in values)


@pytest.mark.parametrize(("roughness", "sharpness", "no", "nz", "oz"), [
    (1.0, 0.1, 0.7, 0.5, 0.4), (0.6, 3.0, 0.3, 0.2, -0.6), (0.4, 40.0, 0.9, -0.1, -0.2), (0.5, 200.0, 0.15, 0.1, -0.9),
    (0.4, 20.0, 0.95, 0.9, 0.8),
])  # fmt: skip
def test_equals_an_independent_integrator(roughness, sharpness, no, nz, oz):
    diffuse, glossy = brute_force(roughness, sharpness, no, nz, oz)
    r, lam, no, nz, oz = scalars(roughness, sharpness, no, nz, oz)
    assert R.diffuse(lam, nz[:, None]).item() == pytest.approx(diffuse, rel=2e-5)
    assert R.specular(r[0], lam, no, nz[:, None], oz[:, None]).item() == pytest.approx(glossy, rel=2e-5)


def test_both_quadratures_agree():
    inputs = specular_inputs(64, 4, alpha=(0.15, 1.0), sharpness=(0.3, 60.0), least_no=0.1)
    a, b = (rule(135, *inputs) for rule in (about_lobe, about_half_vector))
    assert ((a - b).abs() <= 1e-5 * (a + 1e-3 * lobe_integral(inputs[1]))).all()


def test_gradients_are_finite_differences():
    inputs = specular_inputs(24, 9, alpha=(0.05, 1.0), sharpness=(0.3, 500.0), least_no=0.1)
    step, tolerance = 1e-4, 1e-10
    leaves = [t.clone().requires_grad_() for t in inputs]
    gradients = torch.autograd.grad(converged(*leaves, tolerance=tolerance).sum(), leaves)
    for k, gradient in enumerate(gradients):
        size = step * (inputs[k] if k < 2 else torch.ones_like(inputs[k]))
        moved = ([t + s * size * (j == k) for j, t in enumerate(inputs)] for s in (1, -1))
        plus, minus = (converged(*each, tolerance=tolerance) for each in moved)
        expected = (plus - minus) / (2 * size)
        scale = gradient.abs() + converged(*inputs, tolerance=1e-6) / (inputs[k] if k < 2 else 1) + 1e-9
        assert ((gradient - expected).abs() / scale).quantile(0.8) < 1e-4
