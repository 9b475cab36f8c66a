"""The stage `align` from masks and dataset slices to its files, also where cameras are known beforehand."""

import json
import warnings

import msgspec
import numpy as np
import pytest

from factorlib.align.input_checks import check_before_camera
from factorlib.align.search import SearchOptions
from factorlib.dataset.read_dataset import read_dataset
from factorlib.dataset.schema import ObjectsSlice
from factorlib.generate.folder import write_labels, write_photo
from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import Caster, rasterise
from factorlib.images.exr import read_exr
from factorlib.jsonfile import read_json, write_json
from factorlib.meshes.ply_stl_off import write_ply
from factorlib.scenes.stage_runs import run_stages
from factorlib.stage import Inputs
from stages import align, masks
from tests.align.scenes import blob, chair, photo_of
from tests.refusal import refusal
from tests.stages.made import Rising, chair_facts, entry_of, ran, write_masks

QUICK = SearchOptions(views=160, rolls=16, keep=(20, 8, 4, 2))
KNOWN = {"pose_given": True, "focal": 300.0, "source": "dataset"}


def step(tmp_path, mesh_in_photo, mesh_given, *, pose_given=False, focal=None, source=None, edit=lambda label: label):
    """Inputs of one photo of `mesh_in_photo` that is said to show `mesh_given`; and the truth."""
    caster, camera, pose = photo_of(mesh_in_photo, 8, width=200, height=150)
    masks = tmp_path / "masks"
    masks.mkdir()
    write_masks(masks, "a", edit(rasterise(caster, camera, pose).label.astype(float)), focal, source)
    write_ply(tmp_path / "chair.ply", mesh_given)
    objects = chair_facts(**({"pose": entry_of(pose)} if pose_given else {}))
    facts = {"dataset.materials": ["white"], "dataset.objects": objects}
    return Inputs({"masks": masks}, facts, {"chair.ply": tmp_path / "chair.ply"}, "a"), caster, camera, pose


def run(tmp_path, inputs, name="out", **params):
    out = ran(align, inputs, tmp_path / name, progress := Rising(), search=QUICK, **params)
    assert progress.moves >= 1
    return out, json.loads((out / "a.json").read_text())


def is_at(obj, pose):
    return obj["rotation"] == pose.rotation.tolist() and obj["translation"] == pose.translation.tolist()


def test_given_pose_and_focal_length_are_used_as_they_are(tmp_path):
    inputs, caster, camera, pose = step(tmp_path, chair(), chair(), **KNOWN)
    out, entry = run(tmp_path, inputs)
    obj = entry["objects"]["chair"]
    assert is_at(obj, pose) and obj["source"] == "given" and obj["silhouette_iou"] > 0.99
    assert obj["label_agreement"] == 1
    assert entry["camera"]["focal_px"] == 300.0 and entry["camera"]["principal_point"] == [100.0, 75.0]
    maps, truth = read_exr(out / "a.exr"), rasterise(caster, camera, pose)
    both = (maps["label"] > 0) & (truth.label > 0)
    for k, axis in enumerate("xyz"):
        assert np.allclose(maps[f"normal.{axis}"][both], truth.normal[..., k][both], atol=1e-3)
        assert np.allclose(maps[f"view.{axis}"][both], truth.view[..., k][both], atol=1e-6)
    assert set(maps) >= {"depth", "label", "object", "confidence"} and (out / "a_overlay.png").stat().st_size > 0


def test_a_pose_is_found_from_nothing_and_the_same_bytes_twice(tmp_path):
    inputs, _, _, _ = step(tmp_path, chair(), chair())
    (first, entry), (second, _) = (run(tmp_path, inputs, name) for name in ("first", "second"))
    obj = entry["objects"]["chair"]
    assert obj["silhouette_iou"] > 0.97 and obj["doubts"] == [] and obj["source"] == "found"
    assert 0 <= obj["runner_up"]["score"] < obj["score"]
    for file in sorted(p.name for p in first.iterdir()):
        assert (first / file).read_bytes() == (second / file).read_bytes(), file


def test_exif_of_a_crop_is_found_out(tmp_path, caplog):
    inputs, _, camera, _ = step(tmp_path, chair(), chair(), focal=90.0, source="exif")
    entry = run(tmp_path, inputs)[1]["camera"]
    assert "EXIF" in caplog.text and "camera.focal_px" in caplog.text
    assert entry["focal_source"] == "estimated" and entry["focal_px"] == pytest.approx(camera.focal, rel=0.2)


