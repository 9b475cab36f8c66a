"""A scene whose cameras stand in a COLMAP model, through `masks` and `align`; `tests/dataset/test_sources.py` reads the other sources."""

import logging

import numpy as np
import pycolmap
import yaml

from factorlib.dataset.read import read_dataset
from factorlib.generate.folder import write_labels, write_photo
from factorlib.geometry.camera import Camera, Pose, rotation_of_vector
from factorlib.geometry.raster import Caster, rasterise
from factorlib.jsonfile import read_json
from factorlib.meshes.ply import write_ply
from factorlib.scenes.stage_runs import run_stages
from stages import align, masks
from tests.align.scenes import blob, chair, normal_error_deg

CAMERA = Camera(200, 150, 300.0, (104.0, 71.0))
POSE = Pose(rotation_of_vector(np.array([0.7, -1.1, 0.4])), np.array([0.1, 0.2, 5.0]))
WORLD = {
    "scale": 2.0,
    "rotation": rotation_of_vector(np.array([-0.3, 0.2, 1.5])).tolist(),
    "translation": [1.0, -2.0, 0.5],
}
CASTER = Caster(chair())


def scene(folder, *, scale=1, photo=None, mesh=None, posed=True):
    """A dataset of a photo of a chair, `scale` times as large as the model's, which has poses or cameras alone."""
    for name in ("photos", "masks"):
        (folder / name).mkdir(parents=True)
    camera = Camera(200 * scale, 150 * scale, 300.0 * scale, (104.0 * scale, 71.0 * scale))
    write_pixels(folder, rasterise(CASTER, camera, POSE).label)
    write_ply(folder / "chair.ply", mesh or chair())
    entry = {"name": "hall", "image": "photos/000003.png", "masks": "masks/000003.png"} | (photo or {})
    entry["objects"] = [{"name": "chair", "mesh": "chair"}]
    meshes, cameras = {"chair": {"file": "chair.ply", "material": "white"}}, colmap(folder)
    cameras = cameras if posed else {"colmap": "sparse"}
    spec = {"format": 1, "materials": ["white"], "meshes": meshes, "photos": [entry], "cameras": cameras}
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec))
    return folder


def write_pixels(folder, label):
    write_photo(folder / "photos/000003.png", np.repeat(label[..., None] * 0.5, 3, axis=-1))
    write_labels(folder / "masks/000003.png", label)


def cam_from_world():
    """Of x_world = 2 R x_object + t, in the world's units: cam_from_object after object_from_world, twice as long."""
    rotation = POSE.rotation @ np.array(WORLD["rotation"]).T
    return rotation, 2 * POSE.translation - rotation @ np.array(WORLD["translation"])


def colmap(folder):
    rotation, translation = cam_from_world()
    model = pycolmap.Reconstruction()
    parameters = [CAMERA.focal, *CAMERA.centre]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="SIMPLE_PINHOLE", width=200, height=150, params=parameters, camera_id=1)
    )
    image = pycolmap.Image(name="000003.png", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
    (folder / "sparse").mkdir()
    model.write_binary(str(folder / "sparse"))
    return {"colmap": "sparse", "world_from_object": {"chair": WORLD}}


def aligned(folder, name="usual", search=None, **averaged):
    out = folder.parent / name
    run_stages(
        read_dataset(folder), out, (masks, align), {"masks": averaged, "align": {"search": search} if search else {}}
    )
    return read_json(out / "align" / "hall.json")


def test_the_poses_of_the_scene_come_out_of_a_photo_of_any_size(tmp_path):
    """Of the source's size, averaged down, and twice as large."""
    entry = aligned(scene(tmp_path / "same" / "set"))
    camera, obj = entry["camera"], entry["objects"]["chair"]
    assert (camera["focal_source"], obj["source"]) == ("colmap", "colmap") and obj["doubts"] == []
    assert camera["focal_px"] == 300.0 and np.allclose(camera["principal_point"], CAMERA.centre, atol=1e-12)
    assert np.allclose(obj["rotation"], POSE.rotation, atol=1e-12) and obj["silhouette_iou"] > 0.995
    assert np.allclose(obj["translation"], POSE.translation, atol=1e-12)
    entry = aligned(tmp_path / "same" / "set", name="half", frame=200 * 150 // 4)
    assert entry["camera"]["focal_px"] == 150.0 and entry["objects"]["chair"]["silhouette_iou"] > 0.98
    assert np.allclose(entry["camera"]["principal_point"], [52.0, 35.5], atol=1e-12)
    entry = aligned(scene(tmp_path / "large" / "set", scale=2))
    assert entry["camera"]["focal_px"] == 600.0 and entry["camera"]["principal_point"] == [208.0, 142.0]
    assert entry["objects"]["chair"]["silhouette_iou"] > 0.995


def test_where_only_the_camera_is_known_the_pose_is_searched(tmp_path):
    quick = {"views": 160, "rolls": 16, "keep": [20, 8, 4, 2]}
    entry = aligned(scene(tmp_path / "set", posed=False), search=quick)
    camera, obj = entry["camera"], entry["objects"]["chair"]
    assert (camera["focal_source"], obj["source"], camera["focal_px"]) == ("colmap", "found", 300.0)
    assert camera["principal_point"] == list(CAMERA.centre)
    pose = Pose(np.array(obj["rotation"]), np.array(obj["translation"]))
    assert normal_error_deg(CASTER, CAMERA, POSE, CAMERA, pose) < 1


def test_a_known_pose_that_does_not_fit_is_doubted_with_its_own_cure_and_kept(tmp_path, caplog):
    with caplog.at_level(logging.WARNING, "factorlib.align"):
        obj = aligned(scene(tmp_path / "set", mesh=blob()))["objects"]["chair"]
    assert obj["doubts"] and not obj["left_out"] and "world_from_object" in caplog.text
