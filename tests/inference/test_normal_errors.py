"""Errors of normals: held to draws of turned normals and to turned objects."""

import msgspec
import numpy as np
import pytest

from factorlib.inference.answer.uncertainty import Posterior
from factorlib.inference.fit.fit import Fit, FitSchedule, Hyperparameters, fit_problem
from factorlib.inference.model.blocks import Noise
from factorlib.inference.model.forward import Illumination
from factorlib.inference.model.lights import Light
from factorlib.inference.model.materials import Materials, Point
from factorlib.inference.model.normal_errors import DEVIATION, POSE_DEVIATION, normal_errors, with_normal_errors
from factorlib.inference.model.observed import blocks_of_observations
from factorlib.inference.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.scenes.joint_problems import (
    MATERIALS,
    observations_from_front,
    random_light,
    sphere_block,
    sphere_normals,
)
from tests.inference.made_lights import PRIOR, drawn, on_even_cells, spheres

OPERATOR = reflection_operator("closed_form")
DRAWS = 400
CELLS = 120


@pytest.fixture(scope="module")
def problem():
    """Return spheres of three materials in one light, and the point that they were rendered from."""
    rng = np.random.default_rng(4)
    light = random_light(rng, 8)
    block = sphere_block("light0", light, MATERIALS, [0, 1, 2], OPERATOR, size=12)
    block = msgspec.structs.replace(block, confidence=rng.uniform(0.3, 1.0, len(block)))
    return JointProblem([block], OPERATOR), Point(MATERIALS, [light])


def widening(problem, point):
    """Return the factor on σ of every observation."""
    (before,) = problem.blocks
    (after,) = with_normal_errors(problem, point).blocks
    return before.inverse_sigma / after.inverse_sigma


