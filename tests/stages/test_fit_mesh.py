"""The fit_mesh stage from masks and poses to factors, and what align, urm and export make of them."""

import msgspec
import numpy as np
import pytest

from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.raster import rasterise
from factorlib.jsonfile import read_json, write_json
from factorlib.meshes.mesh import scaled
from factorlib.meshes.ply import write_ply
from factorlib.results.poses import PhotoPoses
from factorlib.stage import Inputs, silent
from stages import export, fit_mesh, urm
from tests.align.scenes import chair, photo_of
from tests.stages.made import chair_facts, entry_of, write_masks

OFF = (1.0, 1.0, 1.13)  # the mesh that is had is taller than the chair
PHOTOS = ("a", "b", "c")


def made(tmp_path, given, source="found"):
    """Inputs of photos of a chair that are said to show the mesh `given`, as `align` found it; and the truth."""
    masks, aligned = tmp_path / "masks", tmp_path / "align"
    masks.mkdir(parents=True)
    aligned.mkdir()
    write_ply(tmp_path / "chair.ply", given)
    poses, truth = {}, {}
    for k, photo in enumerate(PHOTOS):
        caster, camera, pose = truth[photo] = photo_of(chair(), 30 + k)
        write_masks(masks, photo, rasterise(caster, camera, pose).label.astype(float), camera.focal, "dataset")
        obj = entry_of(pose, source=source, silhouette_iou=0.9, runner_up=None, left_out=False)
        facts = {"focal_px": camera.focal, "focal_source": "dataset", "principal_point": list(camera.centre)}
        poses[photo] = {"camera": facts, "objects": {"chair": obj}}
    write_json(aligned / "poses.json", msgspec.convert(poses, dict[str, PhotoPoses]))
    facts = {"dataset.materials": ["white"], "dataset.objects": dict.fromkeys(PHOTOS, chair_facts())}
    return Inputs({"masks": masks, "align": aligned}, facts, {"chair.ply": tmp_path / "chair.ply"}), truth


def run(tmp_path, inputs):
    out = tmp_path / "fit_mesh"
    out.mkdir()
    fit_mesh.main(fit_mesh.Params(), inputs, out, silent)
    return read_json(out / "meshes.json"), read_json(out / "poses.json")


def of_photo(inputs, photo, **folders):
    facts = {**inputs.facts, "dataset.objects": inputs.facts["dataset.objects"][photo]}
    return Inputs({**inputs.folders, **folders}, facts, inputs.files, photo)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fitted")
    inputs, truth = made(folder, scaled(chair(), OFF))
    meshes, poses = run(folder, inputs)
    return folder, inputs, truth, meshes["chair"], poses


def test_the_factors_undo_what_the_mesh_has_wrong(fitted):
    _, _, _, mesh, poses = fitted
    wanted = 1 / np.array(OFF)
    assert mesh["used"] and len(mesh["sightings"]) == 3
    assert np.allclose(mesh["factors"], wanted / wanted.prod() ** (1 / 3), rtol=0.03)
    assert mesh["held_out_unexplained"]["fitted"] < 0.5 * mesh["held_out_unexplained"]["as_it_is"]
    for photo in PHOTOS:
        obj = poses[photo]["objects"]["chair"]
        assert obj["scale"] == mesh["factors"] and obj["silhouette_iou"] > 0.97


def test_urm_and_export_place_the_fitted_mesh_alike(fitted, tmp_path):
    """Both put a vertex where x_cam = R (s ∘ x) + t does."""
    _, inputs, _, mesh, poses = fitted
    pose, given = poses["a"]["objects"]["chair"], scaled(chair(), OFF)
    there = (given.vertices * mesh["factors"]) @ np.array(pose["rotation"]).T + pose["translation"]
    objects = msgspec.convert(poses["a"], PhotoPoses).objects
    occluders = urm.occluders_of(of_photo(inputs, "a"), objects)
    assert np.allclose(occluders.centre, (there.min(0) + there.max(0)) / 2, atol=1e-4)
    (tmp_path / "meshes").mkdir()
    slice_ = msgspec.convert(inputs.facts["dataset.objects"]["a"], ObjectsSlice)
    shape = export.MeshFiles(inputs, tmp_path, ["white"], 60.0, {}).shapes(slice_.objects[0], slice_.meshes, objects)[0]
    placed = given.vertices @ shape.cam_from_object[:3, :3].T + shape.cam_from_object[:3, 3]
    assert np.allclose(placed, there, atol=1e-4)


def test_given_poses_are_left_as_they_are(tmp_path):
    inputs, _ = made(tmp_path, scaled(chair(), OFF), "given")
    assert run(tmp_path, inputs) == ({}, read_json(inputs["align"] / "poses.json"))
