"""What a case observes, of spheres and of objects, perturbed and mended; its scores; a chair that is left out."""

import json

import msgspec
import numpy as np
import pytest

from factorlib.conventions import FRONT
from factorlib.evaluate.ball import Light, constant_light
from factorlib.evaluate.gauge import connected_components
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.results.materials import Reflectance
from factorlib.solve import fit
from factorlib.solve.few_lobes import rounds
from factorlib.stage import Inputs, silent
from studies.errors import in_true_gauge, times
from studies.objects import BODIES, SIDE, body, observed, together
from studies.rounding import PERTURBED, perturbed
from studies.spheres import (  # fmt: skip
    face_normals,
    faceted,
    light_file,
    materials_of,
    mislabelled,
    observations_of,
    sphere_normals,
    table_of,
    tilted,
)
from studies.steps import chairs, leave_out, observe, score, solve
from studies.study import SEVEN, Case, Objects, World, full_matrix, light_name

LIGHTS = {li: constant_light(np.array([1.0, 0.8, 0.5]) * (1 + li)) for li in range(3)}
RNG = np.random.default_rng(0)


def tables(entries, seed=0, **how):
    return observations_of(Case(seed, tuple(entries), 10, **how), materials_of(seed), LIGHTS)


# ── spheres ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_entries_and_no_others_are_observed():
    pairs = {(p, t.materials[m]) for p, t in tables([(0, 0), (2, 0), (2, 1)]).items() for m in set(t.material.tolist())}
    assert pairs == {("light0", "brick"), ("light0", "lacquer"), ("light1", "lacquer")}


def test_an_entry_is_the_same_whatever_else_a_case_shows():
    small, large = tables([(1, 0)])["light0"], tables(full_matrix(3, 3))["light0"]
    assert np.array_equal(small.radiance, large.radiance[large.material == 1])
    other = observations_of(Case(1, ((1, 0),), 10), materials_of(0), LIGHTS)["light0"]  # its noise is of the seed
    assert not np.array_equal(small.radiance, other.radiance)
    assert small.radiance == pytest.approx(other.radiance, rel=0.1)


def test_a_perturbation_changes_what_is_told_and_not_what_is_shown():
    clean, wrong = (
        tables(full_matrix(2, 1), **how)["light0"] for how in ({}, {"normal_deg": 5.0, "wrong_labels": 0.2})
    )
    assert np.array_equal(clean.radiance, wrong.radiance) and not np.array_equal(clean.normal, wrong.normal)
    assert 0 < np.mean(clean.material != wrong.material) < 0.4


def test_normals_turn_and_labels_are_wrong_as_far_as_they_are_told():
    normals = np.tile(FRONT, (4000, 1))
    angle = np.degrees(np.arccos(np.clip(tilted(normals, 5.0, np.random.default_rng(0)) @ FRONT, -1, 1)))
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(5.0, rel=0.05)
    assert np.array_equal(tilted(normals, 0.0, np.random.default_rng(0)), normals)
    labels = mislabelled(10_000, 1, [0, 1, 2], 0.2, np.random.default_rng(0))
    assert np.mean(labels != 1) == pytest.approx(0.2, abs=0.02) and set(labels) == {0, 1, 2}
    assert set(mislabelled(100, 0, [0], 0.2, np.random.default_rng(0))) == {0}, "alone it can be called nothing else"


@pytest.mark.parametrize("faces", [1, 2, 9])
def test_an_object_shows_as_many_faces_as_are_asked_for(faces):
    normals = faceted(sphere_normals(24), faces)
    nearest = (normals @ face_normals(faces).T).argmax(axis=1)
    assert len(set(nearest.tolist())) == faces and (face_normals(faces)[:, 2] > 0).all()
    assert np.degrees(np.arccos((normals * face_normals(faces)[nearest]).sum(axis=1))).max() < 10


def test_rounding_moves_radiances_alone_and_as_far_as_it_says():
    table = tables([(0, 0), (1, 0)])["light0"]
    moved = perturbed(table, np.random.default_rng(0))
    share = moved.radiance / table.radiance - 1
    assert 0.5 * PERTURBED < share.std() < 2 * PERTURBED and np.abs(share).max() < 6 * PERTURBED
    assert all(
        getattr(moved, name) is getattr(table, name) for name in ("normal", "material", "photo", "view", "weight")
    )


# ── objects ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def photos(entries=((0, 0),), **how):
    case = Case(0, tuple(entries), 10, objects=Objects(SIDE * SIDE, **how))
    return observed(case, materials_of(0, SEVEN), LIGHTS)


def errors(**how):
    return np.array([each.normal_error_deg for photo in photos(full_matrix(1, 3), **how).values() for each in photo])


