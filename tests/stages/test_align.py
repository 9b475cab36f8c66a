"""The align stage from masks and dataset slices to its files."""

from __future__ import annotations

import json
import logging

import msgspec
import numpy as np
import pytest

from factorlib.align.search import Search
from factorlib.errors import InputError
from factorlib.geometry.camera import Pose, rotation_of_vector
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import read_exr, write_exr
from factorlib.jsonfile import write_json
from factorlib.meshes import write_ply
from factorlib.stage import Inputs, silent
from stages import align
from tests.align.scenes import blob, chair, photo_of

FACTS = {"width": 200, "height": 150, "factor": 1, "original_size": [200, 150]}
QUICK = Search(views=160, rolls=16, keep=(20, 8, 4, 2))


def step(
    tmp_path, mesh_in_photo, mesh_given, *, pose_given=False, focal=None, source=None, seed=8, edit=lambda label: label
):
    """Inputs of one photo of `mesh_in_photo` that is said to show `mesh_given`; and the truth."""
    caster, camera, pose = photo_of(mesh_in_photo, seed, width=200, height=150)
    label = edit(rasterise(caster, camera, pose).label.astype(float))
    masks = tmp_path / "masks"
    masks.mkdir()
    zero = np.zeros(label.shape)
    write_exr(masks / "a.exr", {"R": label, "G": label, "B": label, "label": label, "left_out": zero, "object": zero})
    write_json(masks / "a.json", {**FACTS, "focal_px": focal, "focal_source": source})
    write_ply(tmp_path / "chair.ply", mesh_given)
    obj = {"name": "chair", "mesh": "chair"}
    if pose_given:
        obj["pose"] = {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist()}
    facts = {
        "dataset.materials": ["white"],
        "dataset.objects": {
            "camera": {},
            "objects": [obj],
            "meshes": {"chair": {"file": "chair.ply", "material": "white"}},
        },
    }
    return Inputs({"masks": masks}, facts, {"chair.ply": tmp_path / "chair.ply"}, "a"), caster, camera, pose


def run(tmp_path, inputs, name="out", **params):
    out = tmp_path / name
    out.mkdir()
    align.main(align.Params(search=QUICK, **params), inputs, out, silent)
    return out, json.loads((out / "a.json").read_text())


def test_given_pose_and_focal_length_are_used_as_they_are(tmp_path):
    inputs, caster, camera, pose = step(tmp_path, chair(), chair(), pose_given=True, focal=300.0, source="dataset")
    out, entry = run(tmp_path, inputs)
    obj = entry["objects"]["chair"]
    assert obj["rotation"] == pose.rotation.tolist() and obj["translation"] == pose.translation.tolist()
    assert entry["camera"]["focal_px"] == 300.0 and entry["camera"]["principal_point"] == [100.0, 75.0]
    assert obj["source"] == "given" and obj["silhouette_iou"] > 0.99 and obj["label_agreement"] == 1
    maps, truth = read_exr(out / "a.exr"), rasterise(caster, camera, pose)
    both = (maps["label"] > 0) & (truth.label > 0)
    for k, axis in enumerate("xyz"):
        assert np.allclose(maps[f"normal.{axis}"][both], truth.normal[..., k][both], atol=1e-3)
        assert np.allclose(maps[f"view.{axis}"][both], truth.view[..., k][both], atol=1e-6)
    assert set(maps) >= {"depth", "label", "object", "confidence"} and (out / "a_overlay.png").stat().st_size > 0


def test_focal_length_of_a_given_pose_is_found(tmp_path):
    inputs, _, camera, _ = step(tmp_path, chair(), chair(), pose_given=True)
    entry = run(tmp_path, inputs)[1]
    assert (
        entry["camera"]["focal_px"] == pytest.approx(camera.focal, rel=0.01)
        and entry["camera"]["focal_source"] == "estimated"
    )


