"""Derivatives by few lobes are finite differences of the one forward model, and what pulls on them."""

import msgspec
import numpy as np
import pytest

from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.solve.few_lobes import unknowns
from factorlib.solve.few_lobes.jacobian import fit_loss, linearise, with_light
from factorlib.solve.few_lobes.normal_equations import normal_equations
from studies.scenes.problems import MATERIALS
from tests.model.made import clipped_photos

LOSS = Loss(robust_scale=3.0, prior=0.05)
UNTINTED = Loss(robust_scale=3.0, prior=0.0)  # the tint prior takes Ē to be constant, so it is no part of a difference


@pytest.fixture(scope="module")
def given():
    return clipped_photos(curves=False)


def derivative(function, size, step=1e-6):
    """Central differences."""
    moves = np.eye(size) * step
    return np.array([(function(d) - function(-d)) / (2 * step) for d in moves])


def moved_light(given, step):
    return with_light(given, unknowns.moved_light(given.light, step, MATERIALS.blur))


def moved_materials(given, step):
    return msgspec.structs.replace(given, materials=Materials.of_vector(MATERIALS.vector() + step))


@pytest.mark.parametrize("moved", [moved_light, moved_materials])
def test_gradients_are_finite_differences_of_the_loss(given, moved):
    found = normal_equations(given, UNTINTED)
    gradient = found.light_gradient if moved is moved_light else found.material_gradient
    expected = derivative(lambda d: fit_loss(moved(given, d), UNTINTED), len(gradient)) / 2
    np.testing.assert_allclose(gradient, expected, rtol=2e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("moved", [moved_light, moved_materials])
def test_the_jacobian_is_the_finite_difference_of_the_one_forward_model(given, moved):
    """Row by row, of whitened residuals that nothing weighs down."""
    plain, first = Loss(robust_scale=1e9, prior=0.0), 7 * len(MATERIALS)
    whole = np.zeros((*given.block.radiance.shape, first + unknowns.unknowns(given.light)))
    for part in linearise(given, plain):
        of_channel = whole[part.rows, part.channel]
        of_channel[:, part.places] = part.jacobian.numpy()
    jacobian = whole[..., first:] if moved is moved_light else whole[..., :first]
    expected = np.moveaxis(derivative(lambda d: moved(given, d).residuals(), jacobian.shape[-1]), 0, -1)
    compared = ~given.block.held_out[:, None] & (
        np.abs(given.residuals()) > 1e-3
    )  # a clipped channel just satisfied has two slopes
    np.testing.assert_allclose(jacobian[compared], expected[compared], atol=1e-5 * np.abs(expected).max())


def test_loss_of_the_normal_equations_is_the_loss(given):
    np.testing.assert_allclose(normal_equations(given, LOSS).loss, fit_loss(given, LOSS))


def test_held_out_observations_do_not_pull(given):
    radiance = np.where(given.block.held_out[:, None], given.block.radiance + 1, given.block.radiance)
    other = msgspec.structs.replace(given, block=msgspec.structs.replace(given.block, radiance=radiance))
    a, b = (normal_equations(one, LOSS) for one in (given, other))
    np.testing.assert_array_equal(a.light_gradient, b.light_gradient)


def test_the_prior_pulls_a_tinted_light_toward_grey(given):
    red = with_light(given, msgspec.structs.replace(given.light, weight=given.light.weight * [2.0, 1.0, 1.0]))
    p = len(given.light)
    with_prior, without = (normal_equations(red, Loss(3.0, prior)) for prior in (1e3, 0.0))
    pull = (with_prior.light_gradient - without.light_gradient)[3 * p :]
    assert (pull[:p] > 0).all()  # less red
    assert (pull[p : 3 * p] < 0).all()  # more green and blue
    np.testing.assert_allclose(pull[: 3 * p].sum(), 0, atol=1e-9 * np.abs(pull).max())
