"""The fit_mesh stage from masks and poses to factors, and what align, urm and export make of them."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest

from factorlib.dataset.schema import ObjectsSlice
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import read_exr, write_exr
from factorlib.jsonfile import read_json, write_json
from factorlib.meshes import write_ply
from factorlib.meshes.mesh import scaled
from factorlib.results.poses import PhotoPoses, write_poses
from factorlib.stage import Inputs, silent
from stages import align, export, fit_mesh, urm
from tests.align.scenes import chair, photo_of

OFF = (1.0, 1.0, 1.13)  # the mesh that is had is taller than the chair
PHOTOS = ("a", "b", "c")


def made(tmp_path, given, source="found"):
    """Inputs of photos of a chair that are said to show the mesh `given`, where `align` found its middle; and the truth by photo."""
    masks, aligned = tmp_path / "masks", tmp_path / "align"
    masks.mkdir()
    aligned.mkdir()
    write_ply(tmp_path / "chair.ply", given)
    poses, truth = {}, {}
    for k, photo in enumerate(PHOTOS):
        caster, camera, pose = photo_of(chair(), 30 + k)
        label = rasterise(caster, camera, pose).label.astype(float)
        zero = np.zeros(label.shape)
        write_exr(
            masks / f"{photo}.exr",
            {"R": label, "G": label, "B": label, "label": label, "left_out": zero, "object": zero},
        )
        write_json(
            masks / f"{photo}.json",
            {
                "width": camera.width,
                "height": camera.height,
                "focal_px": camera.focal,
                "focal_source": "dataset",
                "factor": 1,
                "original_size": [camera.width, camera.height],
            },
        )
        obj = {
            "rotation": pose.rotation.tolist(), "translation": pose.translation.tolist(), "source": source, "silhouette_iou": 0.9,
            "runner_up": None, "left_out": False,
        }  # fmt: skip
        facts = {"focal_px": camera.focal, "focal_source": "dataset", "principal_point": list(camera.centre)}
        poses[photo] = {"camera": facts, "objects": {"chair": obj}}
        truth[photo] = caster, camera, pose
    write_poses(aligned / "poses.json", msgspec.convert(poses, dict[str, PhotoPoses]))
    slice_ = {
        "camera": {},
        "objects": [{"name": "chair", "mesh": "chair"}],
        "meshes": {"chair": {"file": "chair.ply", "material": "white"}},
    }
    facts = {"dataset.materials": ["white"], "dataset.objects": {photo: slice_ for photo in PHOTOS}}
    return Inputs({"masks": masks, "align": aligned}, facts, {"chair.ply": tmp_path / "chair.ply"}), truth


def run(tmp_path, inputs):
    out = tmp_path / "fit_mesh"
    out.mkdir()
    fit_mesh.main(fit_mesh.Params(), inputs, out, silent)
    return read_json(out / "meshes.json")["chair"], read_json(out / "poses.json")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fitted")
    inputs, truth = made(folder, scaled(chair(), OFF))
    return folder, inputs, truth, *run(folder, inputs)


def test_the_factors_undo_what_the_mesh_has_wrong(fitted):
    _, _, _, mesh, poses = fitted
    wanted = 1 / np.array(OFF)
    assert (
        mesh["used"]
        and np.allclose(mesh["factors"], wanted / wanted.prod() ** (1 / 3), rtol=0.03)
        and len(mesh["sightings"]) == 3
    )
    assert mesh["held_out_unexplained"]["fitted"] < 0.5 * mesh["held_out_unexplained"]["as_it_is"]
    assert all(poses[photo]["objects"]["chair"]["scale"] == mesh["factors"] for photo in PHOTOS)
    assert all(poses[photo]["objects"]["chair"]["silhouette_iou"] > 0.97 for photo in PHOTOS)


def test_align_uses_the_fitted_mesh(fitted):
    folder, inputs, truth, mesh, poses = fitted
    normals = {}
    for name, folders in (("with", {"poses": folder / "fit_mesh"}), ("without", {"poses": folder / "align"})):
        facts = {**inputs.facts, "dataset.objects": inputs.facts["dataset.objects"]["a"]}
        one = Inputs({**inputs.folders, **folders}, facts, inputs.files, "a")
        out = folder / name
        out.mkdir()
        align.main(align.Params(), one, out, silent)
        maps = read_exr(out / "a.exr")
        caster, camera, pose = truth["a"]
        true = rasterise(caster, camera, pose)
        both = (maps["label"] > 0) & (true.label > 0)
        normals[name] = np.sum(np.stack([maps[f"normal.{c}"] for c in "xyz"], -1)[both] * true.normal[both], axis=1)
    entry = json.loads((folder / "with" / "a.json").read_text())["objects"]["chair"]
    assert entry["scale"] == mesh["factors"] and entry["silhouette_iou"] > 0.97 and entry["doubts"] == []
    assert np.mean(normals["with"] > np.cos(0.03)) > np.mean(normals["without"] > np.cos(0.03))


def test_urm_and_export_place_the_fitted_mesh_alike(fitted, tmp_path):
    """Both put a vertex where x_cam = R (s ∘ x) + t does."""
    _, inputs, _, mesh, poses = fitted
    slice_ = msgspec.convert(inputs.facts["dataset.objects"]["a"], ObjectsSlice)
    pose = poses["a"]["objects"]["chair"]
    given = scaled(chair(), OFF)
    there = (given.vertices * mesh["factors"]) @ np.array(pose["rotation"]).T + pose["translation"]
    one = Inputs(
        inputs.folders, {**inputs.facts, "dataset.objects": inputs.facts["dataset.objects"]["a"]}, inputs.files, "a"
    )
    objects = msgspec.convert(poses["a"], PhotoPoses).objects
    occluders = urm.occluders_of(one, objects)
    assert np.allclose(occluders.centre, (there.min(0) + there.max(0)) / 2, atol=1e-4)
    (tmp_path / "meshes").mkdir()
    shape = export.MeshFiles(inputs, tmp_path, ["white"], 60.0).shapes(slice_.objects[0], slice_.meshes, objects)[0]
    placed = given.vertices @ shape.cam_from_object[:3, :3].T + shape.cam_from_object[:3, 3]
    assert np.allclose(placed, there, atol=1e-4)


def test_an_exact_mesh_and_given_poses_are_left_as_they_are(tmp_path):
    for name, mesh, source in (("exact", chair(), "found"), ("given", scaled(chair(), OFF), "given")):
        folder = tmp_path / name
        folder.mkdir()
        inputs, _ = made(folder, mesh, source)
        out = folder / "fit_mesh"
        out.mkdir()
        fit_mesh.main(fit_mesh.Params(), inputs, out, silent)
        assert read_json(out / "poses.json") == read_json(inputs["align"] / "poses.json")
        report = read_json(out / "meshes.json")
        assert report == {} if source == "given" else report["chair"]["factors"] == [1.0, 1.0, 1.0]
