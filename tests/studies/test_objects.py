"""What a case of objects sees, perturbed and mended; its scores; a solve that starts from an earlier one."""

import json

import msgspec
import numpy as np
import pytest

from factorlib.conventions import FRONT
from factorlib.evaluate.ball import constant_light
from factorlib.evaluate.gauge import connected_components
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.solve import fit
from factorlib.solve.few_lobes import rounds
from factorlib.stage import Inputs, silent
from studies.catalogue.paper_sets import docksta, unlinked
from studies.core.case import World, light_name
from studies.core.objects.case import ObjectsCase, Perturbation
from studies.core.objects.observed import observations_of, together
from studies.core.objects.treatment import BEYOND_ALL, robust_loss
from studies.core.objects.world import BODIES, SIDE, body, materials_of, with_one_light_more
from studies.core.study import full_matrix
from studies.steps.objects import observe, score, solve
from studies.steps.spheres.worlds import light_file

ALL = SIDE * SIDE
LIGHTS = {li: constant_light(np.array([1.0, 0.8, 0.5]) * (1 + li)) for li in range(3)}
TRUTHS = materials_of(0)


def seen(perturbation=Perturbation(), entries=((0, 0),), pixels=ALL, **how):
    case = ObjectsCase(0, tuple(entries), pixels, perturbation, **how)
    return observations_of(case, TRUTHS, LIGHTS)


def errors(*of, **how):
    return np.array(
        [each.normal_error_deg for photo in seen(*of, entries=full_matrix(1, 3), **how).values() for each in photo]
    )


def test_objects_that_are_where_they_are_thought_to_be_have_true_normals():
    assert errors().max() < 1e-3
    found = together(seen(entries=[(0, 0), (2, 0)])["light0"])
    assert np.linalg.norm(found.normal, axis=1) == pytest.approx(1) and (found.normal @ FRONT > 0).all()
    assert set(found.material.tolist()) == {0, 1} and found.materials == ("brick", "lacquer")
    assert len({*zip(found.x.tolist(), found.y.tolist(), strict=True)}) == len(found), (
        "two entries have a pixel each of one number"
    )


def test_the_further_an_object_is_turned_the_more_its_normals_are_off():
    """By about as much: pixels show other places of a curved surface then, too."""
    small, large = (errors(Perturbation(turned_deg=degrees)) for degrees in (2.0, 20.0))
    assert (small > 0.5).all() and (small < 4.0).all()
    assert (large > 3 * small).all() and (large < 40.0).all()


@pytest.mark.parametrize(
    "perturbation", [Perturbation(shifted=0.05), Perturbation(larger=0.1), Perturbation(triangles=100)]
)
def test_other_perturbations_turn_normals_too(perturbation):
    assert (errors(perturbation) > 0.5).all()


def test_harm_changes_the_normals_and_not_what_a_pixel_shows():
    clean, perturbed = (
        together(seen(perturbation)["light0"]) for perturbation in (Perturbation(), Perturbation(turned_deg=5.0))
    )
    radiance = dict(zip(clean.x.tolist(), clean.radiance.tolist(), strict=True))
    shared = [k for k, pixel in enumerate(perturbed.x.tolist()) if pixel in radiance]
    assert len(shared) > 1000
    assert all(perturbed.radiance[k].tolist() == radiance[int(perturbed.x[k])] for k in shared)


@pytest.mark.parametrize("what", [{"turned_deg": 5.0}, {"turned_deg": 20.0}, {"larger": 0.1}, {"shifted": 0.05}])
def test_fitting_the_outline_mends_the_pose(what):
    perturbation = Perturbation(**what)
    assert np.median(errors(perturbation, refined=True)) < 0.4 * np.median(errors(perturbation))


def test_the_solve_hears_how_sure_normals_are_or_not():
    sure, even = (together(seen(confidence=heard)["light0"]) for heard in (True, False))
    assert (even.confidence == 1).all() and (even.weight == 1).all()
    assert sure.confidence.min() < 0.5 and np.array_equal(sure.weight, sure.confidence)


def test_a_mesh_of_few_triangles_has_few():
    for name in BODIES:
        assert len(body(name, 100).mesh.faces) < 250 < 10_000 < len(body(name).mesh.faces)


def test_the_robust_loss_is_off_inside_and_back_after_an_error():
    before = rounds.LEAST_ROBUST_SCALE, fit.ROBUST
    with robust_loss(True):
        assert (rounds.LEAST_ROBUST_SCALE, fit.ROBUST) == before
    with pytest.raises(ZeroDivisionError), robust_loss(False):
        assert rounds.LEAST_ROBUST_SCALE == fit.ROBUST.robust_scale == BEYOND_ALL
        raise ZeroDivisionError
    assert (rounds.LEAST_ROBUST_SCALE, fit.ROBUST) == before


def test_docksta_is_linked_by_one_material():
    assert (
        len(docksta(6)) == 12
        and {m for m, _ in docksta(6)} == set(range(7))
        and {li for _, li in docksta(6)} == set(range(6))
    )
    for entries, parts in ((docksta(6), 1), (unlinked(6), 6)):
        case = ObjectsCase(0, tuple(entries), 10)
        component = connected_components({light_name(li): case.names_in(li) for li in case.lights})
        assert len(set(component.values())) == parts


SOLVE = {"cells": 24, "splittings": 0, "observations": 100}


def test_a_case_from_lights_to_scores_warm(tmp_path):
    """By its steps, without a runner: two photos, the second added to a solution of the first."""
    case, world = ObjectsCase(0, ((0, 0), (0, 1)), 60, start="earlier", robust=False, solve=SOLVE), World((0,), 2, 8, 1)
    rng = np.random.default_rng(0)
    for name in ("worlds", "observe", "solve", "score"):
        (tmp_path / name).mkdir()
    for li in range(with_one_light_more(world).lights):
        write_rgb_exr(
            tmp_path / "worlds" / light_file(0, li), rng.uniform(0.5, 2, (8, 16, 3)).astype(np.float32), LAT_LONG
        )
    facts = {"dataset.case": msgspec.to_builtins(case), "dataset.worlds": msgspec.to_builtins(world)}
    folders = {name: tmp_path / name for name in ("worlds", "observe", "solve")}
    for stage in (observe, solve, score):
        stage.main(
            stage.Params(), Inputs(folders, facts, photo="x"), tmp_path / stage.__name__.rpartition(".")[2], silent
        )
    assert [file.name for file in sorted((tmp_path / "observe/x/earlier").iterdir())] == ["light0.parquet"]
    earlier, whole = (
        json.loads((tmp_path / "solve/x" / file).read_text()) for file in ("earlier/exposures.json", "exposures.json")
    )
    assert earlier.keys() == {"light0"} and whole.keys() == {"light0", "light1"}
    found = json.loads((tmp_path / "score/x.json").read_text())["values"]
    assert found["seconds"] > 0 and found["normals"] == pytest.approx(0, abs=1e-3) and 0 <= found["new_light"] < 0.5
    assert (tmp_path / "score/balls-x.png").stat().st_size and (tmp_path / "score/matrix-x.png").stat().st_size