def test_a_wrong_mesh_is_doubted_and_left_out(tmp_path, caplog):
    inputs, _, _, _ = step(tmp_path, chair(), blob(), focal=300.0, source="dataset")
    out, entry = run(tmp_path, inputs)
    assert entry["objects"]["chair"]["doubts"] and entry["objects"]["chair"]["left_out"]
    assert "keypoints or pose" in caplog.text and "left out of the solve" in caplog.text
    maps = read_exr(out / "a.exr")
    assert (maps["label"] > 0).any() and not maps["confidence"].any()
    kept, entry = run(tmp_path, inputs, "kept", keep_doubtful=True)
    assert not entry["objects"]["chair"]["left_out"] and read_exr(kept / "a.exr")["confidence"].any()


def test_object_without_a_pixel_is_refused(tmp_path):
    inputs, _, _, _ = step(tmp_path, chair(), chair(), edit=lambda label: label * 0)
    refusal("no pixel of the mask shows object 'chair'", run, tmp_path, inputs)


# ── given poses and cameras that contradict the photo ────────────────────────────────────────────────────────────────


def moved(tmp_path, translation, **known):
    inputs, *_ = step(tmp_path, blob(), blob(), **KNOWN | known)
    inputs.facts["dataset.objects"]["objects"][0]["pose"]["translation"] = list(translation)
    return inputs


@pytest.mark.parametrize("z, known", [(-5.0, {}), (-1e6, {"focal": None, "source": None}), (-0.2, {})])
def test_a_pose_behind_the_camera_is_refused_without_raw_warnings(tmp_path, z, known):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        caught = refusal("is behind the camera", run, tmp_path, moved(tmp_path, (0.0, 0.0, z), **known))
    assert caught.key == "photos[a].objects[chair].pose" and "OpenGL" in caught.cure
    caught = refusal(
        ".", check_before_camera, blob(), Pose(np.eye(3), np.array([0, 0, -9.0])), "hall", "vase", "colmap"
    )
    assert caught.key == "cameras.colmap: hall: vase"


# ── photos that were averaged down ────────────────────────────────────────────────────────────────


def in_a_file_twice_as_large(inputs, **camera):
    """The photo as `masks` averages one of 401 × 300 pixels down, with a camera in those pixels."""
    file = inputs["masks"] / "a.json"
    facts = {"factor": 2, "original_size": [401, 300], "focal_px": 300.0, "focal_source": "dataset"}
    write_json(file, {**read_json(file), **facts})
    inputs.facts["dataset.objects"]["camera"] = camera
    return inputs


def test_the_middle_of_an_averaged_photo_are_those_of_its_file(tmp_path):
    inputs, _, camera, pose = step(tmp_path, chair(), chair(), pose_given=True)
    entry = run(tmp_path, in_a_file_twice_as_large(inputs))[1]["camera"]
    assert entry["principal_point"] == [100.25, 75.0] and entry["focal_px"] == 300.0 and entry["factor"] == 2


def test_keypoints_and_principal_point_are_pixels_of_the_file(tmp_path):
    inputs, _, camera, pose = step(tmp_path, chair(), chair())
    corners = np.array([[-0.5, -0.5, 0.05], [0.5, -0.5, 0.05], [0.5, 0.5, 0.05], [-0.45, 0.5, 1.0], [-0.45, -0.5, 1.0]])
    pixels = 2 * camera.project(pose.apply(corners))
    keypoints = [{"pixel": p, "point": q} for p, q in zip(pixels.tolist(), corners.tolist())]
    inputs.facts["dataset.objects"]["objects"][0]["keypoints"] = keypoints
    entry = run(tmp_path, in_a_file_twice_as_large(inputs, principal_point=[200.0, 150.0]))[1]
    obj = entry["objects"]["chair"]
    assert obj["source"] == "keypoints" and obj["doubts"] == []
    assert np.allclose(obj["rotation"], pose.rotation, atol=0.02)
    assert entry["camera"]["principal_point"] == [100.0, 75.0]