def test_objects_that_are_where_they_are_thought_to_be_have_true_normals():
    assert errors().max() < 1e-3
    table = together(photos([(0, 0), (2, 0)])["light0"])
    assert np.linalg.norm(table.normal, axis=1) == pytest.approx(1) and (table.normal @ FRONT > 0).all()
    assert set(table.material.tolist()) == {0, 1} and table.materials == ("brick", "lacquer")
    assert len({*zip(table.x.tolist(), table.y.tolist(), strict=True)}) == len(table), (
        "entries have pixels of their own"
    )


def test_normals_are_off_by_about_as_much_as_an_object_is_turned():
    """Pixels show other places of a curved surface then, too."""
    small, large = (errors(turned_deg=degrees) for degrees in (2.0, 20.0))
    assert (small > 0.5).all() and (small < 4.0).all() and (large > 3 * small).all() and (large < 40.0).all()
    assert (errors(triangles=100) > 0.5).all()
    assert all(len(body(n, 100).mesh.faces) < 250 < 10_000 < len(body(n).mesh.faces) for n in BODIES)


@pytest.mark.parametrize("how", [{"turned_deg": 5.0}, {"turned_deg": 20.0}, {"larger": 0.1}, {"shifted": 0.05}])
def test_wrong_poses_turn_normals_and_fitting_the_outline_mends_them(how):
    assert (errors(**how) > 0.5).all()
    assert np.median(errors(**how, refined=True)) < 0.4 * np.median(errors(**how))


def test_a_wrong_pose_changes_the_normals_and_not_what_a_pixel_shows():
    clean, wrong = (together(photos(turned_deg=degrees)["light0"]) for degrees in (0.0, 5.0))
    radiance = dict(zip(clean.x.tolist(), clean.radiance.tolist(), strict=True))
    shared = [k for k, pixel in enumerate(wrong.x.tolist()) if pixel in radiance]
    assert len(shared) > 1000 and all(wrong.radiance[k].tolist() == radiance[int(wrong.x[k])] for k in shared)


def test_the_solve_hears_how_sure_normals_are_or_not():
    sure, even = (together(photos(confidence=heard)["light0"]) for heard in (True, False))
    assert (even.confidence == 1).all() and (even.weight == 1).all()
    assert sure.confidence.min() < 0.5 and np.array_equal(sure.weight, sure.confidence)


def test_the_robust_loss_is_off_inside_and_back_after_an_error():
    before = rounds.LEAST_ROBUST_SCALE, fit.ROBUST
    with solve.robust_loss(True):
        assert (rounds.LEAST_ROBUST_SCALE, fit.ROBUST) == before
    with pytest.raises(ZeroDivisionError), solve.robust_loss(False):
        assert rounds.LEAST_ROBUST_SCALE == fit.ROBUST.robust_scale == solve.BEYOND_ALL
        raise ZeroDivisionError
    assert (rounds.LEAST_ROBUST_SCALE, fit.ROBUST) == before


def test_a_case_from_lights_to_scores_warm(tmp_path):
    """By its steps, without a runner: two photos, the second added to a solution of the first."""
    how = {"cells": 24, "splittings": 0, "observations": 100}
    case, world = (
        Case(0, ((0, 0), (0, 1)), 10, how, objects=Objects(60, start="earlier", robust=False)),
        World((0,), 3, 8, 1),
    )
    for name in ("worlds", "observe", "solve", "score"):
        (tmp_path / name).mkdir()
    for li in range(world.lights):
        radiance = RNG.uniform(0.5, 2, (8, 16, 3)).astype(np.float32)
        write_rgb_exr(tmp_path / "worlds" / light_file(0, li), radiance, LAT_LONG)
    facts = {"dataset.case": msgspec.to_builtins(case), "dataset.worlds": msgspec.to_builtins(world)}
    folders = {name: tmp_path / name for name in ("worlds", "observe", "solve")}
    for name, stage in {"observe": observe, "solve": solve, "score": score}.items():
        stage.main(stage.Params(), Inputs(folders, facts, photo="x"), tmp_path / name, silent)
    assert [file.name for file in (tmp_path / "observe/x/earlier").iterdir()] == ["light0.parquet"]
    earlier, whole = (json.loads((tmp_path / f"solve/x/{f}exposures.json").read_text()) for f in ("earlier/", ""))
    assert earlier.keys() == {"light0"} and whole.keys() == {"light0", "light1"}
    values = json.loads((tmp_path / "score/x.json").read_text())["values"]
    assert values["seconds"] > 0 and values["normals"] == pytest.approx(0, abs=1e-3) and 0 <= values["new_light"] < 0.5
    assert (tmp_path / "score/balls-x.png").stat().st_size and (tmp_path / "score/matrix-x.png").stat().st_size


# ── scores ───────────────────────────────────────────────────────────────────────────────────────────────────────────

