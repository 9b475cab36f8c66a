"""The paper's operator: laws that hold whatever its weights, what the shipped ones reach and learned from."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from factorlib.conventions import FRONT, half_of_normal_and_view
from factorlib.reflection import reflection_operator
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.network import SHIPPED
from factorlib.reflection.paper_network import frame_of_cosines
from factorlib.reflection.training import Schedule, pixels_problem, trained_plainly

OPERATOR, EXACT = reflection_operator("paper_network"), reflection_operator("paper_network", dtype="float64")


def test_the_shipped_weights_are_small_and_load_without_a_renderer():
    assert sum(path.stat().st_size for path in SHIPPED.glob("paper_*")) < 1_000_000
    made = "import sys; from factorlib.reflection import reflection_operator; reflection_operator('paper_network')"
    code = f"{made}; sys.exit('mitsuba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=False).returncode == 0


def test_the_frame_of_the_cosines_has_the_cosines_and_the_half_vector_of_the_conventions():
    g = torch.Generator().manual_seed(0)
    axes, normals, tilts = (
        torch.nn.functional.normalize(torch.randn(200, 3, generator=g, dtype=torch.float64), dim=1) for _ in range(3)
    )
    views = torch.nn.functional.normalize(normals + 0.8 * tilts, dim=1)
    cosines = [(a * b).sum(1) for a, b in ((normals, views), (normals, axes), (views, axes))]
    n, h, z = (torch.stack(v, 1) for v in frame_of_cosines(*cosines))
    front = torch.from_numpy(FRONT)
    for (a, b), expected in zip(((n, front), (n, z), (front.expand_as(z), z)), cosines, strict=True):
        torch.testing.assert_close((a * b).sum(1), expected, rtol=0, atol=1e-3)
    expected = half_of_normal_and_view(n.numpy(), np.broadcast_to(FRONT, n.shape))
    assert h.numpy() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("operator", [OPERATOR, EXACT], ids=["float32", "float64"])
@pytest.mark.parametrize("roughness", [0.0, 0.08, 0.5, 1.0])
def test_values_and_gradients_are_finite_and_values_not_negative_everywhere(operator, roughness):
    """Every combination of special and ordinary angles, views from behind too, far beyond the sharpness in training."""
    no = torch.tensor([-1, -0.3, 0, 1e-4, 0.02, 0.5, 0.999999, 1]).double()
    tilt = torch.tensor([0, 1e-7, 1e-3, 0.3, math.pi / 2, 2.5, math.pi - 1e-4, math.pi]).double()
    turn = torch.tensor([0, 1e-3, 1, math.pi / 2, math.pi]).double()
    no, tilt, turn = (t.reshape(-1) for t in torch.meshgrid(no, tilt, turn, indexing="ij"))
    nz, sharpness = torch.cos(tilt), torch.tensor([1e-4, 0.05, 1, 1e3, 1e6], dtype=operator.dtype)
    oz = no * nz + torch.sqrt(1 - no * no) * torch.sin(tilt) * torch.cos(turn)
    cosines = (t.to(operator.dtype) for t in (no, nz[:, None].expand(-1, 5), oz[:, None].expand(-1, 5)))
    response = operator.response(torch.tensor(roughness, dtype=operator.dtype), sharpness, *cosines)
    for name in response.__struct_fields__:
        assert getattr(response, name).isfinite().all(), name
    assert (response.diffuse >= 0).all() and (response.specular >= 0).all()


def test_training_lessens_the_error_and_gives_the_same_bytes_again():
    g, threads = torch.Generator().manual_seed(2), torch.get_num_threads()
    sharpness, cosine = 10 ** torch.rand(2048, generator=g), 2 * torch.rand(2048, generator=g) - 1
    inputs = torch.stack([sharpness.log(), cosine], 1)
    problem = pixels_problem(inputs, sharpness, lobe_integral(sharpness) * torch.exp(cosine))
    errors = []
    torch.set_num_threads(1)
    first, again = (
        trained_plainly(problem, Schedule(200, 128, 1e-2, 16, 2, 0), lambda step, error: errors.append(error))
        for _ in range(2)
    )
    torch.set_num_threads(threads)
    assert errors[19] < 0.05 < errors[0]
    assert all(torch.equal(a, b) for a, b in zip(first.weights, again.weights, strict=True))


def test_rendered_spheres_are_what_the_reference_says(monkeypatch):
    """Nothing is assumed of frames, the map or Mitsuba's materials: mean errors within Monte Carlo noise of zero."""
    pytest.importorskip("mitsuba", reason="Mitsuba cannot run here, so that the training set is not checked")
    monkeypatch.setenv("FACTORLIB_MITSUBA", "scalar_rgb")  # the variant that runs everywhere
    from factorlib.generate.lobe_spheres import Spheres, rendered

    axis = np.array([[0.6, -0.64, -0.48], [-0.8, 0.36, 0.48], [0.0, 0.28, -0.96], [0.28, 0.96, 0.0]])
    spheres = Spheres(axis, np.array([2.0, 30.0, 400.0, 6000.0]), np.array([0.9, 0.5, 0.3, 0.12]))
    pixels = rendered(spheres, 40, np.random.default_rng(5))
    again = rendered(spheres, 40, np.random.default_rng(5))
    assert pixels.specular.tobytes() == again.specular.tobytes() and pixels.diffuse.tobytes() == again.diffuse.tobytes()
    reference = reflection_operator("reference")
    for k in range(len(axis)):
        normal, z, lam = (torch.from_numpy(t) for t in (pixels.normal[k], axis[k], spheres.sharpness[k : k + 1]))
        front = torch.from_numpy(FRONT)
        no, nz, oz = normal @ front, (normal @ z)[:, None], (front @ z).expand(len(normal), 1)
        exact = {
            "diffuse": reference.diffuse(lam, nz),
            "specular": reference.specular(torch.tensor(spheres.roughness[k]), lam, no, nz, oz),
        }
        for part, value in exact.items():
            value = value[:, 0].numpy()
            error = (getattr(pixels, part)[k] - value) / (value + float(lobe_integral(lam)) / 100)
            assert np.median(np.abs(error)) < 0.03 and abs(error.mean()) < 0.03 and np.abs(error).max() < 0.4, (k, part)
