"""Laws of the joint problem: the gauge changes no radiance, and which observations judge."""

import msgspec
import numpy as np
import pytest

from factorlib.model.gauge import in_gauge
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from tests.model.made import three_rooms


@pytest.fixture(scope="module")
def given():
    return three_rooms()


def test_the_gauge_changes_no_radiance_and_a_shifted_point_comes_to_the_same_one(given):
    problem, point = given
    factor = np.array([2.0, 0.5, 1.3])
    shifted = Point(
        Materials(point.materials.diffuse * factor, point.materials.specular * factor, point.materials.roughness),
        [msgspec.structs.replace(light, weight=light.weight / factor) for light in point.lights],
    )
    settled = [in_gauge(p, problem.blocks) for p in (point, shifted)]
    np.testing.assert_allclose(settled[0].materials.vector(), settled[1].materials.vector(), rtol=1e-12)
    for at in (*settled, shifted):
        for found, expected in zip(problem.radiance(at), problem.radiance(point), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_point_has_one_light_per_block(given):
    problem, point = given
    with pytest.raises(ValueError):
        problem.radiance(point.restricted([0, 1]))


def test_where_none_is_held_out_all_are_judged(given):
    problem, point = given
    everything = problem.with_none_held_out()
    losses = np.concatenate(everything.held_out_losses(point))
    assert len(losses) == sum(map(len, problem.blocks)) and everything.held_out_loss(point) == pytest.approx(
        losses.mean()
    )
    assert len(np.concatenate(problem.held_out_losses(point))) == sum(int(b.held_out.sum()) for b in problem.blocks)
