"""Every file of results: what is written is read back, and what is damaged or of another version is refused by name, key and cure."""

import json

import pytest

from factorlib.jsonfile import write_json
from factorlib.results.materials import (
    Gauge,
    MaterialTable,
    Model,
    Reflectance,
    StandardErrors,
    Tone,
    attach_errors,
    read_exposures,
    read_materials,
    select_materials,
)
from factorlib.results.metrics import Counts, Metrics, ResynthesisErrors, read_metrics
from factorlib.results.photos import PhotoFacts, read_photo_facts
from factorlib.results.poses import CameraEntry, ObjectPose, PhotoPoses, read_photo_poses, read_poses
from tests.refusal import refusal

ERRORS = StandardErrors((0.01, 0.02, 0.03), (0.1, 0.1, 0.1), 0.05)
RED = attach_errors(Reflectance((0.5, 0.1, 0.1), (0.05, 0.05, 0.05), 0.3), ERRORS)
TABLE = MaterialTable({"red": RED}, Gauge("white light", {"red": 0}, "by hand"), Model(tone={"hall": Tone(1.2, 0.4)}))
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
HALL = PhotoPoses(CameraEntry(300.0, (8.0, 6.0)), {"vase": ObjectPose(EYE, (0.0, 0.0, 2.0), source="found")})
RESYNTHESIS = ResynthesisErrors({}, None, None, None)
FILES = {
    "materials.json": (read_materials, TABLE),
    "exposures.json": (read_exposures, {"hall": (1.0, 2.0, 0.5)}),
    "poses.json": (read_poses, {"hall": HALL}),
    "hall.json": (read_photo_poses, HALL),
    "photo.json": (read_photo_facts, PhotoFacts(640, 480, 2, (1280, 960), pixels={"red": 7})),
    "metrics.json": (read_metrics, Metrics(Counts(2, 1, 2, 1), RESYNTHESIS, *[None] * 5, {"light": "no truth"})),
}
BROKEN = ["", "[]", "{", '{"a": NaN}', '{"a": 1e999}', '"text"', "null", '{"version": {}}', "[" * 3000]


@pytest.mark.parametrize("name", FILES)
def test_what_is_written_is_read_back_and_another_version_or_what_is_none_is_refused(tmp_path, name):
    (read, value), path = FILES[name], tmp_path / name
    write_json(path, value)
    written = path.read_bytes()
    assert read(path) == value
    write_json(path, read(path))
    assert path.read_bytes() == written
    write_json(path, json.loads(written) | {"version": 1})
    assert read(path) == value
    refused = [(json.dumps(json.loads(written) | {"version": v}), f"is of version {v}") for v in (2, "next")]
    for content, words in [*refused, *((text, name) for text in BROKEN)]:
        path.write_text(content)
        caught = refusal(words, read, path)
        assert str(path) in str(caught)
        assert caught.key == "version" or words == name


@pytest.mark.parametrize("old, new, words, key", [
    ('"roughness": 0.3', '"roughness": 1.3', "<= 1", "roughness"),
    ('"roughness": 0.3', '"rough": 0.3', "missing required field `roughness`", "materials"),
    ("0.4", "-0.4", "> 0", "pivot"),
])  # fmt: skip
def test_what_does_not_fit_is_named_by_its_key(tmp_path, old, new, words, key):
    path = tmp_path / "materials.json"
    write_json(path, TABLE)
    path.write_text(path.read_text().replace(old, new))
    caught = refusal(".", read_materials, path)
    assert words in str(caught) and key in caught.key and "solve" in caught.cure


def test_a_missing_material_is_named(tmp_path):
    assert select_materials(TABLE, ["red"], tmp_path) == [RED]
    refusal("'blue' is missing", select_materials, TABLE, ["red", "blue"], tmp_path)


def test_a_mirrored_pose_is_refused(tmp_path):
    mirrored = (EYE[0], EYE[1], (0.0, 0.0, -1.0))
    write_json(tmp_path / "a.json", PhotoPoses(HALL.camera, {"vase": ObjectPose(mirrored, (0.0, 0.0, 2.0))}))
    assert refusal("not a rotation matrix", read_photo_poses, tmp_path / "a.json").key == "objects.vase"
