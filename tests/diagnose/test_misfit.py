"""What is unexplained: what neighbours leave alike, and not what varies from one observation to the next."""

import msgspec
import numpy as np
import pytest

from factorlib.diagnose.misfit import energy, misfit
from factorlib.diagnose.uncertainty import residual_deviation
from factorlib.model.materials import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from studies.scenes.problems import MATERIALS, block, random_light

OPERATOR = reflection_operator("network")


@pytest.fixture(scope="module")
def exact():
    """Two lights, two photos of the second, each showing three balls, at the truth."""
    rng = np.random.default_rng(3)
    lights = [random_light(rng, 3), random_light(rng, 3, photos=2)]
    blocks = [block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR) for k, light in enumerate(lights)]
    scaled = [
        msgspec.structs.replace(light, weight=light.weight / one.unit)
        for light, one in zip(lights, blocks, strict=True)
    ]
    return JointProblem(blocks, OPERATOR), Point(MATERIALS, scaled)


def changed(exact, **columns):
    """The first block with other columns."""
    problem, point = exact
    return JointProblem([msgspec.structs.replace(problem.blocks[0], **columns), problem.blocks[1]], OPERATOR), point


def test_the_truth_leaves_nothing_and_noise_next_to_nothing(exact):
    whole, photos = misfit(*exact)
    assert whole < 1e-6 and set(photos) == {"room0_0", "room1_0", "room1_1"}
    assert {type(whole), *(type(photo.unexplained) for photo in photos.values())} == {float}  # as JSON takes it
    radiance = exact[0].blocks[0].radiance
    noisy = radiance + 0.1 * np.random.default_rng(0).normal(size=radiance.shape)
    assert misfit(*changed(exact, radiance=noisy))[0] < 0.01


def test_what_neighbours_leave_alike_is_the_share_of_the_shading_that_it_is(exact):
    block = exact[0].blocks[0]
    means = np.array([block.radiance[block.material == m].mean(0) for m in block.material])
    flatter = means + 0.7 * (
        block.radiance - means
    )  # of the shading, 70 % is there: the model shows .3/.7 of it too much
    _, photos = misfit(*changed(exact, radiance=flatter))
    assert (
        photos["room0_0"].unexplained == pytest.approx((0.3 / 0.7) ** 2, rel=0.02)
        and photos["room1_1"].unexplained < 1e-6
    )


def test_a_material_called_by_anothers_name_is_unexplained_and_clipped_or_unsure_values_have_no_say(exact):
    block = exact[0].blocks[0]
    whole, photos = misfit(*changed(exact, material=2 - block.material))
    assert photos["room0_0"].unexplained > 0.1 and whole > 0.03
    wrong = {"radiance": block.radiance * 3, "clipped": np.ones_like(block.clipped)}
    assert misfit(*changed(exact, **wrong))[1]["room0_0"] == msgspec.convert(
        {"unexplained": 0.0, "clipped": 1.0}, type(photos["room0_0"])
    )
    unsure = {"radiance": block.radiance * 3, "confidence": np.full(len(block), 0.1)}
    assert misfit(*changed(exact, **unsure))[0] < 1e-6


def test_energy_is_that_of_the_groups_means_where_every_value_of_a_group_is_the_same():
    rng = np.random.default_rng(1)
    group = rng.integers(0, 30, 1000)
    of_group = rng.normal(size=(30, 3))
    assert energy(of_group[group], group) == pytest.approx(float((of_group[group] ** 2).sum()))
    noise = rng.normal(size=(1000, 3))
    assert energy(of_group[group] + noise, group) < 1.3 * energy(of_group[group], group)
    count = np.bincount(group)
    plain = sum((count * (np.bincount(group, of) / count) ** 2).sum() for of in noise.T)  # with what varies
    assert energy(noise, group) < 0.6 * plain
    assert energy(np.ones((3, 3)), np.zeros(3, int)) == 0  # too few


def test_bounds_that_hold_do_not_make_residuals_small(exact):
    problem, point = exact
    radiance = problem.blocks[0].radiance + 0.2
    half = np.zeros_like(problem.blocks[0].clipped)
    half[::2] = True
    low = np.where(half, 0.0, radiance)  # clipped below what the model says: no residual
    whole = residual_deviation(
        JointProblem([msgspec.structs.replace(problem.blocks[0], radiance=radiance)], OPERATOR),
        Point(MATERIALS, point.lights[:1]),
    )
    bounds = residual_deviation(
        JointProblem([msgspec.structs.replace(problem.blocks[0], radiance=low, clipped=half)], OPERATOR),
        Point(MATERIALS, point.lights[:1]),
    )
    assert bounds == pytest.approx(whole, rel=0.1)
