"""The benchmark's set is what it says, and its tables have their place; what it measures is not repeated here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.align import cases, real, shapes
from benchmarks.align.measure import normal_error_deg
from benchmarks.align.tables import as_tables, real_tables
from benchmarks.markdown import refresh
from factorlib.align.coarse import toward
from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError
from factorlib.geometry.camera import Pose, angle_between, rotation_of_vector
from factorlib.geometry.raster import rasterise
from factorlib.jsonfile import write_json
from factorlib.meshes.read import read_mesh

DOCS = Path(__file__).resolve().parents[2] / "docs" / "align.md"


@pytest.mark.parametrize("shape", shapes.SHAPES)
def test_shapes_are_of_the_size_said_and_rough_ones_near_them(shape):
    fine, rough = shapes.mesh(shape), shapes.rough(shape, 0)
    extent = np.ptp(fine.vertices, axis=0).max()
    assert 15_000 < len(fine.faces) < 25_000 and len(rough.faces) <= 520 and rough.labels == fine.labels
    far = cKDTree(fine.vertices).query(rough.vertices)[0].max() / extent
    assert 0.003 < far < 1.3 * shapes.WARP


@pytest.mark.parametrize("kind", cases.RIGHT + cases.WRONG)
def test_a_case_is_the_same_twice_and_cut_by_no_frame(kind):
    first, again = (cases.case(kind, "jug", 3, 1) for _ in range(2))
    assert np.array_equal(first.label, again.label) and np.array_equal(first.pose.rotation, again.pose.rotation)
    assert first.label.any() and not (
        first.label[0].any() or first.label[-1].any() or first.label[:, 0].any() or first.label[:, -1].any()
    )
    assert not np.array_equal(first.pose.rotation, cases.case(kind, "jug", 4, 1).pose.rotation)


def test_each_wrong_kind_is_wrong_in_the_way_it_is_named_for():
    wrong = {kind: cases.case(kind, "chair", 0, 0) for kind in cases.WRONG}
    assert wrong["wrong mesh"].given != "chair"
    assert np.array_equal(wrong["mirrored mask"].label[:, ::-1], wrong["mirrored mask"].truth().label)
    assert 5 <= np.count_nonzero(wrong["tiny mask"].label) <= 40
    blot, truth = wrong["wrong mask"].label > 0, wrong["wrong mask"].truth().label > 0
    assert np.count_nonzero(blot & truth) < 0.8 * np.count_nonzero(blot | truth)


def test_the_error_of_the_truth_is_zero_and_of_nothing_is_180():
    case = cases.case("exact", "hook", 0, 0)
    away = type(case.pose)(case.pose.rotation, case.pose.translation + np.array([100.0, 0, 0]))
    assert normal_error_deg(case.truth(), case.truth()) < 1e-5
    assert normal_error_deg(case.truth(), rasterise(case.given_mesh(), case.camera, away)) == 180


def test_the_set_is_a_dataset_that_is_read_with_its_truth(tmp_path):
    made = [cases.case(kind, "chair", 0, 0) for kind in ("exact", "rough", "mirrored mask")]
    cases.write_set(tmp_path / "set", made)
    dataset = read_dataset(tmp_path / "set")
    assert [photo.name for photo in dataset.spec.photos] == [case.name for case in made]
    assert set(dataset.truth.poses) == {case.name for case in made if case.kind in cases.RIGHT}
    entry = dataset.spec.meshes["chair"]
    mesh = read_mesh(dataset.folder / entry.file, dataset.spec.materials, entry.made_of)
    assert mesh.labels == (1, 2) and np.isclose(mesh.radius, shapes.mesh("chair").radius, rtol=1e-3)


def test_tables_have_their_place(tmp_path):
    right = {
        "wall_s": 1.0,
        "processor_s": 1.0,
        "memory_mb": 5,
        "normal_error_deg": 0.5,
        "of_the_mesh_deg": 0.1,
        "right": True,
        "doubts": [],
    }
    rows = [right | {"kind": kind, "shape": shape} for kind in cases.RIGHT for shape in shapes.SHAPES]
    rows += [right | {"kind": kind, "shape": "jug", "doubts": ["so"]} for kind in cases.WRONG]
    tables = as_tables(rows)
    assert "| exact, all | 5 of 5 |" in tables["success"] and "| all | 4 of 4 |" in tables["flags"]
    page = tmp_path / "align.md"
    page.write_text(DOCS.read_text(encoding="utf-8"), encoding="utf-8")
    refresh(page, tables)
    assert all(inner in page.read_text(encoding="utf-8") for inner in tables.values())


# ---- real photographs: a rendered one stands in for them --------------------------------------------------------


def test_a_turn_of_the_ray_to_the_object_is_no_error_of_the_pose():
    """The camera looks straight at the object, and past it: what it sees of the object is the same."""
    rotation, centre = rotation_of_vector(np.array([0.4, -0.9, 0.3])), np.array([0.2, -0.1, 0.5])
    straight = Pose(rotation, np.array([0.0, 0.0, 5.0]) - rotation @ centre)
    ray = toward(np.array([0.2, -0.35]))
    past = Pose(ray @ straight.rotation, ray @ straight.translation)
    assert angle_between(straight.rotation, past.rotation) > 15
    assert np.allclose(real.about_the_ray(past, centre), real.about_the_ray(straight, centre))


def test_a_common_turn_is_taken_off_and_nothing_else():
    turn, apart = np.array([0.05, 0.02, -0.1]), np.array([0.0, 0.01, 0.0])
    angle, left = real.common_turn([turn.tolist()] * 3)
    assert angle == pytest.approx(np.rad2deg(np.linalg.norm(turn))) and np.allclose(left, 0, atol=1e-5)
    assert real.common_turn([apart.tolist(), (-apart).tolist()])[1] == pytest.approx([np.rad2deg(0.01)] * 2)


def real_set(folder):
    """A photo of a known pose, which dataset.yaml gives away; and the reference beside it, its focal length a tenth too long."""
    made = cases.case("exact", "stack", 0, 0)
    cases.write_set(folder, [made])
    pose = {"rotation": made.pose.rotation.tolist(), "translation": made.pose.translation.tolist()}
    text = (folder / "dataset.yaml").read_text(encoding="utf-8")
    (folder / "dataset.yaml").write_text(
        text.replace("mesh: stack", f"mesh: stack\n    pose: {pose}"), encoding="utf-8"
    )
    camera = {"focal_px": 1.1 * made.camera.focal, "principal_point": list(made.camera.centre)}
    write_json(
        folder / "reference_poses.json",
        {made.name: {"camera": camera, "objects": {"object": pose}, "silhouette_iou": 0.9}},
    )
    return made


def test_a_real_photo_is_aligned_with_its_cameras_withheld(tmp_path):
    made = real_set(tmp_path / "set")
    dataset = read_dataset(tmp_path / "set")
    assert dataset.photo(made.name).objects[0].pose and not real.withheld(dataset).photo(made.name).objects[0].pose
    assert list(real.real_keys([tmp_path / "set"])) == [(tmp_path / "set", made.name)]
    (row,) = real.measured_photo((tmp_path / "set", made.name))
    assert 0 < row["rotation_error_deg"] < 0.5 and row["focal_source"] == "estimated" and row["silhouette_iou"] > 0.98
    assert row["focal_ratio"] == pytest.approx(1 / 1.1, rel=0.02) and row["doubts"] == []
    tables = real_tables([row])
    assert "| set object | 1 |" in tables["real-sets"] and f"| set, {made.name} |" in tables["real-photos"]
    page = tmp_path / "align.md"
    page.write_text(DOCS.read_text(encoding="utf-8"), encoding="utf-8")
    refresh(page, tables)


def test_a_folder_without_reference_poses_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"there is no reference_poses\.json"):
        list(real.real_keys([tmp_path]))
