"""A light is known better, and in absolute terms, where its photos show the surroundings."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factorlib.conventions import YUP_FROM_CAMERA, lat_long_directions
from factorlib.inference.background import (
    DEVIATION,
    SCALE_DEVIATION,
    SHARED_COVARIANCE,
    Background,
    concatenate_backgrounds,
    condition_on_background,
)
from factorlib.inference.fit_runner import FitRunner
from factorlib.inference.gauge import has_free_factor
from factorlib.inference.held_out_photos import fit_held_out_lights
from factorlib.inference.joint_solver import LIGHTS, solve
from factorlib.inference.options import SolveOptions
from factorlib.inference.paper_solver import PaperOptions, solve_paper
from factorlib.inference.start import start_from_photos
from factorlib.scenes.joint_problems import MATERIALS
from tests.inference.made_lights import PRIOR, drawn, on_even_cells, photographed

QUICK = SolveOptions(cells=60, splittings=0, observations=300, tone="off", distance="off")


def lower_half(light, unit=1.0, factor=1.0) -> Background:
    """What a camera that looks down at the objects shows of their light."""
    directions = lat_long_directions(24, 48)
    radiance = light.lobes.radiance((directions @ YUP_FROM_CAMERA).reshape(-1, 3)).reshape(24, 48, 3)
    return Background.from_map(factor * radiance * (directions[..., 1:2] < 0), np.eye(3), unit)


@pytest.mark.parametrize("width", [1.0, 2.0])
def test_the_prior_given_a_background_is_that_of_gaussian_regression(width):
    light = on_even_cells(drawn(3, 80))
    Q, _ = PRIOR.precision(light.axis)
    background = msgspec.structs.replace(lower_half(light), width=width)
    mean, P, log_determinant = condition_on_background(Q, background, light)
    # the slow way, by covariances: K = Q⁻¹, m = K_s (K_ss + N)⁻¹ b, P⁻¹ = K − K_s (K_ss + N)⁻¹ K_sᵀ over seen cells s
    coverage, b = background.observe(light)
    s = np.flatnonzero(np.tile(coverage, 3) > 1e-9)
    K, D = np.linalg.inv(Q), np.tile(coverage, 3) / DEVIATION**2
    errors = width**2 * (np.diag(1 / D[s]) + np.kron(SHARED_COVARIANCE, np.ones((80, 80)))[np.ix_(s, s)])
    gain = K[:, s] @ np.linalg.inv(K[np.ix_(s, s)] + errors)
    np.testing.assert_allclose(mean, gain @ b.T.reshape(-1)[s], atol=1e-6)
    np.testing.assert_allclose(np.linalg.inv(P), K - gain @ K[s], atol=1e-6)
    assert log_determinant == pytest.approx(np.linalg.slogdet(P)[1])
    # the scale of the whole light, which many cells observe, is known as well as one background's
    assert np.linalg.inv(P).mean() > 0.9 * SCALE_DEVIATION**2


def test_a_cell_sees_the_mean_of_its_own_part_of_the_surroundings():
    light = on_even_cells(drawn(4, 300))
    coverage, b = lower_half(light, unit=2.0).observe(light)
    below = light.axis[:, 1] > 0.3  # y points down
    assert coverage[below].min() > 0.95 and coverage[light.axis[:, 1] < -0.3].max() < 0.05
    error = b[below] - (light.log_radiance.T[below] - np.log(2))
    assert abs(np.median(error)) < 0.2 and error.std() < 0.5 * light.log_radiance.std()


def test_a_background_turns_with_the_camera_of_a_light_that_is_fixed_to_the_world():
    turn = Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix()
    lat_long = np.zeros((24, 48, 3))
    lat_long[15, 7] = 1.0
    still, turned = (Background.from_map(lat_long, rotation, 1.0) for rotation in (np.eye(3), turn))
    np.testing.assert_allclose(turned.direction, still.direction @ turn.T)


def test_a_narrow_view_is_no_background():
    """Of a telephoto lens, straight behind the objects; beside a wide one it says nothing either."""
    wide = lower_half(on_even_cells(drawn(3, 80)))
    narrow = Background(wide.direction[:20], 0.01 * wide.radiance[:20], wide.solid_angle[:20])
    assert concatenate_backgrounds([narrow]) is None and concatenate_backgrounds([]) is None
    np.testing.assert_array_equal(concatenate_backgrounds([narrow, wide]).radiance, wide.radiance)


@pytest.fixture(scope="module")
def lit():
    """Spheres in three lights, and the lights in the units of their blocks."""
    problem, true = photographed(6, 3, cells=60, size=12)
    blocks = [
        msgspec.structs.replace(block, background=lower_half(light)) for block, light in zip(problem.blocks, true)
    ]
    return problem.with_blocks(blocks)


def log_scale(solution) -> float:
    """Error of the log scale of all reflectances."""
    return abs(np.median(np.log(solution.point.materials.diffuse / MATERIALS.diffuse)))


def darkened(block):
    """The block with a black background."""
    background = msgspec.structs.replace(block.background, radiance=block.background.radiance * 2e-3)
    return msgspec.structs.replace(block, background=background)


def test_backgrounds_give_reflectances_without_a_gauge_and_one_that_is_wrong_is_left_out(lit):
    blocks = [lit.blocks[0], darkened(lit.blocks[1]), lit.blocks[2]]
    solution = solve(lit.with_blocks(blocks), start_from_photos(3), QUICK)
    assert [each.accepted for each in solution.backgrounds] == [True, False, True]
    error = log_scale(solution)
    assert error < 0.2
    off = solve(lit, start_from_photos(3), msgspec.structs.replace(QUICK, background="off"))
    assert not any(each.accepted for each in off.backgrounds) and log_scale(off) > error + 0.1


def test_a_background_that_objects_contradict_by_a_factor_of_three_is_trusted_less_and_not_left_out(lit):
    background = lit.blocks[1].background
    uneven = background.radiance * np.where(background.direction[:, :1] > 0, 3.0, 1 / 3)
    doubted = msgspec.structs.replace(lit.blocks[1], background=msgspec.structs.replace(background, radiance=uneven))
    solution = solve(lit.with_blocks([lit.blocks[0], doubted, lit.blocks[2]]), start_from_photos(3), QUICK)
    assert [each.accepted for each in solution.backgrounds] == [True] * 3
    assert solution.backgrounds[1].width > 1 == solution.backgrounds[0].width == solution.backgrounds[2].width


@pytest.mark.long
def test_where_no_background_is_kept_the_answer_is_that_without_backgrounds(lit):
    doubtful = lit.with_blocks([darkened(block) for block in lit.blocks]).keep_backgrounds([False, True, False])
    with_one, without = (solve(each, start_from_photos(3), QUICK) for each in (doubtful, lit.keep_backgrounds([])))
    assert with_one.backgrounds[1].log_bayes_factor < 0 and not with_one.backgrounds[1].accepted
    np.testing.assert_array_equal(with_one.point.materials.rows(), without.point.materials.rows())


def test_a_held_out_photo_gets_its_light_as_the_solve_does(lit, monkeypatch):
    """By the same schedule, and without a background that the objects are against."""
    solution = solve(lit.select_lights([0, 1]), start_from_photos(3), QUICK)
    fit, schedules = FitRunner.fit, []
    monkeypatch.setattr(FitRunner, "fit", lambda self, *how: schedules.append(how[-1]) or fit(self, *how))
    alone = lit.select_lights([2])
    dark = lit.with_blocks([darkened(lit.blocks[2])])
    given, without, doubtful = (
        fit_held_out_lights(each, solution, QUICK)[0]["room2"].weight
        for each in (alone, alone.keep_backgrounds([]), dark)
    )
    np.testing.assert_allclose(doubtful, without, rtol=0.02)
    assert np.abs(np.log(given / without)).max() > 0.1 and schedules[-1] is LIGHTS


def test_the_factor_of_a_component_is_free_unless_a_background_fixes_it(lit):
    names = [block.name for block in lit.blocks]
    assert not has_free_factor(lit.blocks, names)
    assert has_free_factor(lit.keep_backgrounds([]).blocks, names)


def test_the_solver_of_the_paper_ignores_backgrounds_and_keeps_its_gauge(lit):
    quick = PaperOptions(lobes=4, samplings=0.5)
    with_them, without = (solve_paper(each, 3, quick) for each in (lit, lit.keep_backgrounds([])))
    np.testing.assert_array_equal(with_them.point.materials.rows(), without.point.materials.rows())