def test_found_from_nothing_and_the_same_bytes_twice(tmp_path):
    inputs, _, _, _ = step(tmp_path, chair(), chair())
    first, entry = run(tmp_path, inputs, "first")
    second, _ = run(tmp_path, inputs, "second")
    obj = entry["objects"]["chair"]
    assert obj["silhouette_iou"] > 0.97 and obj["doubts"] == [] and obj["source"] == "found"
    assert 0 <= obj["runner_up"]["score"] < obj["score"]
    for file in sorted(p.name for p in first.iterdir()):
        assert (first / file).read_bytes() == (second / file).read_bytes(), file


def test_exif_of_a_crop_is_found_out(tmp_path, caplog):
    inputs, _, camera, _ = step(tmp_path, chair(), chair(), focal=90.0, source="exif")
    with caplog.at_level(logging.WARNING, "factorlib.align"):
        entry = run(tmp_path, inputs)[1]
    assert "EXIF" in caplog.text and "camera.focal_px" in caplog.text
    assert entry["camera"]["focal_source"] == "estimated" and entry["camera"]["focal_px"] == pytest.approx(
        camera.focal, rel=0.2
    )


def test_a_wrong_mesh_is_doubted_and_left_out_and_stops_a_strict_run(tmp_path, caplog):
    inputs, _, _, _ = step(tmp_path, chair(), blob(), focal=300.0, source="dataset")
    with caplog.at_level(logging.WARNING, "factorlib.align"):
        out, entry = run(tmp_path, inputs)
    obj = entry["objects"]["chair"]
    assert (
        obj["doubts"]
        and obj["left_out"]
        and "keypoints or pose" in caplog.text
        and "left out of the solve" in caplog.text
    )
    maps = read_exr(out / "a.exr")
    assert (maps["label"] > 0).any() and not maps["confidence"].any()
    kept, entry = run(tmp_path, inputs, "kept", keep_doubtful=True)
    assert not entry["objects"]["chair"]["left_out"] and read_exr(kept / "a.exr")["confidence"].any()
    with pytest.raises(InputError, match="overlap"):
        run(tmp_path, inputs, "strict", strict=True)


def test_a_given_pose_is_doubted_but_never_left_out(tmp_path):
    inputs, _, _, _ = step(tmp_path, chair(), blob(), pose_given=True, focal=300.0, source="dataset")
    out, entry = run(tmp_path, inputs)
    obj = entry["objects"]["chair"]
    assert obj["doubts"] and not obj["left_out"] and read_exr(out / "a.exr")["confidence"].any()


def test_object_without_a_pixel_is_refused(tmp_path):
    inputs, _, _, _ = step(tmp_path, chair(), chair(), edit=lambda label: label * 0)
    with pytest.raises(InputError, match="no pixel of the mask shows object 'chair'"):
        run(tmp_path, inputs)


def earlier(tmp_path, inputs, pose, camera, runner_up=None, focal=300.0):
    """The inputs, with a folder that names the pose."""
    folder = tmp_path / "earlier"
    folder.mkdir()
    obj = {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist(), "runner_up": runner_up}
    write_json(
        folder / "poses.json",
        {
            "a": {
                "camera": {"focal_px": focal, "focal_source": "estimated", "principal_point": list(camera.centre)},
                "objects": {"chair": obj},
            }
        },
    )
    return msgspec.structs.replace(inputs, folders={**inputs.folders, "poses": folder})


def test_an_earlier_pose_and_focal_length_are_used_as_they_are(tmp_path):
    inputs, _, camera, pose = step(tmp_path, chair(), chair())
    entry = run(tmp_path, earlier(tmp_path, inputs, pose, camera))[1]
    obj = entry["objects"]["chair"]
    assert obj["rotation"] == pose.rotation.tolist() and obj["translation"] == pose.translation.tolist()
    assert entry["camera"]["focal_px"] == 300.0 and entry["camera"]["focal_source"] == "estimated"
    assert obj["source"] == "refined" and obj["score"] > 0.97 and obj["doubts"] == [] and obj["runner_up"] is None


