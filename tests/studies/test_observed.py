"""What a case sees: entries, perturbations, faces."""

import numpy as np
import pytest

from factorlib.conventions import FRONT
from factorlib.evaluate.ball import constant_light
from studies.catalogue.contents import STUDIES
from studies.catalogue.structure import PATTERNS, random
from studies.core.case import Case
from studies.core.measures import MEASURES
from studies.core.observed import face_normals, faceted, mislabelled, observations_of, tilted
from studies.core.study import FULL, QUICK, full_matrix
from studies.core.world import materials_of, sphere_normals

LIGHTS = {li: constant_light(np.ones(3)) for li in range(3)}


def seen(entries, seed=0, **how):
    return observations_of(Case(seed, tuple(entries), 10, **how), materials_of(seed), LIGHTS)


def test_the_entries_and_no_others_are_seen():
    found = seen([(0, 0), (2, 0), (2, 1)])
    pairs = {(photo, of.materials[m]) for photo, of in found.items() for m in set(of.material.tolist())}
    assert pairs == {("light0", "brick"), ("light0", "lacquer"), ("light1", "lacquer")}


def test_an_entry_is_the_same_whatever_else_a_case_shows():
    small, large = seen([(1, 0)])["light0"], seen(full_matrix(3, 3))["light0"]
    assert np.array_equal(small.radiance, large.radiance[large.material == 1])
    other = observations_of(Case(1, ((1, 0),), 10), materials_of(0), LIGHTS)[
        "light0"
    ]  # the same material: its noise is of the seed
    assert not np.array_equal(small.radiance, other.radiance) and small.radiance == pytest.approx(
        other.radiance, rel=0.1
    )


def test_harm_changes_what_is_told_and_not_what_is_seen():
    clean, perturbed = (
        seen(full_matrix(2, 1), **how)["light0"] for how in ({}, {"normal_deg": 5.0, "wrong_labels": 0.2})
    )
    assert np.array_equal(clean.radiance, perturbed.radiance)
    assert (
        not np.array_equal(clean.normal, perturbed.normal) and 0 < np.mean(clean.material != perturbed.material) < 0.4
    )


def test_normals_turn_as_far_as_they_are_told():
    normals = np.tile(FRONT, (4000, 1))
    turned = tilted(normals, 5.0, np.random.default_rng(0))
    angle = np.degrees(np.arccos(np.clip(turned @ FRONT, -1, 1)))
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(5.0, rel=0.05)
    assert np.array_equal(tilted(normals, 0.0, np.random.default_rng(0)), normals)


def test_labels_are_wrong_as_often_as_they_are_told_and_name_others():
    labels = mislabelled(10_000, 1, [0, 1, 2], 0.2, np.random.default_rng(0))
    assert np.mean(labels != 1) == pytest.approx(0.2, abs=0.02) and set(labels) == {0, 1, 2}
    assert set(mislabelled(100, 0, [0], 0.2, np.random.default_rng(0))) == {0}, (
        "alone in its photo it can be called nothing else"
    )


@pytest.mark.parametrize("faces", [1, 2, 9])
def test_an_object_shows_as_many_faces_as_are_asked_for(faces):
    normals = faceted(sphere_normals(24), faces)
    nearest = (normals @ face_normals(faces).T).argmax(axis=1)
    assert len(set(nearest.tolist())) == faces and (face_normals(faces)[:, 2] > 0).all()
    assert np.degrees(np.arccos((normals * face_normals(faces)[nearest]).sum(axis=1))).max() < 10


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("n", [3, 5])
def test_patterns_have_every_material_and_light(pattern, n):
    entries = PATTERNS[pattern](n, 0)
    assert {m for m, _ in entries} == {li for _, li in entries} == set(range(n)) and len(set(entries)) == len(entries)
    assert len(entries) == {"full": n * n, "loop": 2 * n, "diagonal": n}.get(pattern, 2 * n - 1)


def test_random_patterns_differ_between_seeds_and_not_between_runs():
    assert random(5, 0) == random(5, 0) != random(5, 1)
    for seed in range(50):
        assert {m for m, _ in random(5, seed)} == {li for _, li in random(5, seed)} == set(range(5))


@pytest.mark.parametrize("scale", [FULL, QUICK], ids=["full", "quick"])
@pytest.mark.parametrize("study", STUDIES.values(), ids=list(STUDIES))
def test_a_study_names_what_there_is(study, scale):
    names = [setting.name for setting in study.settings(scale)]
    assert len(set(names)) == len(names) and set(study.measures) <= MEASURES.keys()
    for claim in study.claims(scale):
        assert set(claim.settings) <= set(names) and claim.lower != claim.higher and claim.measure in MEASURES
    assert len(study.cases(scale)) == len(names) * len(study.seeds_of(scale))
    lights = [li for case in study.cases(scale).values() for li in getattr(case, "lights", [])]
    assert max(lights, default=0) < scale.largest + (study.kind == "objects"), "worlds have no such light"


def test_equal_names_are_equal_cases_in_all_studies():
    """So that what two studies share is solved once."""
    for scale in (FULL, QUICK):
        known = {}
        for study in STUDIES.values():
            for name, case in study.cases(scale).items():
                assert known.setdefault(name, case) == case
