"""The comparison's baselines: what each can do by its own rules, and that none of them gets more than it may know."""

import msgspec
import numpy as np
import pytest

from factorlib.conventions import lat_long_directions, lat_long_solid_angles
from factorlib.evaluate.materials import compare_materials
from factorlib.results.materials import Reflectance
from studies.core.baselines.body import level, mesh, pose, seen, turn
from studies.core.baselines.gauge import in_gauge, lambertian_part
from studies.core.baselines.grey import grey
from studies.core.baselines.intrinsic import (
    LAMBERT,
    averaged,
    decomposed,
    harmonics,
    intrinsic,
    light_coefficients,
    light_map,
)
from studies.core.baselines.photos import Photos, observations_of, read_photos
from studies.core.baselines.prediction import Rendered
from studies.core.baselines.projective import Texture, projective
from studies.core.baselines.scene import Scene
from studies.core.baselines.score import KINDS, SUFFIXES, World, score_of, shots
from studies.core.baselines.show import sheet
from studies.core.gauge import factor_of, times
from studies.core.world import materials_of
from tests.studies.made_body import case, light, lights, photos

VIEW = turn(70, 15)
RNG = np.random.default_rng(0)


# ── the body ─────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("view", [np.eye(3), VIEW, turn(160, -10)])
def test_a_camera_sees_the_front_of_the_body(view):
    found = seen(3, 24, view)
    inside = found.points @ pose(3)  # body's frame
    assert level(inside) == pytest.approx(1, abs=1e-6)
    nearer = found.points + 1e-3 * view[2]
    assert (level(nearer @ pose(3)) > 1).all() and (found.normals_in_view[:, 2] > 0.15).all()


def test_normals_are_those_of_the_surface():
    found, step = seen(1, 16), 1e-6
    slope = np.stack(
        [(level((found.points + step * e) @ pose(1)) - level((found.points - step * e) @ pose(1))) for e in np.eye(3)],
        axis=-1,
    )
    assert found.normals == pytest.approx(slope / np.linalg.norm(slope, axis=1, keepdims=True), abs=1e-4)


def test_the_mesh_is_the_body():
    found = mesh(2)
    assert level(found.vertices @ pose(2)) == pytest.approx(1, abs=1e-9)
    corners = found.vertices[found.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outward * found.normals[found.faces].mean(axis=1)).sum(axis=1) > 0).all()


def test_the_body_and_its_light_stay_where_they_are_when_the_camera_moves():
    """Lambert looks alike from everywhere: a point has one radiance in all views that see it."""
    here, there, material, of = (
        seen(0, 48),
        seen(0, 48, VIEW),
        Reflectance((0.5, 0.4, 0.3), (0.0, 0.0, 0.0), 1.0),
        light(1, 64),
    )
    texture = Texture(here)
    both = texture.seen(there)
    carried, exact = texture.at(there, Scene(of, here).of(material))[both], Scene(of, there).of(material)[both]
    assert 0.3 < both.mean() < 0.95 and np.abs(carried / exact - 1).mean() < 0.02
    mirrored = Scene(of[:, ::-1], there).of(material)[both]
    assert np.abs(carried / mirrored - 1).mean() > 0.05


def test_photos_survive_their_files(tmp_path):
    from factorlib.urm.observations import write_observations

    of = case("ours", side=2)
    shown = photos(of)
    for name, table in observations_of(of, shown).items():
        write_observations(tmp_path / f"{name}.parquet", table)
    found = read_photos(of, tmp_path)
    assert found.radiance.keys() == shown.radiance.keys()
    assert all(np.allclose(found.radiance[e], shown.radiance[e], rtol=1e-6) for e in shown.radiance)


# ── projective texturing ─────────────────────────────────────────────────────────────────────────────────────────────


def test_a_texture_seen_from_where_it_was_taken_is_the_photo():
    of = case("projective")
    shown = photos(of)
    assert projective(shown).new_view("leaf", 1, shown.seen) == pytest.approx(shown.radiance["leaf", 1], rel=1e-4)


def test_a_new_light_changes_nothing_in_a_texture_and_it_has_no_answer_for_a_new_material():
    found, camera = projective(photos(case("projective"))), seen(0, 24, VIEW)
    assert np.array_equal(found.new_light("leaf", light(1), camera), found.new_light("leaf", light(2), camera))
    assert found.new_material(materials_of(0)["gold"], 0, camera) is None


