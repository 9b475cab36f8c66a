"""The one forward model: what it says of light and clipping."""

import msgspec
import numpy as np
import pytest

from factorlib.model.lights import UnitLobes
from factorlib.solve.few_lobes.jacobian import with_light
from factorlib.solve.few_lobes.unknowns import joined
from tests.model.made import clipped_photos


@pytest.fixture(scope="module", params=["linear", "toned"])
def given(request):
    return clipped_photos(request.param == "toned")


def test_radiance_is_linear_in_light(given):
    straight = with_light(given, msgspec.structs.replace(given.light, log_tone=np.zeros(0)))
    twice = with_light(straight, msgspec.structs.replace(straight.light, weight=2 * straight.light.weight))
    np.testing.assert_allclose(twice.radiance(), 2 * straight.radiance())


def test_atoms_are_what_a_lobe_adds_to_the_residual(given):
    straight = with_light(given, msgspec.structs.replace(given.light, log_tone=np.zeros(0)))
    lobe, weight = UnitLobes(np.array([[0.6, 0.0, -0.8]]), np.array([20.0])), np.array([[0.3, 0.2, 0.1]])
    rows = np.flatnonzero(~given.block.clipped.any(1))
    added = with_light(straight, joined(straight.light, lobe, weight)).residuals() - straight.residuals()
    np.testing.assert_allclose(
        straight.atoms(rows, lobe)[:, :, 0].T * weight, added[rows], atol=1e-9 * np.abs(added).max()
    )


def test_a_clipped_channel_pulls_only_from_below(given):
    block = given.block
    above, below = block.residuals(block.radiance + 1), block.residuals(block.radiance - 1)
    assert (above[block.clipped] == 0).all()
    assert (below[block.clipped] < 0).all()
