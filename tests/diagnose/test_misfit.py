"""What is unexplained: what neighbours leave alike, and not what varies from one observation to the next."""

import msgspec
import numpy as np
import pytest

from factorlib.diagnose.misfit import misfit
from factorlib.model.materials import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from studies.scenes.problems import MATERIALS, block, random_light
from tests.model.made import in_units_of

OPERATOR = reflection_operator("network")


@pytest.fixture(scope="module")
def exact():
    """Two lights, two photos of the second, each showing three balls, at the truth."""
    rng = np.random.default_rng(3)
    lights = [random_light(rng, 3), random_light(rng, 3, photos=2)]
    blocks = [block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR) for k, light in enumerate(lights)]
    return JointProblem(blocks, OPERATOR), Point(MATERIALS, in_units_of(blocks, lights))


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
    assert photos["room0_0"].unexplained == pytest.approx((0.3 / 0.7) ** 2, rel=0.02)
    assert photos["room1_1"].unexplained < 1e-6
