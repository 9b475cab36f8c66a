"""Every file of results: what is written is read back, and what is damaged or of another version is refused by name, key and cure."""

import json

import pytest

from factorlib.errors import InputError
from factorlib.results.exposures import read_exposures, write_exposures
from factorlib.results.materials import (
    Gauge,
    MaterialTable,
    Model,
    Reflectance,
    StandardErrors,
    Tone,
    in_order,
    read_materials,
    solved,
    write_materials,
)
from factorlib.results.metrics import Counts, Metrics, Resynthesis, read_metrics, write_metrics
from factorlib.results.photos import PhotoFacts, read_photo_facts, write_photo_facts
from factorlib.results.poses import (
    CameraEntry,
    ObjectEntry,
    PhotoPoses,
    read_photo_poses,
    read_poses,
    write_photo_poses,
    write_poses,
)
from factorlib.results.uncertainty import Uncertainty, read_uncertainty, write_uncertainty

ERRORS = StandardErrors((0.01, 0.02, 0.03), (0.1, 0.1, 0.1), 0.05)
RED = solved(Reflectance((0.5, 0.1, 0.1), (0.05, 0.05, 0.05), 0.3), ERRORS)
TABLE = MaterialTable({"red": RED}, Gauge("white light", {"red": 0}, "by hand"), Model(tone={"hall": Tone(1.2, 0.4)}))
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
HALL = PhotoPoses(CameraEntry(300.0, (8.0, 6.0)), {"vase": ObjectEntry(EYE, (0.0, 0.0, 2.0), source="found")})
FILES = {
    "materials.json": (write_materials, read_materials, TABLE),
    "exposures.json": (write_exposures, read_exposures, {"hall": (1.0, 2.0, 0.5)}),
    "uncertainty.json": (write_uncertainty, read_uncertainty, Uncertainty(1.1, {"red": ERRORS}, "by hand")),
    "poses.json": (write_poses, read_poses, {"hall": HALL}),
    "hall.json": (write_photo_poses, read_photo_poses, HALL),
    "photo.json": (write_photo_facts, read_photo_facts, PhotoFacts(640, 480, 2, (1280, 960), pixels={"red": 7})),
    "metrics.json": (
        write_metrics, read_metrics, Metrics(Counts(2, 1, 2, 1), Resynthesis({}, None, None, None), None, None, None, None, None, {"light": "no truth"})
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_what_is_written_is_read_back_and_written_again_to_the_same_bytes(tmp_path, name):
    write, read, value = FILES[name]
    write(tmp_path / name, value)
    assert read(tmp_path / name) == value
    write(tmp_path / "again.json", read(tmp_path / name))
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / name).read_bytes()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("version, refused", [(1, False), (2, True), ("next", True)])
def test_another_version_is_refused(tmp_path, name, version, refused):
    write, read, value = FILES[name]
    write(tmp_path / name, value)
    content = json.loads((tmp_path / name).read_text())
    (tmp_path / name).write_text(json.dumps(content | {"version": version}))
    if not refused:
        assert read(tmp_path / name) == value
        return
    with pytest.raises(InputError, match=f"is of version {version}") as caught:
        read(tmp_path / name)
    assert caught.value.key == "version" and str(tmp_path / name) in str(caught.value) and caught.value.cure


def test_a_photo_may_be_called_version(tmp_path):
    write_poses(tmp_path / "poses.json", {"version": HALL})
    assert read_poses(tmp_path / "poses.json") == {"version": HALL}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    "content", ["", "[]", "{", '{"a": NaN}', '{"a": 1e999}', '"text"', "null", '{"version": {}}', "[" * 3000]
)
def test_what_is_none_is_refused(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as caught:
        FILES[name][1](tmp_path / name)
    assert name in str(caught.value) and caught.value.cure


@pytest.mark.parametrize(
    "old, new, words, key",
    [
        ('"roughness": 0.3', '"roughness": 1.3', "<= 1", "roughness"),
        ('"roughness": 0.3', '"rough": 0.3', "missing required field `roughness`", "materials"),
        ("0.4", "-0.4", "> 0", "pivot"),
    ],
)
def test_what_does_not_fit_is_named_by_its_key(tmp_path, old, new, words, key):
    write_materials(tmp_path / "materials.json", TABLE)
    path = tmp_path / "materials.json"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError) as caught:
        read_materials(path)
    assert words in str(caught.value) and key in caught.value.key and "solve" in caught.value.cure


def test_a_missing_material_is_named(tmp_path):
    assert in_order(TABLE, ["red"], tmp_path) == [RED]
    with pytest.raises(InputError, match="'blue' is missing"):
        in_order(TABLE, ["red", "blue"], tmp_path)


def test_an_exposure_of_nothing_is_refused(tmp_path):
    write_exposures(tmp_path / "exposures.json", {"hall": (1.0, 0.0, 1.0)})
    with pytest.raises(InputError, match="not a positive number") as caught:
        read_exposures(tmp_path / "exposures.json")
    assert caught.value.key == "hall"


def test_a_mirrored_pose_is_refused(tmp_path):
    mirrored = (EYE[0], EYE[1], (0.0, 0.0, -1.0))
    write_photo_poses(tmp_path / "a.json", PhotoPoses(HALL.camera, {"vase": ObjectEntry(mirrored, (0.0, 0.0, 2.0))}))
    with pytest.raises(InputError, match="no rotation and translation") as caught:
        read_photo_poses(tmp_path / "a.json")
    assert caught.value.key == "objects.vase"
