"""A photo's light for a pose in question, and the equations in which it is eliminated."""

from __future__ import annotations

import msgspec
import numpy as np

from factorlib.refine.descent import projected_equations
from factorlib.refine.light import Surfaces, pursued_light, with_weights
from factorlib.reflection import reflection_operator
from studies.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("network")
SURFACES = Surfaces(MATERIALS, OPERATOR)
RNG = np.random.default_rng(3)
LIGHT = random_light(RNG, 8)
SHOWN = block("light", LIGHT, MATERIALS, [0, 1], OPERATOR, size=16)


def residuals(light, block=SHOWN):
    return SURFACES.under(light, block).residuals()


def test_weights_of_the_true_lobes_are_the_true_weights_and_outliers_pull_little():
    found = with_weights(SURFACES.under(msgspec.structs.replace(LIGHT, weight=np.zeros_like(LIGHT.weight)), SHOWN))
    assert (found.weight >= 0).all() and np.median(np.abs(residuals(found))) < 0.01
    bright = SHOWN.radiance.copy()
    bright[::50] *= 10
    found = with_weights(SURFACES.under(LIGHT, msgspec.structs.replace(SHOWN, radiance=bright)))
    assert np.median(np.abs(residuals(found))) < 0.3


def test_a_pursued_light_explains_a_light_it_knows_nothing_of_and_what_is_held_out_has_no_say():
    other = np.where(SHOWN.held_out[:, None], 7.0, SHOWN.radiance)
    lights = [pursued_light(msgspec.structs.replace(SHOWN, radiance=r), SURFACES) for r in (SHOWN.radiance, other)]
    assert np.array_equal(lights[0].weight, lights[1].weight)
    fitted, held_out = (residuals(lights[0])[rows] for rows in (~SHOWN.held_out, SHOWN.held_out))
    assert np.sqrt(np.mean(fitted**2)) < 1 and np.sqrt(np.mean(held_out**2)) < 1.5


def test_a_pose_sees_nothing_that_the_light_explains():
    """A direction of the pose that does to the picture what a change of weights does has no information, and no pull."""
    light = msgspec.structs.replace(LIGHT, weight=LIGHT.weight + 0.1)
    lit = SURFACES.under(light, SHOWN)
    atoms = lit.atoms(np.arange(len(SHOWN)), light.unit_lobes)
    as_light = np.einsum("cnp,p->nc", atoms, RNG.normal(size=len(light)))
    other = RNG.normal(size=as_light.shape)
    hessian, gradient = projected_equations(np.stack([as_light, other], -1), lit.residuals(), lit)
    alone, scale = (as_light**2).sum(), hessian[1, 1] / (other**2).sum()
    assert abs(hessian[0, 0]) < 1e-4 * scale * alone and abs(gradient[0]) < 1e-2 * np.sqrt(alone)
    assert hessian[1, 1] > 0 and np.linalg.eigvalsh(hessian).min() > -1e-6 * hessian[1, 1]
