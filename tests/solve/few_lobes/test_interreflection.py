"""Interreflection under few lobes: derivatives, and weights fitted to what bounces leave."""

import msgspec
import numpy as np
import pytest

from factorlib.model.illumination import Illumination
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.solve.few_lobes import unknowns
from factorlib.solve.few_lobes.jacobian import fit_loss, responses, with_light
from factorlib.solve.few_lobes.normal_equations import energy_equations, normal_equations, with_weights_fitted
from studies.scenes.problems import MATERIALS
from tests.model.made import OPERATOR, bounced_photos

LOSS = Loss(robust_scale=3.0, prior=0.0)


@pytest.fixture(scope="module")
def given():
    return bounced_photos(curves=False)


def moved_light(given, step):
    return with_light(given, unknowns.moved_light(given.light, step, MATERIALS.blur))


def moved_materials(given, step):
    return msgspec.structs.replace(given, materials=Materials.of_vector(MATERIALS.vector() + step))


@pytest.mark.parametrize("moved", [moved_light, moved_materials])
def test_gradients_are_finite_differences_of_the_loss(given, moved):
    found, step = normal_equations(given, LOSS), 1e-6
    gradient = found.light_gradient if moved is moved_light else found.material_gradient
    expected = [
        (fit_loss(moved(given, d), LOSS) - fit_loss(moved(given, -d), LOSS)) / (4 * step)
        for d in np.eye(len(gradient)) * step
    ]
    np.testing.assert_allclose(gradient, expected, rtol=2e-4, atol=1e-4 * np.abs(expected).max())


def test_weights_are_fitted_to_what_bounces_leave(given):
    """Energies have the same equations alone; observations of a light and of bounces give that light back."""
    lit, light, p = given, given.light, len(given.light)
    part, whole = energy_equations(lit, responses(lit), LOSS), normal_equations(lit, LOSS)
    np.testing.assert_allclose(part.loss, whole.loss)
    np.testing.assert_allclose(part.gradients.reshape(-1), whole.light_gradient[3 * p : 6 * p], rtol=1e-9)
    data = msgspec.structs.replace(given.block, radiance=lit.radiance(), precision=np.ones_like(given.block.precision))
    dark = msgspec.structs.replace(light, weight=light.weight / 3)
    found = with_weights_fitted(Illumination(data, dark, MATERIALS, OPERATOR), Loss(robust_scale=1e6, prior=0.0)).light
    np.testing.assert_allclose(found.weight, light.weight, rtol=1e-5, atol=1e-6 * light.weight.max())
