"""What a case observes, of spheres and of objects, perturbed and mended; its scores; a chair that is left out."""

import json

import msgspec
import numpy as np
import pytest

from factorlib.conventions import FRONT
from factorlib.evaluate.ball import constant_light
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.results.materials import MaterialTable, StandardErrors, solved
from factorlib.stage import Inputs, silent
from studies.objects import BODIES, SIDE, body, observed
from studies.spheres import (
    ROUNDING,
    face_normals,
    faceted,
    materials_of,
    mislabelled,
    observations_of,
    sphere_normals,
    table_of,
    tilted,
)
from studies.steps import chairs, score, solve
from studies.study import SEVEN, Case, Objects, World, full_matrix

LIGHTS = {li: constant_light(np.array([1.0, 0.8, 0.5]) * (1 + li)) for li in range(3)}
RNG = np.random.default_rng(0)


def tables(entries, seed=0, **how):
    return observations_of(Case(seed, tuple(entries), 10, **how), materials_of(0), LIGHTS)


# ── spheres ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_an_entry_is_the_same_whatever_else_a_case_shows_and_no_others_are_observed():
    pairs = {(p, t.materials[m]) for p, t in tables([(0, 0), (2, 0), (2, 1)]).items() for m in set(t.material.tolist())}
    assert pairs == {("light0", "brick"), ("light0", "lacquer"), ("light1", "lacquer")}
    small, large = tables([(1, 0)])["light0"], tables(full_matrix(3, 3))["light0"]
    assert np.array_equal(small.radiance, large.radiance[large.material == 1])
    other = tables([(1, 0)], seed=1)["light0"]  # its noise is of the seed
    assert not np.array_equal(small.radiance, other.radiance)
    assert small.radiance == pytest.approx(other.radiance, rel=0.1)


def test_a_perturbation_changes_what_is_told_and_not_what_is_shown():
    clean, wrong = (
        tables(full_matrix(2, 1), **how)["light0"] for how in ({}, {"normal_deg": 5.0, "wrong_labels": 0.2})
    )
    assert np.array_equal(clean.radiance, wrong.radiance) and not np.array_equal(clean.normal, wrong.normal)
    assert 0 < np.mean(clean.material != wrong.material) < 0.4
    rounded = tables(full_matrix(2, 1), rounding=1)["light0"]
    share = rounded.radiance / clean.radiance - 1
    assert 0.5 * ROUNDING < share.std() < 2 * ROUNDING and np.array_equal(rounded.normal, clean.normal)


def test_normals_turn_and_labels_are_wrong_as_far_as_they_are_told():
    normals = np.tile(FRONT, (4000, 1))
    angle = np.degrees(np.arccos(np.clip(tilted(normals, 5.0, np.random.default_rng(0)) @ FRONT, -1, 1)))
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(5.0, rel=0.05)
    labels = mislabelled(10_000, 1, [0, 1, 2], 0.2, np.random.default_rng(0))
    assert np.mean(labels != 1) == pytest.approx(0.2, abs=0.02) and set(labels) == {0, 1, 2}
    assert set(mislabelled(100, 0, [0], 0.2, np.random.default_rng(0))) == {0}, "alone it can be called nothing else"


@pytest.mark.parametrize("faces", [1, 9])
def test_an_object_shows_as_many_faces_as_are_asked_for(faces):
    normals = faceted(sphere_normals(24), faces)
    nearest = (normals @ face_normals(faces).T).argmax(axis=1)
    assert len(set(nearest.tolist())) == faces and (face_normals(faces)[:, 2] > 0).all()
    assert np.degrees(np.arccos((normals * face_normals(faces)[nearest]).sum(axis=1))).max() < 10


# ── objects ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def photos(entries=((0, 0), (0, 1)), **how):
    return observed(Case(0, tuple(entries), 10, objects=Objects(SIDE**2, **how)), materials_of(0, SEVEN), LIGHTS)


def test_objects_that_are_where_they_are_thought_to_be_have_true_normals():
    both, error = photos([(0, 0), (2, 0)])
    table = both["light0"]
    assert error < 1e-3 and set(table.material.tolist()) == {0, 1} and table.materials == ("brick", "lacquer")
    assert np.linalg.norm(table.normal, axis=1) == pytest.approx(1) and (table.normal @ FRONT > 0).all()
    assert len({*zip(table.x.tolist(), table.y.tolist(), strict=True)}) == len(table), "entries have their own pixels"
    even = photos([(0, 0)], confidence=False)[0]["light0"]
    assert (
        (even.confidence == 1).all() and table.confidence.min() < 0.5 and np.array_equal(table.weight, table.confidence)
    )