def test_what_the_photo_did_not_see_is_filled_from_it():
    shown, camera = photos(case("projective")), seen(0, 24, turn(180, 0))
    assert not Texture(shown.seen).seen(camera).any()
    colours, photo = projective(shown).new_view("brick", 0, camera), shown.radiance["brick", 0]
    assert (colours >= photo.min(axis=0)).all() and (colours <= photo.max(axis=0)).all()


# ── intrinsic decomposition ──────────────────────────────────────────────────────────────────────────────────────────


def test_harmonics_are_orthonormal():
    directions, area = lat_long_directions(256, 512), lat_long_solid_angles(256, 512)
    basis = harmonics(directions)
    assert np.einsum("h,hwj,hwk->jk", area, basis, basis) == pytest.approx(np.eye(9), abs=1e-3)


def test_nine_harmonics_shade_lambert_as_the_quadrature_does():
    camera, of = seen(0, 16), light(3, 64)
    shaded = harmonics(camera.normals) @ (LAMBERT[:, None] * light_coefficients(of))
    exact = Scene(of, camera).diffuse
    assert np.abs(shaded / exact - 1).mean() < 0.03
    smooth = light_map(LAMBERT[:, None] * light_coefficients(np.ones((16, 32, 3))))
    assert smooth == pytest.approx(np.ones_like(smooth), rel=0.01)


def test_lambert_without_highlights_is_decomposed_exactly():
    normals, shading = seen(0, 24).normals, np.vstack([[3, 2.5, 2], 0.3 * RNG.normal(size=(8, 3))])
    albedo = {"a": np.array([0.5, 0.2, 0.1]), "b": np.array([0.1, 0.4, 0.3])}
    found = decomposed(normals, {name: k * (harmonics(normals) @ shading) for name, k in albedo.items()})
    assert found.albedo["a"] / found.albedo["b"] == pytest.approx(albedo["a"] / albedo["b"], rel=1e-6)
    assert all(of.max() < 1e-6 for of in found.highlight.values())


def test_a_highlight_is_what_is_left_over():
    normals = seen(0, 32).normals
    lit = harmonics(normals) @ np.vstack([[3, 2.5, 2], np.full((8, 3), 0.2)])
    gloss = 5 * np.exp(80 * (normals @ np.array([0.3, 0.4, np.sqrt(0.75)]) - 1))[:, None]
    found = decomposed(normals, {"a": 0.4 * lit + gloss, "b": 0.2 * lit})
    assert found.albedo["a"] / found.albedo["b"] == pytest.approx(np.full(3, 2), rel=0.02)
    assert np.abs(found.highlight["a"] - gloss).mean() < 0.05 * gloss.mean()


def test_albedos_are_averaged_over_photos_that_each_know_them_but_for_a_factor():
    albedo = {n: np.array(v) for n, v in {"a": (0.5, 0.2, 0.1), "b": (0.1, 0.4, 0.3), "c": (0.3, 0.3, 0.3)}.items()}
    shows = {0: ("a", "b"), 1: ("b", "c"), 2: ("a", "b", "c")}
    scale = {li: RNG.uniform(0.5, 2, 3) for li in shows}
    normals = seen(0, 12).normals
    parts = {
        li: decomposed(normals, {n: scale[li] * albedo[n] * np.ones((len(normals), 3)) for n in names})
        for li, names in shows.items()
    }
    found, _ = averaged(parts)
    factor = albedo["a"] / found["a"]
    assert all(found[n] * factor == pytest.approx(albedo[n], rel=1e-6) for n in albedo)


@pytest.mark.parametrize("seed", [200, 201, 202])
def test_its_albedo_beats_a_grey_one_on_truth(seed):
    """Else it would be no baseline."""
    truths = materials_of(seed)
    found = intrinsic(photos(case("intrinsic", seed=seed, size=32)), truths)
    errors = compare_materials(found.materials, lambertian_part(truths), dict.fromkeys(found.materials, 0))
    assert errors.mean_diffuse < 0.8 * errors.null_mean_diffuse


