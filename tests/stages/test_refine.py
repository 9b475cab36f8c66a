"""The refine stage from masks, poses and a solve to poses.json, and what align makes of that."""

import json

import msgspec
import numpy as np
import pytest

from factorlib.jsonfile import write_json
from factorlib.meshes.ply import write_ply
from factorlib.reflection import reflection_operator
from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs, silent
from stages import align, refine
from studies.scenes.posed import TRUE, photographed
from tests.stages.made import chair_facts, entry_of, write_masks

NAMES = ["red", "green", "blue"]


@pytest.fixture(scope="module")
def turned():
    """A photo of one material whose pose is off, before any stage has worked on it."""
    return photographed("turned", 3, np.random.default_rng(2), reflection_operator("network"))


def inputs_of(folder, photo, stderr=0.1, **entry):
    folders = {name: folder / name for name in ("masks", "align", "solve")}
    for made in folders.values():
        made.mkdir(parents=True)
    write_masks(folders["masks"], "a", photo.channels["label"], photo.camera.focal, "dataset", photo.channels)
    camera = {"focal_px": photo.camera.focal, "focal_source": "dataset", "focal_relative_stderr": 0.0}
    camera["principal_point"] = list(photo.camera.centre)
    obj = entry_of(photo.pose, source="found", runner_up=None, left_out=False, silhouette_iou=0.0) | entry
    write_json(folders["align"] / "a.json", {"camera": camera, "objects": {"chair": obj}})
    errors = {"diffuse": [stderr] * 3, "specular": [stderr] * 3, "roughness": 0.1}
    table = {}
    for name, diffuse, specular, roughness in zip(NAMES, TRUE.diffuse, TRUE.specular, TRUE.roughness):
        table[name] = {"diffuse": diffuse.tolist(), "specular": specular.tolist(), "roughness": float(roughness)}
        table[name] |= {"alpha": float(roughness) ** 2, "stderr": errors}
    write_json(folders["solve"] / "materials.json", {"materials": table, "model": {"self_shadowing": False}})
    write_ply(folder / "chair.ply", photo.given.mesh)
    facts = {"dataset.materials": NAMES, "dataset.objects": chair_facts("blue")}
    return Inputs({**folders, "train": SHIPPED}, facts, {"chair.ply": folder / "chair.ply"}, "a")


def run(stage, inputs, out, **params):
    out.mkdir()
    stage.main(stage.Params(**params), inputs, out, silent)
    return json.loads((out / "a.json").read_text())


@pytest.fixture(scope="module")
def refined(tmp_path_factory, turned):
    """Inputs of refine, its folder, and its entry of the photo."""
    folder = tmp_path_factory.mktemp("refined")
    inputs = inputs_of(folder, turned)
    return inputs, folder / "out", run(refine, inputs, folder / "out")


def test_a_wrong_pose_is_mended_and_comes_back_into_align(tmp_path, turned, refined):
    inputs, folder, entry = refined
    obj, truth = entry["objects"]["chair"], turned.truth.rotation
    assert np.allclose(obj["rotation"], truth, atol=0.02) and not np.allclose(turned.pose.rotation, truth, atol=0.02)
    choice = obj["refined"]
    moved, found = (choice["candidates"][name] for name in ("moved", "found"))
    assert choice["chosen"] == "moved" and choice["moved"]["rotation_deg"] > 2 and obj["silhouette_iou"] > 0.98
    assert moved["held_out_loss"] < found["held_out_loss"] and moved["gain"] > 2 * moved["gain_stderr"]
    write_json(folder / "poses.json", {"a": entry})
    again = msgspec.structs.replace(inputs, folders={**inputs.folders, "poses": folder})
    aligned = run(align, again, tmp_path / "aligned")["objects"]["chair"]
    assert all(aligned[name] == obj[name] for name in ("rotation", "translation"))
    assert aligned["source"] == "refined" and not aligned["left_out"]


def test_what_shading_cannot_tell_stays_to_the_last_digit(tmp_path, turned, caplog):
    """A given pose, and materials that no photo showed."""
    for name, more in (("given", {"source": "given"}), ("unknown", {"stderr": 0.8})):
        obj = run(refine, inputs_of(tmp_path / name, turned, **more), tmp_path / name / "out")["objects"]["chair"]
        assert obj["refined"] is None
        assert {name: obj[name] for name in ("rotation", "translation")} == entry_of(turned.pose)
    assert "too few pixels of known materials" in caplog.text
