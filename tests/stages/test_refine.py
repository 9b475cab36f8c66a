"""The refine stage from masks, poses and a solve to poses.json, and what align makes of that."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.exr import write_exr
from factorlib.images.tone import shown
from factorlib.jsonfile import read_json, write_json
from factorlib.meshes import write_ply
from factorlib.reflection import reflection_operator
from factorlib.reflection.network import SHIPPED
from factorlib.results.poses import read_poses
from factorlib.stage import Inputs, silent
from stages import align, refine
from tests.scenes.posed import TRUE, photographed

OPERATOR = reflection_operator("network")
NAMES = ["red", "green", "blue"]


@pytest.fixture(scope="module")
def turned():
    """A photo of one material whose pose is off, before any stage has seen it."""
    return photographed("turned", 3, np.random.default_rng(2), OPERATOR)


def pose_entry(pose):
    return {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist()}


def inputs_of(tmp_path, photo, **entry):
    masks, aligned, solved = (tmp_path / name for name in ("masks", "align", "solve"))
    for folder in (masks, aligned, solved):
        folder.mkdir()
    zero = np.zeros(photo.channels["label"].shape)
    write_exr(masks / "a.exr", {**photo.channels, "left_out": zero, "object": zero})
    facts = {
        "width": zero.shape[1],
        "height": zero.shape[0],
        "factor": 1,
        "original_size": list(zero.shape[::-1]),
        "focal_px": photo.camera.focal,
        "focal_source": "dataset",
    }
    write_json(masks / "a.json", facts)
    camera = {
        "focal_px": photo.camera.focal,
        "focal_source": "dataset",
        "focal_relative_stderr": 0.0,
        "principal_point": list(photo.camera.centre),
    }
    obj = {
        **pose_entry(photo.pose),
        "source": "found",
        "runner_up": None,
        "left_out": False,
        "silhouette_iou": 0.0,
    } | entry
    write_json(aligned / "a.json", {"camera": camera, "objects": {"chair": obj}})
    write_materials(solved, [0.1] * 3)
    write_ply(tmp_path / "chair.ply", photo.given.mesh)
    facts = {
        "dataset.materials": NAMES,
        "dataset.objects": {
            "camera": {}, "objects": [{"name": "chair", "mesh": "chair"}], "meshes": {"chair": {"file": "chair.ply", "material": "blue"}},
        },
    }  # fmt: skip
    folders = {"masks": masks, "align": aligned, "solve": solved, "train": SHIPPED}
    return Inputs(folders, facts, {"chair.ply": tmp_path / "chair.ply"}, "a")


def write_materials(folder, stderr):
    table = {
        name: {"diffuse": TRUE.diffuse[m].tolist(), "specular": TRUE.specular[m].tolist(), "roughness": float(TRUE.roughness[m]),
               "alpha": float(TRUE.roughness[m]) ** 2, "stderr": {"diffuse": stderr, "specular": stderr, "roughness": 0.1}}
        for m, name in enumerate(NAMES)
    }  # fmt: skip
    write_json(folder / "materials.json", {"materials": table, "model": {"self_shadowing": False}})


def run(stage, inputs, out, **params):
    out.mkdir()
    stage.main(stage.Params(**params), inputs, out, silent)
    return json.loads((out / "a.json").read_text())


def test_a_wrong_pose_is_mended_and_comes_back_into_align(tmp_path, turned):
    inputs = inputs_of(tmp_path, turned)
    entry = run(refine, inputs, tmp_path / "refined")
    obj = entry["objects"]["chair"]
    assert np.allclose(obj["rotation"], turned.truth.rotation, atol=0.02) and not np.allclose(
        turned.pose.rotation, turned.truth.rotation, atol=0.02
    )
    choice = obj["refined"]
    assert choice["chosen"] == "moved" and choice["moved"]["rotation_deg"] > 2 and obj["silhouette_iou"] > 0.98
    assert choice["candidates"]["moved"]["held_out_loss"] < choice["candidates"]["found"]["held_out_loss"]
    assert choice["candidates"]["moved"]["gain"] > 2 * choice["candidates"]["moved"]["gain_stderr"]
    write_json(tmp_path / "refined" / "poses.json", {"a": entry})
    again = msgspec.structs.replace(inputs, folders={**inputs.folders, "poses": tmp_path / "refined"})
    obj_again = run(align, again, tmp_path / "aligned")["objects"]["chair"]
    assert (
        all(obj_again[name] == obj[name] for name in ("rotation", "translation")) and obj_again["source"] == "refined"
    )
    assert not obj_again["left_out"]


def test_a_photo_with_a_tone_curve_is_straightened_first(tmp_path, turned):
    (tmp_path / "linear").mkdir(), (tmp_path / "bent").mkdir()
    straight = run(refine, inputs_of(tmp_path / "linear", turned), tmp_path / "straight")
    tone = {"exponent": 1.6, "pivot": 0.4}
    channels = {name: shown(of, **tone) if name in "RGB" else of for name, of in turned.channels.items()}
    inputs = inputs_of(tmp_path / "bent", msgspec.structs.replace(turned, channels=channels))
    table = inputs["solve"] / "materials.json"
    write_json(table, read_json(table) | {"model": {"tone": {"a": tone}}})
    again = run(refine, inputs, tmp_path / "again")
    found, expected = (
        entry["objects"]["chair"]["refined"]["candidates"]["found"]["held_out_loss"] for entry in (again, straight)
    )
    assert found == pytest.approx(expected, rel=1e-2)


def test_what_shading_cannot_tell_stays_to_the_last_digit(tmp_path, turned, caplog):
    """A given pose, and materials that no photo showed."""
    given = run(refine, inputs_of(tmp_path, turned, source="given"), tmp_path / "given")
    unknown = tmp_path / "unknown"
    unknown.mkdir()
    inputs = inputs_of(unknown, turned)
    write_materials(inputs["solve"], [0.8] * 3)
    for entry in (given, run(refine, inputs, unknown / "out")):
        obj = entry["objects"]["chair"]
        assert obj["refined"] is None
        assert {name: obj[name] for name in ("rotation", "translation")} == pose_entry(turned.pose)
    assert "too few pixels of known materials" in caplog.text


@pytest.mark.parametrize(
    "text, words",
    [
        ("[]", "Expected `object`"),
        ('{"a": {"camera": {"focal_px": -1, "principal_point": [0, 0]}, "objects": {}}}', "focal_px"),
        (
            '{"a": {"camera": {"focal_px": 1, "principal_point": [0, 0]}, "objects": {"t": {"rotation": [[1,0,0],[0,1,0],[0,0,-1]], "translation": [0,0,1]}}}}',
            "a.objects.t",
        ),
        (
            '{"a": {"camera": {"focal_px": 1, "principal_point": [0, 0]}, "objects": {"t": {"translation": [0,0,1]}}}}',
            "rotation",
        ),
    ],
)
def test_a_folder_without_poses_is_refused(tmp_path, text, words):
    (tmp_path / "poses.json").write_text(text)
    with pytest.raises(InputError) as caught:
        read_poses(tmp_path / "poses.json")
    assert (
        words in str(caught.value)
        and "poses.json" in str(caught.value)
        and "result of `align`, `fit_mesh` or `refine`" in str(caught.value)
    )