def test_its_answer_does_not_depend_on_the_scale_of_photos():
    """What no photo tells, a factor per channel and photo, changes neither albedos nor what is predicted of a new light."""
    of = case("intrinsic", side=2)
    shown, camera = photos(of), seen(0, 24, VIEW)
    scaled = Photos(shown.seen, {(n, li): v * (1.0 + li) for (n, li), v in shown.radiance.items()})
    plain, other = (intrinsic(p, materials_of(0)) for p in (shown, scaled))
    assert np.allclose(plain.materials["leaf"].diffuse, other.materials["leaf"].diffuse, rtol=1e-3)
    assert other.new_view("leaf", 1, camera) == pytest.approx(2 * plain.new_view("leaf", 1, camera), rel=1e-2)


# ── grey ball, gauge, scores ─────────────────────────────────────────────────────────────────────────────────────────


def test_a_grey_ball_shows_a_photos_mean_colour_from_everywhere():
    of = case("grey")
    shown = photos(of)
    found = grey(shown, materials_of(0)).new_view("leaf", 1, seen(0, 16, VIEW))
    mean = np.mean([v.mean(axis=0) for (_, li), v in shown.radiance.items() if li == 1], axis=0)
    assert found == pytest.approx(np.broadcast_to(mean, found.shape), rel=0.02)


def test_the_gauge_is_taken_out_and_nothing_else():
    truths, of = materials_of(0), lights(0)
    factor = np.array([0.5, 2.0, 1.5])
    materials, found = in_gauge(
        {n: times(m, factor) for n, m in truths.items()}, {li: v / factor for li, v in of.items()}, truths
    )
    assert factor_of(materials, truths) == pytest.approx(np.ones(3)) and np.allclose(found[0], of[0])


def scores(prediction):
    of = case("ours", side=2, size=12)
    world = World(materials_of(0), lights(0, 3))
    found = shots(of, world, prediction(world))
    return score_of(world, prediction(world), found, 1.0), found


def test_the_truth_in_any_gauge_scores_nothing_and_a_grey_ball_does():
    factor = np.array([0.5, 2.0, 1.5])

    def true(world):
        materials = {n: times(world.materials[n], factor) for n in ("brick", "leaf")}
        return Rendered(*in_gauge(materials, {li: world.lights[li] / factor for li in (0, 1)}, world.materials))

    score, found = scores(true)
    assert {shot.asked.kind for shot in found} == set(KINDS) and len({shot.asked.name for shot in found}) == len(
        found
    ) == 8 + 2 + 6
    measures = [kind + suffix for kind in KINDS for suffix in SUFFIXES.values()]
    assert (
        max(score.values[m] for m in measures) < 1e-6
        and score.values["mirror"] < 1e-6
        and score.values["roughness"] == 0
    )
    worse, _ = scores(lambda world: grey(photos(case("grey", side=2, size=12)), world.materials))
    assert min(worse.values[m] for m in measures) > 0.02 and "roughness" not in worse.values


def test_what_a_method_does_not_state_has_no_score():
    score, found = scores(lambda world: projective(photos(case("projective", side=2, size=12))))
    assert (
        not {"diffuse", "mirror", "novel_material"} & score.values.keys()
        and {"novel_view", "novel_light"} <= score.values.keys()
    )
    assert all(shot.asked.kind != "novel_material" for shot in found)


def test_a_sheet_has_a_cell_for_each_method_and_shot():
    black = np.zeros((96, 96, 3), np.uint8)
    shown = sheet([("truth", [black, black]), ("ours", [black, None])], ["a", "b"])
    assert shown.dtype == np.uint8 and (shown.reshape(-1, 3) == 0).all(axis=1).sum() >= 3 * 96 * 96
    small = sheet([("truth", [black[:32, :32]])], ["a"])
    assert (small.reshape(-1, 3) == 0).all(axis=1).sum() >= 96 * 96, "small pictures are enlarged"


def test_cases_differ_in_the_method_alone():
    from studies.catalogue.comparison import STUDY
    from studies.core.study import QUICK

    plain = [msgspec.structs.replace(c, method="ours") for c in STUDY.cases(QUICK).values()]
    assert len(plain) == 5 and all(c == plain[0] for c in plain)
