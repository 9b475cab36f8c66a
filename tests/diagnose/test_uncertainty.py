"""Standard errors of materials, and of the light in every direction."""

import msgspec
import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.diagnose.coverage import LARGEST, relative_standard_errors
from factorlib.diagnose.uncertainty import clustered_equations, standard_errors
from factorlib.model.loss import Loss
from factorlib.model.materials import Materials
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes.arrow import ArrowSystem
from factorlib.solve.few_lobes.descent import Descent, descend, evaluate
from factorlib.solve.few_lobes.history import Run
from factorlib.solve.few_lobes.options import FewLobes
from factorlib.solve.few_lobes.solve import few_lobes
from studies.scenes.problems import MATERIALS, block, factor_between, random_light

OPERATOR, LOSS = reflection_operator("network"), Loss()
FEW_LOBES = FewLobes(lobes=16, insert=8, rounds=4, specular="on")
NOISE = 0.5


def noisy(seed: int):
    """Two lights of few lobes with independent noise, and the answer next to the truth."""
    rng = np.random.default_rng(seed)
    lights, blocks = [random_light(rng, 3) for _ in range(2)], []
    for k, light in enumerate(lights):
        data = block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR, size=20)
        radiance = data.radiance + NOISE * rng.normal(size=data.radiance.shape) / data.precision
        blocks.append(msgspec.structs.replace(data, radiance=radiance, held_out=np.zeros(len(data), bool)))
    scaled = [
        msgspec.structs.replace(light, weight=light.weight / data.unit)
        for light, data in zip(lights, blocks, strict=True)
    ]
    problem = JointProblem(blocks, OPERATOR, LOSS)
    return problem, descend(problem, evaluate(problem, Point(MATERIALS, scaled)), Descent(25, 1e-7)).point


@pytest.fixture(scope="module")
def solved():
    return noisy(0)


def test_scores_of_clusters_sum_to_the_gradient(solved):
    problem, point = solved
    whole = clustered_equations(problem.illuminations(Point(MATERIALS, point.lights))[0], Loss(prior=0.0))
    np.testing.assert_allclose(
        whole.scores.sum(0), np.concatenate([whole.material_gradient, whole.light_gradient]), atol=1e-8
    )
    assert len(whole.scores) > 20
    (reduced,) = ArrowSystem([whole], 21).reduced_scores(Point(MATERIALS, point.lights[:1]))
    assert reduced.shape == (len(whole.scores), 21)


def test_with_independent_noise_two_thirds_of_true_values_lie_within_one_standard_error():
    inside = []
    for seed in range(8):
        problem, point = noisy(seed)
        errors, sigma = standard_errors(problem, point)
        found = point.materials
        factor = (MATERIALS.diffuse + MATERIALS.specular).sum(0) / (found.diffuse + found.specular).sum(0)
        assert sigma == pytest.approx(NOISE, rel=0.1)
        for own, true, error in (
            (found.diffuse * factor, MATERIALS.diffuse, errors.diffuse * factor),
            (found.specular * factor, MATERIALS.specular, errors.specular * factor),
            (found.roughness, MATERIALS.roughness, errors.roughness),
        ):
            inside += (np.abs(own - true) < error).ravel().tolist()
    assert 0.58 < np.mean(inside) < 0.85, np.mean(inside)


@pytest.mark.long
def test_where_lights_have_more_features_than_lobes_true_values_still_lie_within_the_errors():
    """No noise: all error is the lobes' own bias.  Of narrow residuals about .46 lie within.  Errors of one scene go together: eight."""
    inside = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        blocks = [
            block(f"room{i}", random_light(rng, 120), MATERIALS, [0, 1, 2], OPERATOR, size=16, seed=i) for i in range(4)
        ]
        problem = JointProblem(blocks, OPERATOR)
        solution = few_lobes(problem, 3, Run(FEW_LOBES))
        found, errors = (
            solution.point.materials,
            standard_errors(problem.with_loss(solution.loss), solution.point).materials,
        )
        factor = factor_between(found, MATERIALS)
        true = Materials(MATERIALS.diffuse / factor, MATERIALS.specular / factor, MATERIALS.roughness)
        inside += (np.abs(found.vector() - true.vector()) < errors.vector()).tolist()
    assert 0.58 < np.mean(inside) < 0.82, np.mean(inside)


def test_noise_twice_as_large_doubles_the_errors(solved):
    problem, point = solved
    louder = [
        msgspec.structs.replace(b, radiance=b.radiance + (b.radiance - predicted))
        for b, predicted in zip(problem.blocks, problem.radiance(point), strict=True)
    ]
    plain = problem.with_loss(Loss(robust_scale=1e3))
    once, twice = (standard_errors(p, point).materials for p in (plain, msgspec.structs.replace(plain, blocks=louder)))
    np.testing.assert_allclose(twice.roughness, 2 * once.roughness, rtol=0.05)


def test_directions_that_no_observation_mirrors_are_known_less(solved):
    problem, point = solved
    given = problem.illuminations(point)[0]
    upper = given.block.take(given.block.normal[:, 1] < -0.2)  # camera frame: y down, so normals that face upward
    errors = relative_standard_errors(msgspec.structs.replace(given, block=upper), LOSS, 0.5)
    directions = lat_long_directions(*errors.shape[:2]) @ YUP_FROM_CAMERA
    above, below = errors[directions[..., 1] < -0.6], errors[directions[..., 1] > 0.8]
    assert (errors > 0).all() and (errors <= LARGEST).all()
    assert np.median(below) > 5 * np.median(above)