def test_normals_are_off_by_about_as_much_as_an_object_is_turned_and_pixels_show_what_they_did():
    (clean, _), (wrong, small), (_, large) = (photos(turned_deg=degrees) for degrees in (0.0, 2.0, 20.0))
    assert 0.5 < small < 4.0 and 3 * small < large < 40.0 and photos(triangles=100)[1] > 0.5
    assert all(len(body(n, 100).mesh.faces) < 250 < 10_000 < len(body(n).mesh.faces) for n in BODIES)
    radiance = dict(zip(clean["light0"].x.tolist(), clean["light0"].radiance.tolist(), strict=True))
    rows = zip(wrong["light0"].x.tolist(), wrong["light0"].radiance.tolist(), strict=True)
    shared = [of == radiance[pixel] for pixel, of in rows if pixel in radiance]
    assert len(shared) > 1000 and all(shared)


@pytest.mark.parametrize("how", [{"turned_deg": 5.0}, {"larger": 0.1}, {"shifted": 0.05}])
def test_fitting_the_outline_mends_wrong_poses(how):
    assert photos([(0, 0)], **how, refined=True)[1] < 0.4 * photos([(0, 0)], **how)[1]


def test_a_case_from_lights_to_scores_warm(tmp_path):
    """By its steps, without a runner: two photos, the second added to a solution of the first."""
    how = {"cells": 24, "splittings": 0, "observations": 100}
    case, world = Case(0, ((0, 0), (0, 1)), 10, how, objects=Objects(60, warm=True)), World((0,), 3, 8, 1)
    folders = {name: tmp_path / name for name in ("worlds", "solve", "score")}
    for folder in folders.values():
        folder.mkdir()
    for li in range(world.lights):
        write_rgb_exr(tmp_path / f"worlds/0-{li}.exr", RNG.uniform(0.5, 2, (8, 16, 3)).astype(np.float32), LAT_LONG)
    facts = {"dataset.case": msgspec.to_builtins(case), "dataset.worlds": msgspec.to_builtins(world)}
    for stage in (solve, score):
        name = stage.__name__.rpartition(".")[2]
        stage.main(stage.Params(), Inputs(folders, facts, photo="x"), folders[name], silent)
    values = json.loads((tmp_path / "score/x.json").read_text())["values"]
    assert values["seconds"] > 0 and values["normals"] == pytest.approx(0, abs=1e-3) and 0 <= values["new_light"] < 0.5
    assert (tmp_path / "score/x.png").stat().st_size


# ── scores ───────────────────────────────────────────────────────────────────────────────────────────────────────────

CASES = pytest.mark.parametrize(
    "case",
    [  # two components each; objects with the two materials that spheres do not have
        Case(0, ((0, 0), (1, 0), (2, 1)), 10),
        Case(0, ((5, 0), (6, 0), (2, 1)), 10, objects=Objects(10)),
    ],
)
MAPS = {li: np.broadcast_to(np.array([1.0, 0.8, 0.5]) * (1 + li), (16, 32, 3)) for li in range(3)}
ONES, FACTORS = np.ones((2, 3)), np.array([[0.5, 0.7, 0.9], [0.3, 0.9, 0.6]])


def scored(case, factors, roughness=0.0):
    """The truth, each component's materials times a factor per channel, its lights divided by it."""
    truths, of_light = materials_of(0, case.names), {0: factors[0], 1: factors[-1]}
    table = {}
    for m, li in case.entries:
        true, f = truths[case.names[m]], of_light[li]
        of = msgspec.structs.replace(
            true,
            diffuse=tuple(true.diffuse * f),
            specular=tuple(true.specular * f),
            roughness=true.roughness + roughness,
        )
        table[case.names[m]] = solved(of, StandardErrors((0.01,) * 3, (0.01,) * 3, 0.02))
    own = {li: MAPS[li] / of_light[li] for li in case.lights}
    return score.scored(case, truths, MAPS, MaterialTable(table).materials, own)