CASES = [  # two components each; objects with the two materials that spheres do not have
    (Case(0, ((0, 0), (1, 0), (2, 1)), 10), materials_of(0)),
    (Case(0, ((5, 0), (6, 0), (2, 1)), 10, objects=Objects(10)), materials_of(0, SEVEN)),
]
ONES, FACTORS = np.ones((2, 3)), np.array([[0.5, 0.7, 0.9], [0.3, 0.9, 0.6]])


def spheres(case, truths, factors, roughness=0.0):
    """The truth, each component's materials times a factor per channel, its lights divided by it."""
    component = connected_components({light_name(li): case.names_in(li) for li in case.lights})
    table = {n: times(truths[n], factors[c]) for n, c in component.items()}
    table = {n: Reflectance(m.diffuse, m.specular, min(1.0, m.roughness + roughness)) for n, m in table.items()}
    factor = {li: factors[component[case.names_in(li)[0]]] for li in case.lights}
    lights = {li: Light(tuple(level / factor[li] for level in LIGHTS[li].levels)) for li in case.lights}
    return score.Spheres(case, in_true_gauge(case, table, lights, truths, component), truths, LIGHTS)


@pytest.mark.parametrize("case, truths", CASES)
def test_the_truth_in_any_gauge_scores_nothing(case, truths):
    found = spheres(case, truths, FACTORS).score()
    first = {"first_material"} if 0 in case.materials else set()
    assert max(found.values.values()) < 1e-6
    assert found.values.keys() == first | {
        "entries",
        "observed",
        "unobserved",
        "new_light",
        "new_material",
        "first_light",
    }
    constant = found.nulls.pop("new_material")  # these lights are constant, as its null's
    assert min(found.nulls.values()) > 1e-3 > constant


@pytest.mark.parametrize("case, truths", CASES)
def test_an_error_scores_the_same_in_any_gauge_and_pictures_show_it(case, truths):
    plain, scaled = (spheres(case, truths, factors, 0.2) for factors in (ONES, FACTORS))
    values = plain.score().values
    assert values == pytest.approx(scaled.score().values, rel=1e-3) and values["new_light"] > 1e-5
    true, found = (plain.matrix(of).astype(int) for of in (True, False))
    assert true.shape == found.shape == (3 * 70, 2 * 70, 3) and np.abs(true - found).max() > 5


def test_the_null_of_a_part_is_of_its_entries():
    nulls = spheres(Case(0, ((0, 0), (0, 1), (1, 1)), 10), materials_of(0), ONES).score().nulls
    assert nulls["entries"] == pytest.approx((3 * nulls["observed"] + nulls["unobserved"]) / 4)
    assert nulls["observed"] != pytest.approx(nulls["unobserved"], rel=0.01)


def test_chromaticity_is_free_of_the_factor_that_nothing_tells():
    colours = np.random.default_rng(0).lognormal(0, 0.4, (3, 3))
    of = lambda scale: score.chromaticity([constant_light(c) for c in scale * colours])  # noqa: E731
    assert of(1) > 0.1 and of(np.array([2.0, 0.3, 1.0])) == pytest.approx(of(1), rel=1e-5)
    assert of(np.array([[1], [5], [0.2]])) == pytest.approx(of(1), rel=1e-5)
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


def test_what_is_left_is_everything_but_the_shell():
    left = leave_out.without(photo(NAMES, (1, 1, 1)), "white")
    assert set(left.material.tolist()) == {0, 2} and len(left) == 20


def test_a_flat_colour_is_right_where_light_is_flat():
    """And needs nothing of the shell in the photo that is asked for."""
    of = {"a": photo(("red", "wood"), (1, 2, 3)), "b": photo(NAMES, (3, 1, 1)), "c": photo(("wood",), (0.5, 0.7, 2))}
    assert chairs.flat_colour(of, "c", "red", "wood") == pytest.approx(ALBEDO[0] * (0.5, 0.7, 2))


def test_a_chair_is_scored_against_the_photo_its_mean_colour_and_up_to_a_factor():
    mask = np.zeros((30, 40), bool)
    mask[5:25, 5:35] = True
    chair = chairs.Chair("p", RNG.uniform(0.1, 1.0, (30, 40, 3)), mask)
    tinted, flat = chair.truth * (0.5, 0.8, 1.1), np.broadcast_to(chair.truth[mask].mean(0), chair.truth.shape)
    same, scaled, guess = (chairs.score_of([chair], [image]) for image in (chair.truth, tinted, flat))
    assert same.values == {"chair": 0.0, "chair_scaled": 0.0}
    assert scaled.values["chair"] > 0.01 > 1e-6 > scaled.values["chair_scaled"]
    assert guess.values["chair"] == guess.nulls["chair"] > 0.05
    cut = chair.cut_out(chair.truth)
    assert (cut[0] == 255).all() and (cut[10, 10] < 255).any(), "white outside the shell"
    assert chairs.side_by_side([cut, cut[:20]]).shape == (len(cut), 2 * (cut.shape[1] + 8), 3)
