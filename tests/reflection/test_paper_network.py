"""The paper's operator: laws that hold whatever its weights, what the shipped ones reach and learned from."""

import numpy as np
import pytest
import torch

from factorlib.conventions import FRONT
from factorlib.reflection import reflection_operator
from factorlib.reflection.lobe import lobe_integral
from factorlib.reflection.network import SHIPPED


def test_the_shipped_weights_are_small():
    assert sum(path.stat().st_size for path in SHIPPED.glob("paper_*")) < 1_000_000


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
