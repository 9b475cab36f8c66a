"""Self-shadowing under few lobes: the derivatives, where shadows stay as lobes move, and where no lobe is inserted."""

import msgspec
import numpy as np
import pytest

from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes.insertion import candidates, lobes_inserted
from factorlib.solve.few_lobes.jacobian import fit_loss
from factorlib.solve.few_lobes.normal_equations import normal_equations
from factorlib.solve.few_lobes.unknowns import moved_light
from studies.scenes.problems import MATERIALS, block, random_light
from tests.model.test_shadowing import bowls, rough_light

OPERATOR = reflection_operator("closed_form", dtype="float64")
LOSS = Loss(robust_scale=3.0, prior=0.0)


@pytest.fixture(scope="module")
def problem():
    """Observations of two photos in a light fixed to the world, each hiding other directions, and a wrong light."""
    rng = np.random.default_rng(1)
    data = block("room", random_light(rng, 5, photos=2), MATERIALS, [0, 1, 2], OPERATOR, size=14)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    directions = np.stack([fibonacci_sphere(96), fibonacci_sphere(96) @ turn.T])
    visibility = (rng.random((len(data), 96)) * 255).astype(np.uint8)
    guess = random_light(rng, 4, photos=2)
    guess = Light(guess.axis, np.minimum(guess.log_sharpness, 3), guess.weight / 10, guess.log_exposure)
    return msgspec.structs.replace(data, visibility=visibility, directions=directions), guess


def test_gradients_are_finite_differences(problem):
    """By weights, exposures, k_d and k_s, which move no shadow.  Visibility is computed in single precision, so steps are long."""
    data, light = problem
    equations, step, p = normal_equations(Illumination(data, light, MATERIALS, OPERATOR), LOSS), 2e-3, len(light)

    def by_light(move):
        return fit_loss(Illumination(data, moved_light(light, move, MATERIALS.blur), MATERIALS, OPERATOR), LOSS)

    def by_material(move):
        return fit_loss(Illumination(data, light, Materials.of_vector(MATERIALS.vector() + move), OPERATOR), LOSS)

    still = np.arange(7 * len(MATERIALS)) % 7 < 6
    for function, gradient, which in (
        (by_light, equations.light_gradient, np.arange(len(equations.light_gradient)) >= 3 * p),
        (by_material, equations.material_gradient, still),
    ):
        moves = np.eye(len(gradient))[which] * step
        expected = np.array([(function(d) - function(-d)) / (4 * step) for d in moves])
        np.testing.assert_allclose(gradient[which], expected, rtol=0.02, atol=2e-3 * np.abs(expected).max())


def test_no_lobe_is_inserted_where_its_light_cannot_arrive():
    """One observation's worth of light from the side that everything is hidden from explains nothing."""
    data = blocks_of_observations(bowls("room", rough_light(3), size=8), Noise())[0]
    hidden = data.directions[0, :, 0] > 0.2
    visibility = np.where(hidden, 0, data.visibility).astype(np.uint8)
    dark = Light(np.array([[0.0, 0.0, -1.0]]), np.zeros(1), np.full((1, 3), 1e-6), np.zeros(1))
    hidden_from = msgspec.structs.replace(data, visibility=visibility)
    illumination = Illumination(hidden_from, dark, MATERIALS, OPERATOR)
    grown = lobes_inserted(illumination, 8, candidates(illumination, 0))
    assert (grown.axis[1:, 0] < 0.35).all()
