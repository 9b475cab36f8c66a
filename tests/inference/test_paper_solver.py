import msgspec
import numpy as np
import pytest
import torch

from factorlib.inference.paper_solver import PaperObjective, PaperOptions, draw_subset, solve
from factorlib.inference.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.scenes.joint_problems import MATERIALS, block, factor_between, random_light

OPERATOR = reflection_operator("network")
EXACT = reflection_operator("closed_form", dtype="float64")
QUICK = PaperOptions(lobes=8, samplings=200)


def rooms(photos=1, size=16):
    rng = np.random.default_rng(3)
    return [
        block(f"room{i}", random_light(rng, 3, photos), MATERIALS, [0, 1, 2], OPERATOR, size=size) for i in range(2)
    ]


def run(blocks, paper=QUICK):
    return solve(JointProblem(blocks, OPERATOR), 3, paper)


@pytest.fixture(scope="module")
def solved():
    blocks = rooms()
    return blocks, run(blocks)


def test_roughly_recovers_the_materials_and_the_radiance_it_was_rendered_with(solved):
    blocks, found = solved[0], solved[1].point
    factor, rough = factor_between(found.materials, MATERIALS), found.materials.roughness
    np.testing.assert_allclose(rough[1:], MATERIALS.roughness[1:], atol=0.15)  # the first is all but Lambertian
    # the glossy one is split badly
    np.testing.assert_allclose(found.materials.diffuse * factor, MATERIALS.diffuse, rtol=0.3, atol=0.05)
    for data, radiance in zip(blocks, JointProblem(blocks, OPERATOR).radiance(found), strict=True):
        assert np.sqrt(np.mean((radiance - data.radiance) ** 2)) < 0.05 * np.quantile(data.radiance, 0.99)
    for light in found.lights:
        assert len(light) == QUICK.lobes and (light.weight >= 0).all()
        assert np.isfinite(light.weight).all() and np.isfinite(light.sharpness).all()
        np.testing.assert_allclose(np.linalg.norm(light.axis, axis=1), 1)


def test_the_same_seed_gives_the_same_answer_and_scaling_a_photo_scales_its_light_alone():
    short, blocks = msgspec.structs.replace(QUICK, samplings=3), rooms(size=10)
    brighter = [msgspec.structs.replace(blocks[0], unit=7 * blocks[0].unit), blocks[1]]
    one, *others = (run(of, short).point for of in (blocks, blocks, brighter))
    for other in others:
        np.testing.assert_array_equal(one.materials.vector(), other.materials.vector())
        np.testing.assert_array_equal(one.lights[0].weight, other.lights[0].weight)  # in units of the block


def test_gradient_is_the_finite_difference():
    """Along random directions, each of which moves every unknown."""
    blocks, random = rooms(photos=2, size=8), torch.Generator().manual_seed(0)
    objective = PaperObjective(JointProblem(blocks, EXACT), 3, PaperOptions(lobes=3))
    subset = draw_subset([np.arange(len(b)) for b in blocks], 60, np.random.default_rng(0))
    start = objective.start()
    x = start + 0.3 * torch.randn(len(start), generator=random, dtype=torch.float64)
    _, gradient = objective.objective_on(x, subset)
    for move in torch.randn(6, len(start), generator=random, dtype=torch.float64):
        slope = (
            objective.objective_on(x + 1e-6 * move, subset)[0] - objective.objective_on(x - 1e-6 * move, subset)[0]
        ) / 2e-6
        assert float(gradient @ move) == pytest.approx(float(slope), rel=1e-4)
