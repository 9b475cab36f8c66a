"""Standard errors of materials and lights, what is said of the lights' colour, and what is unexplained."""

import msgspec
import numpy as np
import pytest

from factorlib.inference.identifiability import tinted_alike
from factorlib.inference.materials import Point
from factorlib.inference.misfit import unexplained_shares
from factorlib.inference.problem import JointProblem
from factorlib.inference.uncertainty import LARGEST_RELATIVE_ERROR, Posterior
from factorlib.reflection import reflection_operator
from factorlib.scenes.joint_problems import MATERIALS, block, factor_between, random_light
from tests.inference.made import in_units_of
from tests.inference.made_lights import PRIOR, natural

OPERATOR = reflection_operator("network")


# ── they cover the truth, and nothing is known for sure that is not ─────────────────────────────────


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
        off = light.log_radiance - np.log(true_light.lobes.radiance(light.axis)).T
        within.append(np.abs(off - np.median(off, axis=1, keepdims=True)) < deviation)
    assert 0.5 < np.mean(within) < 0.9 and len(made) == len(true)  # a tick a light
    maps = posterior.relative_standard_errors()
    assert set(maps) == {"room0", "room1", "room2"}
    assert all(((m > 0) & (m <= LARGEST_RELATIVE_ERROR)).all() and np.isfinite(m).all() for m in maps.values())


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


def unexplained(problem, point):
    """The misfit of a point."""
    return unexplained_shares(problem, problem.radiance(point))


def test_the_truth_leaves_nothing_and_noise_next_to_nothing(exact):
    whole, photos = unexplained(*exact)
    assert whole < 1e-6 and set(photos) == {"room0_0", "room1_0", "room1_1"}
    assert {type(whole), *(type(photo.unexplained) for photo in photos.values())} == {float}  # as JSON takes it
    radiance = exact[0].blocks[0].radiance
    noisy = radiance + 0.1 * np.random.default_rng(0).normal(size=radiance.shape)
    assert unexplained(*changed(exact, radiance=noisy))[0] < 0.01


def test_what_neighbours_leave_alike_is_the_share_of_the_shading_that_it_is(exact):
    block = exact[0].blocks[0]
    means = np.array([block.radiance[block.material == m].mean(0) for m in block.material])
    flatter = means + 0.7 * (
        block.radiance - means
    )  # of the shading, 70 % is there: the model shows .3/.7 of it too much
    _, photos = unexplained(*changed(exact, radiance=flatter))
    assert photos["room0_0"].unexplained == pytest.approx((0.3 / 0.7) ** 2, rel=0.02)
    assert photos["room1_1"].unexplained < 1e-6
