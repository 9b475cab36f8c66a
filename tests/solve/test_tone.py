"""Photos whose files are not as linear as they say: the curves are found, and where there are none, none are."""

import msgspec
import numpy as np
import pytest

from benchmarks.solve.problems import MATERIALS, block, factor_between, random_light
from factorlib.diagnose.identifiability import unlikely_curves
from factorlib.images.tone import curve
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.bundle import solve
from factorlib.solve.history import Run
from factorlib.solve.options import Bundle
from factorlib.solve.rounds import from_nothing

OPERATOR = reflection_operator("network")
QUICK = Bundle(light_prior="none", lobes=8, insert=4, rounds=3, iterations=8, polish=15, tolerance=1e-4)


def rooms(photos=1):
    rng = np.random.default_rng(3)
    return [block(f"room{i}", random_light(rng, 3, photos), MATERIALS, [0, 1, 2], OPERATOR, size=12, seed=i) for i in range(3)]


def through(data, *exponents):
    """What cameras with tone curves make of it, one exponent a photo."""
    shown = curve(data.radiance, np.array(exponents)[data.photo][:, None])
    return msgspec.structs.replace(data, radiance=shown, precision=1 / np.hypot(0.05, 0.05 * shown))


def solved(blocks, **how):
    solution = solve(JointProblem(blocks, OPERATOR), from_nothing(len(MATERIALS)), Run(msgspec.structs.replace(QUICK, **how)))
    return solution, [np.exp(light.log_tone) for light in solution.point.lights]


def error_of(solution):
    found = solution.point.materials
    return np.abs(found.diffuse * factor_between(found, MATERIALS) - MATERIALS.diffuse).max()


@pytest.fixture(scope="module")
def curved():
    return [through(data, exponent) for data, exponent in zip(rooms(), (1.3, 0.8, 1.0), strict=True)]


@pytest.fixture(scope="module")
def found(curved):
    return solved(curved)


def test_curves_are_found_and_spare_the_materials(curved, found):
    solution, exponents = found
    without, none = solved(curved, tone="off")
    np.testing.assert_allclose([float(e[0]) if len(e) else 1.0 for e in exponents], (1.3, 0.8, 1.0), rtol=0.05)
    assert all(len(e) == 0 for e in none)
    assert error_of(solution) < 0.3 * error_of(without)


def test_the_evidence_is_that_held_out_losses_fall(found):
    evidence = found[0].tone
    assert [one.kept for one in evidence][:2] == [True, True]
    assert all(one.kept == (one.held_out_loss_with < 0.8 * one.held_out_loss_without) for one in evidence)


def test_photos_of_one_light_have_a_curve_each():
    blocks = [through(data, 1.0, 1.3) if k == 0 else data for k, data in enumerate(rooms(photos=2))]
    _, exponents = solved(blocks)
    np.testing.assert_allclose(exponents[0], (1.0, 1.3), rtol=0.05)


def test_linear_photos_stay_linear_and_say_why():
    solution, exponents = solved(rooms())
    assert all(len(e) == 0 for e in exponents)
    assert [one.kept for one in solution.tone] == [False] * 3


def test_a_curve_that_no_camera_has_is_not_believed():
    """What else is wrong would be explained by an exponent at its bounds."""
    blocks = [through(data, 4.0) if k == 0 else data for k, data in enumerate(rooms())]
    solution, exponents = solved(blocks)
    assert len(exponents[0]) == 0
    assert solution.tone[0].held_out_loss_with < 0.8 * solution.tone[0].held_out_loss_without and not solution.tone[0].kept


def test_an_exponent_near_its_bounds_is_named():
    blocks = rooms()[:2]
    lights = [msgspec.structs.replace(random_light(np.random.default_rng(0), 2), log_tone=np.log([g])) for g in (1.2, 1.65)]
    assert [("room1" in said, "1.6" in said) for said in unlikely_curves(blocks, lights)] == [(True, True)]
