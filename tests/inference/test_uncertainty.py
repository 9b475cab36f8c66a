"""Standard errors of materials and lights, of few lobes and of natural lights; and what is unexplained."""

import msgspec
import numpy as np
import pytest

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.inference.identifiability import tinted_alike
from factorlib.inference.misfit import misfit
from factorlib.inference.uncertainty import LARGEST, Posterior, relative_standard_errors, standard_errors
from factorlib.inference.materials import Materials, Point
from factorlib.inference.noise import Loss
from factorlib.inference.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes.descent import Iterate, descend, evaluate
from factorlib.solve.few_lobes.equations import normal_equations
from studies.scenes.problems import MATERIALS, block, factor_between, random_light
from tests.inference.made import in_units_of
from tests.inference.made_lights import PRIOR, natural

OPERATOR, LOSS = reflection_operator("network"), Loss()
NOISE = 0.5


def noisy(seed: int):
    """Two lights of few lobes with independent noise, and the answer next to the truth."""
    rng = np.random.default_rng(seed)
    lights, blocks = [random_light(rng, 3) for _ in range(2)], []
    for k, light in enumerate(lights):
        data = block(f"room{k}", light, MATERIALS, [0, 1, 2], OPERATOR, size=20)
        radiance = data.radiance + NOISE * rng.normal(size=data.radiance.shape) / data.precision
        blocks.append(msgspec.structs.replace(data, radiance=radiance, held_out=np.zeros(len(data), bool)))
    problem, start = JointProblem(blocks, OPERATOR, LOSS), Point(MATERIALS, in_units_of(blocks, lights))
    return problem, descend(problem, evaluate(problem, start), 25, 1e-7).point


@pytest.fixture(scope="module")
def solved():
    return noisy(0)


def test_scores_of_clusters_sum_to_the_gradient(solved):
    problem, point = solved
    first = Point(MATERIALS, point.lights[:1])
    whole = normal_equations(problem.illuminations(Point(MATERIALS, point.lights))[0], Loss(prior=0.0), clustered=True)
    np.testing.assert_allclose(
        whole.scores.sum(0), np.concatenate([whole.material_gradient, whole.light_gradient]), atol=1e-8
    )
    assert len(whole.scores) > 20
    _, (reduced,) = Iterate(first, [whole]).information()
    assert reduced.shape == (len(whole.scores), 21)


def inside(found: Materials, errors: Materials) -> list[bool]:
    """Whether each true value lies within one standard error, after the factor per channel that is free."""
    factor = factor_between(found, MATERIALS)
    true = Materials(MATERIALS.diffuse / factor, MATERIALS.specular / factor, MATERIALS.roughness)
    return (np.abs(found.vector() - true.vector()) < errors.vector()).tolist()


def test_with_independent_noise_two_thirds_of_true_values_lie_within_one_standard_error():
    within = []
    for seed in range(8):
        problem, point = noisy(seed)
        errors, sigma = standard_errors(problem, point)
        assert sigma == pytest.approx(NOISE, rel=0.1)
        within += inside(point.materials, errors)
    assert 0.58 < np.mean(within) < 0.85, np.mean(within)


def test_directions_that_no_observation_mirrors_are_known_less(solved):
    problem, point = solved
    given = problem.illuminations(point)[0]
    upper = given.block.take(given.block.normal[:, 1] < -0.2)  # camera frame: y down, so normals that face upward
    errors = relative_standard_errors(msgspec.structs.replace(given, block=upper), LOSS, 0.5)
    directions = lat_long_directions(*errors.shape[:2]) @ YUP_FROM_CAMERA
    above, below = errors[directions[..., 1] < -0.6], errors[directions[..., 1] > 0.8]
    assert (errors > 0).all() and (errors <= LARGEST).all()
    assert np.median(below) > 5 * np.median(above)


# ── a joint solve's: they cover the truth, and nothing is known for sure that is not ─────────────────────────────────


@pytest.fixture(scope="module")
def fit():
    """The problem, the true lights, the fit, and the errors of its materials."""
    problem, true, found = natural()
    return problem, true, found, Posterior(problem, found, PRIOR).standard_errors()


def test_materials_lie_within_a_few_standard_errors(fit):
    errors, m = fit[3].materials.rows(), fit[2].point.materials
    factor = np.concatenate([np.tile(factor_between(m, MATERIALS), 2), [1.0]])
    off = (m.rows() * factor - MATERIALS.rows()) / (errors * factor)
    assert np.mean(np.abs(off) < 1) > 0.5 and np.mean(np.abs(off) < 3) > 0.95, np.round(off, 1)


def test_lights_lie_within_their_standard_errors(fit):
    """Log radiance of cells, after the factor per channel that is free: about 68 % within one posterior standard deviation."""
    problem, true, found, _ = fit
    made, within = [], []
    posterior = Posterior(problem, found, PRIOR, lambda: made.append(1))
    for system, light, true_light in zip(posterior.systems(with_scores=False), found.point.lights, true, strict=True):
        cells = 3 * len(light)
        deviation = np.sqrt(np.diag(np.linalg.inv(system.light_hessian))[:cells]).reshape(3, -1)
        off = light.log_radiance - true_light.log_radiance
        within.append(np.abs(off - np.median(off, axis=1, keepdims=True)) < deviation)
    assert 0.5 < np.mean(within) < 0.9 and len(made) == len(true)  # a tick a light
    maps = posterior.relative_standard_errors()
    assert set(maps) == {"room0", "room1", "room2"}
    assert all(((m > 0) & (m <= LARGEST)).all() and np.isfinite(m).all() for m in maps.values())


# ── what is said of the lights' colour ──────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("tints", "bounced", "said"),
    [
        ([[1, 3, 3], [1, 4, 3]], True, True),  # red is what surfaces are then
        ([[1, 3, 3], [1, 4, 3]], False, False),  # the rule of the gauge makes lights grey
        ([[1, 3, 3], [4, 1, 1]], True, False),  # one light is blue-green, another red: not alike
        ([[1, 1.3, 1.2], [1, 1.2, 1.5]], True, False),  # as natural lights are
    ],
)
def test_a_colour_that_all_lights_have_is_named_where_interreflection_fixes_it(tints, bounced, said):
    rng, operator = np.random.default_rng(0), reflection_operator("closed_form", dtype="float64")
    replaced, lights = msgspec.structs.replace, [random_light(rng, 3) for _ in tints]
    grey = [replaced(one, weight=np.repeat(one.weight.mean(1, keepdims=True), 3, axis=1)) for one in lights]
    blocks = [block(f"room{k}", light, MATERIALS, [0, 1, 2], operator, size=6) for k, light in enumerate(grey)]
    if bounced:
        blocks = [replaced(one, bounced=np.zeros((len(one), 6))) for one in blocks]
    pairs = enumerate(zip(grey, tints, strict=True))
    lights = [replaced(light, weight=10.0**k * light.weight * tint) for k, (light, tint) in pairs]
    sentences = list(tinted_alike(JointProblem(blocks, operator), Point(MATERIALS, lights)))
    assert len(sentences) == said
    if said:
        for words in ("room0, room1", "R : G : B = 0.4", "solve.interreflection=off"):
            assert words in sentences[0]


# ── what is unexplained: what neighbours leave alike ──────────────────────────────────────────────────────────────────


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