def test_an_earlier_pose_is_judged_like_any_other(tmp_path):
    """A rival that nobody ruled out is still a doubt, and so is a pose that misses the mask."""
    inputs, _, camera, pose = step(tmp_path, chair(), chair())
    turned = rotation_of_vector(np.array([0.0, 2.0, 0.0])) @ pose.rotation
    rival = {
        "rotation": turned.tolist(),
        "translation": pose.translation.tolist(),
        "score": 1.0,
        "normal_difference_deg": 60.0,
    }
    obj = run(tmp_path, earlier(tmp_path, inputs, pose, camera, rival), "rival")[1]["objects"]["chair"]
    assert (
        obj["left_out"]
        and "another pose" in obj["doubts"][0]
        and np.allclose(obj["runner_up"]["rotation"], turned, atol=1e-9)
    )
    wrong = tmp_path / "wrong"
    wrong.mkdir()
    obj = run(wrong, earlier(wrong, inputs, Pose(turned, pose.translation), camera))[1]["objects"]["chair"]
    assert obj["left_out"] and obj["silhouette_iou"] < 0.9


def test_a_pose_that_the_dataset_gives_goes_before_an_earlier_one(tmp_path):
    inputs, _, camera, pose = step(tmp_path, chair(), chair(), pose_given=True, focal=300.0, source="dataset")
    entry = run(tmp_path, earlier(tmp_path, inputs, Pose(np.eye(3), pose.translation), camera))[1]
    assert entry["objects"]["chair"]["source"] == "given" and np.allclose(
        entry["objects"]["chair"]["rotation"], pose.rotation
    )


def in_a_file_twice_as_large(inputs, **camera):
    """The photo as `masks` averages one of 401 × 300 pixels down, with a camera in those pixels."""
    facts = {**FACTS, "factor": 2, "original_size": [401, 300], "focal_px": 300.0, "focal_source": "dataset"}
    write_json(inputs["masks"] / "a.json", facts)
    inputs.facts["dataset.objects"]["camera"] = camera
    return inputs


def test_the_middle_of_an_averaged_photo_is_that_of_its_file(tmp_path):
    inputs, _, _, _ = step(tmp_path, chair(), chair(), pose_given=True)
    camera = run(tmp_path, in_a_file_twice_as_large(inputs))[1]["camera"]
    assert camera["principal_point"] == [100.25, 75.0] and camera["focal_px"] == 300.0 and camera["factor"] == 2


def test_keypoints_and_principal_point_are_pixels_of_the_file(tmp_path):
    inputs, caster, camera, pose = step(tmp_path, chair(), chair())
    corners = np.array([[-0.5, -0.5, 0.05], [0.5, -0.5, 0.05], [0.5, 0.5, 0.05], [-0.45, 0.5, 1.0], [-0.45, -0.5, 1.0]])
    pixels = 2 * camera.project(pose.apply(corners))
    keypoints = [{"pixel": list(p), "point": list(q)} for p, q in zip(pixels.tolist(), corners.tolist())]
    inputs.facts["dataset.objects"]["objects"][0]["keypoints"] = keypoints
    entry = run(tmp_path, in_a_file_twice_as_large(inputs, principal_point=[200.0, 150.0]))[1]
    obj = entry["objects"]["chair"]
    assert (
        obj["source"] == "keypoints" and obj["doubts"] == [] and np.allclose(obj["rotation"], pose.rotation, atol=0.02)
    )
    assert entry["camera"]["principal_point"] == [100.0, 75.0]


def test_an_earlier_focal_length_of_another_factor_is_scaled(tmp_path):
    inputs, _, camera, pose = step(tmp_path, chair(), chair())
    with_poses = in_a_file_twice_as_large(
        earlier(tmp_path, inputs, pose, camera, focal=600.0)
    )  # of the file, before it was averaged
    entry = run(tmp_path, with_poses)[1]
    assert entry["camera"]["focal_px"] == 300.0 and entry["objects"]["chair"]["silhouette_iou"] > 0.97