def test_keypoints_are_pixels_of_the_photo_before_its_lens_was_undone(tmp_path):
    inputs = step(tmp_path, chair(), chair())[0]
    known = {"focal_px": 600.0, "principal_point": [200.5, 150.0], "distortion": [0.3, 0.0]}
    slice_ = inputs.facts["dataset.objects"]
    slice_["objects"][0]["keypoints"] = [
        {"pixel": [x, 2 * x], "point": [x, 0.0, 1.0]} for x in (10.0, 60.0, 80.0, 140.0)
    ]
    channels, result = read_exr(inputs["masks"] / "a.exr"), []
    for camera in (known, known | {"distortion": None}):
        given = msgspec.convert({**slice_, "camera": camera}, ObjectsSlice)
        result.append(align.read_objects(given, channels, inputs, align.Params(), 2)[0].keypoints.pixel)
    bent = (result[1] - [100.25, 75.0]) / 300
    assert np.abs(result[1] - result[0]).max() > 1
    straight = (result[0] - [100.25, 75.0]) / 300
    np.testing.assert_allclose(straight * (1 + 0.3 * np.square(straight).sum(1, keepdims=True)), bent, atol=1e-9)


# ── a scene whose cameras are known beforehand, through `masks` and `align`; tests/dataset/test_sources.py reads each source ──

CAMERA = Camera(200, 150, 300.0, (104.0, 71.0))
POSE = Pose(rotation_of_vector(np.array([0.7, -1.1, 0.4])), np.array([0.1, 0.2, 5.0]))
CASTER = Caster(chair())
LENS = {"fl_x": CAMERA.focal, "cx": CAMERA.centre[0], "cy": CAMERA.centre[1], "w": 200, "h": 150}


def scene(folder, *, scale=1, mesh=None):
    """A dataset of a photo of a chair, `scale` times as large as transforms.json says, which has poses."""
    for name in ("photos", "masks"):
        (folder / name).mkdir(parents=True)
    camera = Camera(200 * scale, 150 * scale, 300.0 * scale, (104.0 * scale, 71.0 * scale))
    label = rasterise(CASTER, camera, POSE).label
    write_photo(folder / "photos/hall.png", np.repeat(label[..., None] * 0.5, 3, axis=-1))
    write_labels(folder / "masks/hall.png", label)
    write_ply(folder / "chair.ply", mesh or chair())
    world_from_camera = np.column_stack([POSE.rotation.T * (1, -1, -1), -POSE.rotation.T @ POSE.translation])  # OpenGL
    write_json(
        folder / "t.json", {**LENS, "frames": [{"file_path": "hall", "transform_matrix": world_from_camera.tolist()}]}
    )
    photo = {"name": "hall", "image": "photos/hall.png", "masks": "masks/hall.png"}
    photo["objects"] = [{"name": "chair", "mesh": "chair"}]
    cameras = {"transforms": "t.json", "world_from_object": {"chair": {}}}
    meshes = {"chair": {"file": "chair.ply", "material": "white"}}
    spec = {"format": 1, "materials": ["white"], "meshes": meshes, "photos": [photo], "cameras": cameras}
    write_json(folder / "dataset.yaml", spec)
    return folder


def aligned(folder, name="usual", **averaged):
    run_stages(read_dataset(folder), folder.parent / name, (masks, align), {"masks": averaged})
    return read_json(folder.parent / name / "align" / "hall.json")


def test_the_poses_of_the_scene_come_out_of_a_photo_of_any_size(tmp_path):
    """Of the source's size, averaged down, and twice as large."""
    entry = aligned(scene(tmp_path / "same" / "set"))
    camera, obj = entry["camera"], entry["objects"]["chair"]
    assert (camera["focal_source"], obj["source"]) == ("transforms", "transforms") and obj["doubts"] == []
    assert camera["focal_px"] == 300.0 and np.allclose(camera["principal_point"], CAMERA.centre, atol=1e-12)
    assert np.allclose(obj["rotation"], POSE.rotation, atol=1e-12) and obj["silhouette_iou"] > 0.995
    assert np.allclose(obj["translation"], POSE.translation, atol=1e-12)
    entry = aligned(tmp_path / "same" / "set", name="half", frame=200 * 150 // 4)
    assert entry["camera"]["focal_px"] == 150.0 and entry["objects"]["chair"]["silhouette_iou"] > 0.98
    assert np.allclose(entry["camera"]["principal_point"], [52.0, 35.5], atol=1e-12)
    entry = aligned(scene(tmp_path / "large" / "set", scale=2))
    assert entry["camera"]["focal_px"] == 600.0 and entry["camera"]["principal_point"] == [208.0, 142.0]
    assert entry["objects"]["chair"]["silhouette_iou"] > 0.995


def test_a_known_pose_that_does_not_fit_is_doubted_with_its_own_cure_and_kept(tmp_path, caplog):
    obj = aligned(scene(tmp_path / "set", mesh=blob()))["objects"]["chair"]
    assert obj["doubts"] and not obj["left_out"] and "world_from_object" in caplog.text