def test_the_variance_is_that_of_radiance_at_turned_normals(problem):
    of, point = problem
    (block,) = of.blocks
    rng = np.random.default_rng(0)
    # tangents of every normal, and normals turned by draws along both
    first = np.cross(block.normal, np.eye(3)[np.abs(block.normal).argmin(1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(block.normal, first)], axis=1)
    # a tenth of the errors, at which radiance is linear in the turn
    deviation = 0.1 * DEVIATION * np.sqrt(block.confidence**-2.0 - 1)
    residuals = []
    for _ in range(DRAWS):
        turned = block.normal + np.einsum("nt,ntx->nx", deviation[:, None] * rng.normal(size=(len(block), 2)), tangents)
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        drawn = msgspec.structs.replace(block, normal=turned)
        residuals.append(Illumination(drawn, point.lights[0], point.materials, OPERATOR).residuals())
    variance = 100 * np.var(residuals, axis=0)
    ratio = (1 + variance) / widening(*problem) ** 2
    assert np.median(ratio) == pytest.approx(1, abs=0.01)
    assert np.quantile(np.abs(ratio - 1), 0.9) < 0.15


def test_turns_of_poses_are_the_change_of_radiance_that_they_cause(problem):
    of, point = problem
    (block,) = of.blocks
    two_objects = msgspec.structs.replace(block, object=(block.normal[:, 0] > 0).astype(int))
    (errors,) = normal_errors(of.with_blocks([two_objects]), point)
    turns = np.random.default_rng(1).normal(size=6)
    angle = 0.1 * POSE_DEVIATION * turns.reshape(2, 3)[two_objects.object]
    turned = block.normal + np.cross(angle, block.normal)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    before, after = (
        Illumination(
            msgspec.structs.replace(block, normal=normal), point.lights[0], point.materials, OPERATOR
        ).radiance()
        for normal in (block.normal, turned)
    )
    change = 10 * (after - before)
    np.testing.assert_allclose(errors.by_turns @ turns, change, atol=0.02 * np.abs(change).max())


def test_the_fit_finds_the_turns_of_poses():
    """Of photos in one light, up to a turn of all, which the light shares."""
    light = on_even_cells(drawn(2, CELLS), [0.0, 0.0, 0.0])
    true = spheres([light], noise=0.1)
    turns = np.random.default_rng(3).normal(size=(3, 3))
    normal = true.blocks[0].normal + np.cross(POSE_DEVIATION * turns[true.blocks[0].photo], true.blocks[0].normal)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    (block,) = true.blocks
    turned = Illumination(msgspec.structs.replace(block, normal=normal), light, MATERIALS, OPERATOR).radiance()
    sure = np.ones(len(block))
    block = msgspec.structs.replace(block, confidence=sure, radiance=turned / block.unit)
    light = light.with_log_radiance(light.log_radiance - np.log(block.unit))
    problem = with_normal_errors(JointProblem([block], OPERATOR), Point(MATERIALS, [light]))
    start = Fit(Point(MATERIALS, [light]), [Hyperparameters(temperature=1.0)])
    fit = fit_problem(problem, start, PRIOR, FitSchedule(6, materials_fixed=True))
    found = fit.point.lights[0].turns.reshape(3, 3)
    relative, wanted = (each - each.mean(0) for each in (found, turns))
    assert np.abs(relative - wanted).max() < 0.3 and np.abs(wanted).max() > 1


def test_sure_normals_count_in_full_and_unsure_ones_less(problem):
    of, point = problem
    (block,) = of.blocks
    none, sure, unsure = (
        widening(of.with_blocks([msgspec.structs.replace(block, confidence=confidence)]), point)
        for confidence in (None, np.ones(len(block)), np.full(len(block), 0.1))
    )
    np.testing.assert_array_equal(none, 1.0)
    np.testing.assert_array_equal(sure, 1.0)
    assert np.all(unsure >= 1) and np.median(unsure) > 1.5


def test_confidence_is_no_factor_on_the_weight():
    """Weights of `urm` are pixels times confidence; the variance of normals counts it once."""
    normal = sphere_normals(6)
    blocks = [
        blocks_of_observations(
            observations_from_front(
                normal, np.ones((len(normal), 3)), np.zeros(len(normal), int), ("red",), weight=sure, confidence=sure
            ),
            Noise(),
        )[0]
        for sure in (np.full(len(normal), 0.25), np.ones(len(normal)))
    ]
    np.testing.assert_allclose(blocks[0].inverse_sigma, blocks[1].inverse_sigma)


def blur(problem, point) -> np.ndarray:
    """Return the error of each roughness by errors of normals."""
    return Posterior(problem, Fit(point, [Hyperparameters()]), PRIOR).blur()


@pytest.mark.parametrize("roughness", [0.25, 0.5])
def test_turned_normals_look_as_rough_as_the_error_of_roughness_says(roughness):
    """Of a mirror-like sphere in one narrow lobe: the mean over draws, fitted by another roughness."""
    axis = np.array([0.3, -0.4, -1.0])
    light = Light(axis[None] / np.linalg.norm(axis), np.log([2000.0]), np.full((1, 3), 100.0), np.zeros(1))
    metal = Materials(np.zeros((1, 3)), np.full((1, 3), 0.5), np.array([roughness]))
    block = sphere_block("light0", light, metal, [0], OPERATOR, size=40)
    rng = np.random.default_rng(2)
    confidence = 0.2
    drawn = []
    for _ in range(60):
        turn = DEVIATION / confidence * rng.normal(size=block.normal.shape)
        turned = block.normal + np.cross(turn, block.normal)
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        one = Illumination(msgspec.structs.replace(block, normal=turned), light, metal, OPERATOR)
        drawn.append(one.radiance())
    mean = np.mean(drawn, axis=0)
    candidates = np.linspace(roughness, roughness + 0.3, 61)
    errors = []
    for r in candidates:
        rough = Materials(metal.diffuse, metal.specular, np.array([r]))
        errors.append(np.square(Illumination(block, light, rough, OPERATOR).radiance() - mean).sum())
    sure = msgspec.structs.replace(block, confidence=np.full(len(block), confidence))
    stated = blur(JointProblem([sure], OPERATOR), Point(metal, [light]))
    assert candidates[np.argmin(errors)] - roughness == pytest.approx(stated[0], rel=0.3)
    assert blur(JointProblem([block], OPERATOR), Point(metal, [light])) == pytest.approx(0)