@CASES
def test_the_truth_in_any_gauge_scores_nothing(case):
    _, found = scored(case, FACTORS)
    parts = {"entries", "observed", "unobserved", "new_light", "new_material", "first_light"}
    parts |= {"first_material"} if 0 in case.materials else set()
    assert parts <= found.values.keys() and max(found.values[p] for p in (*parts, "diffuse", "mirror")) < 1e-5
    assert found.values["stated_roughness"] == pytest.approx(0.02) and "tint" not in found.values
    assert (
        min(found.nulls[p] for p in ("entries", "new_light")) > 1e-3
    )  # of constant lights, as these, all else is right


@CASES
def test_an_error_scores_the_same_in_any_gauge_and_pictures_show_it(case):
    (spheres, plain), (_, scaled) = (scored(case, factors, 0.2) for factors in (ONES, FACTORS))
    for part in ("entries", "unobserved", "new_light", "diffuse", "roughness"):
        assert plain.values[part] == pytest.approx(scaled.values[part], rel=1e-3, abs=1e-6)
    true, found = (spheres.matrix(of).astype(int) for of in (True, False))
    assert plain.values["new_light"] > 1e-5 and true.shape == found.shape and np.abs(true - found).max() > 5


def test_the_null_of_a_part_is_of_its_entries():
    _, of = scored(Case(0, ((0, 0), (0, 1), (1, 1)), 10), ONES)
    assert of.nulls["entries"] == pytest.approx((3 * of.nulls["observed"] + of.nulls["unobserved"]) / 4)


def test_chromaticity_is_free_of_the_factor_that_nothing_tells():
    colours = np.random.default_rng(0).lognormal(0, 0.4, (3, 3))
    of = lambda scale: score.chromaticity({k: np.full((8, 16, 3), c) for k, c in enumerate(scale * colours)})  # noqa: E731
    assert of(1) > 0.1 and of(np.array([2.0, 0.3, 1.0])) == pytest.approx(of(1), rel=1e-5)
    assert of(colours**-0.5) < of(1), "greyer"


# ── a chair that is left out ─────────────────────────────────────────────────────────────────────────────────────────

NAMES = ("red", "white", "wood")
ALBEDO = np.array([(0.5, 0.1, 0.1), (0.8, 0.8, 0.7), (0.4, 0.3, 0.2)])


def photo(names, light):
    """Ten pixels a material, flat in a light of one colour."""
    material = np.repeat([NAMES.index(name) for name in names], 10)
    normal = np.tile([0.0, 0.0, -1.0], (len(material), 1))
    table = table_of(Case(0, ((0, 0), (1, 0), (2, 0)), 10), 0, normal, ALBEDO[material] * np.array(light), material)
    return msgspec.structs.replace(table, materials=NAMES)


def test_a_flat_colour_is_right_where_light_is_flat_and_needs_nothing_of_the_shell():
    of = {"a": photo(("red", "wood"), (1, 2, 3)), "b": photo(NAMES, (3, 1, 1)), "c": photo(("wood",), (0.5, 0.7, 2))}
    assert chairs.flat_colour(of, "c", "red", "wood") == pytest.approx(ALBEDO[0] * (0.5, 0.7, 2))
    left = chairs.without(of["b"], "white")
    assert set(left.material.tolist()) == {0, 2} and len(left) == 20


def test_a_chair_is_scored_against_the_photo_its_mean_colour_and_up_to_a_factor():
    mask = np.zeros((30, 40), bool)
    mask[5:25, 5:35] = True
    chair = chairs.Chair(RNG.uniform(0.1, 1.0, (30, 40, 3)), mask)
    tinted, flat = chair.truth * (0.5, 0.8, 1.1), np.broadcast_to(chair.truth[mask].mean(0), chair.truth.shape)
    same, scaled, guess = (chairs.score_of([chair], [image]) for image in (chair.truth, tinted, flat))
    assert same.values == {"chair": 0.0, "chair_scaled": 0.0}
    assert scaled.values["chair"] > 0.01 > 1e-6 > scaled.values["chair_scaled"]
    assert guess.values["chair"] == guess.nulls["chair"] > 0.05
    pair = chair.beside(chair.truth)
    assert (pair[0] == 255).all() and np.array_equal(*np.split(pair, 2)), "white outside the shell"
