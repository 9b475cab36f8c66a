"""A dataset.yaml or truth.yaml that hangs, crashes or misleads a reader is refused, with file, key and cure."""

import copy
import os

import pytest
import yaml

from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError

EYE = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
SPEC = {
    "format": 1,
    "materials": ["red"],
    "meshes": {"vase": {"file": "vase.ply", "material": "red"}},
    "photos": [{"name": "hall", "image": "hall.png", "masks": "mask.png", "objects": [{"name": "vase", "mesh": "vase"}]}],
}
PATHS = {  # every path that a dataset.yaml may hold
    "image": ("photos", 0, "image"),
    "masks": ("photos", 0, "masks"),
    "masks of a material": ("photos", 0, "masks", "red"),
    "mask of an object": ("photos", 0, "objects", 0, "mask"),
    "mesh": ("meshes", "vase", "file"),
    "truth": ("truth",),
    "colmap": ("cameras", "colmap"),
    "transforms": ("cameras", "transforms"),
    "bop": ("cameras", "bop"),
}


def with_(spec, *path, value):
    spec = copy.deepcopy(spec)
    place = spec
    for step in path[:-1]:
        if isinstance(place, dict) and not isinstance(place.get(step), (dict, list)):
            place[step] = {}
        place = place[step]
    place[path[-1]] = value
    return spec


@pytest.fixture
def folder(open_folder):
    for name in ("hall.png", "mask.png", "vase.ply"):
        (open_folder / name).write_text("")
    return open_folder


def write(folder, spec=SPEC):
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec))
    return folder


def refused(folder, spec=SPEC):
    with pytest.raises(InputError) as caught:
        read_dataset(write(folder, spec))
    assert caught.value.cure and caught.value.file and len(str(caught.value)) < 1000
    return caught.value


def suffix(place):
    return {"mesh": ".ply", "truth": ".yaml", "transforms": ".json"}.get(place, "" if place in ("colmap", "bop") else ".png")


@pytest.mark.parametrize("place", PATHS)
@pytest.mark.parametrize("kind", ["loop", "loop above", "NUL", "long part", "long", "long in UTF-8"])
def test_a_path_that_leads_nowhere(folder, place, kind):
    """A loop of links, a NUL, a part of over 255 bytes: each is named, with its key."""
    (folder / f"a{suffix(place)}").symlink_to(f"b{suffix(place)}")
    (folder / f"b{suffix(place)}").symlink_to(f"a{suffix(place)}")
    (folder / "round").symlink_to("round")
    path = {
        "loop": "a",
        "loop above": "round/a",
        "NUL": "x\0y",
        "long part": "y" * 256,
        "long": "z/" * 4000,
        "long in UTF-8": "\N{GRINNING FACE}" * 70,
    }[kind]
    error = refused(folder, with_(SPEC, *PATHS[place], value=path + suffix(place)))
    assert error.key == ".".join(map(str, PATHS[place])).replace(".0", "[0]") and "no path that can be followed" in error.found


@pytest.mark.parametrize("place", PATHS)
def test_a_pipe_or_a_device_is_not_opened(folder, place):
    os.mkfifo(folder / f"pipe{suffix(place)}")
    error = refused(folder, with_(SPEC, *PATHS[place], value=f"pipe{suffix(place)}"))
    assert "is a pipe, not a file" in error.found or "there is no folder" in error.found
    (folder / f"zero{suffix(place)}").symlink_to("/dev/zero")
    assert "outside the dataset" in refused(folder, with_(SPEC, *PATHS[place], value=f"zero{suffix(place)}")).found


@pytest.mark.parametrize("place", PATHS)
def test_what_another_user_may_not_read(folder, as_other_user, place):
    (folder / f"own{suffix(place)}").write_text("")
    (folder / f"own{suffix(place)}").chmod(0)
    if not suffix(place):
        (folder / "own").unlink()
        (folder / "own").mkdir(mode=0o700)
    (folder / "closed").mkdir(mode=0o700)
    (folder / f"closed/own{suffix(place)}").write_text("")
    for path in ("own", "closed/own"):
        write(folder, with_(SPEC, *PATHS[place], value=path + suffix(place)))
        (folder / "dataset.yaml").chmod(0o644)
        with as_other_user(), pytest.raises(InputError, match="Permission denied") as caught:
            read_dataset(folder)
        assert "chmod" in caught.value.cure


def test_a_dataset_that_another_user_may_not_read(folder, as_other_user):
    write(folder)
    (folder / "dataset.yaml").chmod(0)
    with as_other_user(), pytest.raises(InputError, match="Permission denied"):
        read_dataset(folder)
    folder.chmod(0)
    with as_other_user(), pytest.raises(InputError, match="Permission denied"):
        read_dataset(folder)


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "round"])
def test_a_dataset_whose_own_path_leads_nowhere(tmp_path, name):
    (tmp_path / "round").symlink_to("round")
    with pytest.raises(InputError):
        read_dataset(tmp_path / name)


@pytest.mark.parametrize("name", ["dataset.yaml", "truth.yaml"])
def test_a_yaml_that_is_a_pipe(folder, name):
    write(folder, {**SPEC, "truth": "truth.yaml"})
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    with pytest.raises(InputError, match="is a pipe, not a file"):
        read_dataset(folder)


@pytest.mark.parametrize(
    "path, value, key",
    [
        (("camera",), {"focal_px": 1e300}, "photos[0].camera.focal_px"),
        (("camera",), {"focal_px": 1e-300}, "photos[0].camera.focal_px"),
        (("camera",), {"focal_px": 0.01}, "photos[0].camera.focal_px"),
        (("camera",), {"principal_point": [1e9, 0.0]}, "photos[0].camera.principal_point"),
        (("camera",), {"principal_point": [0.0, -1e9]}, "photos[0].camera.principal_point"),
        (("objects", 0, "pose"), {"rotation": EYE, "translation": [0, 0, 1e300]}, "photos[0].objects[0].pose.translation[2]"),
        (("world_from_camera",), [[1e300, 0, 0], [0, 1, 0], [0, 0, 1]], "photos[0].world_from_camera[0][0]"),
    ],
)
def test_a_number_that_no_camera_has(folder, path, value, key):
    assert refused(folder, with_(SPEC, "photos", 0, *path, value=value)).key == key


@pytest.mark.parametrize("key", ["scale", "mesh_unit_mm"])
@pytest.mark.parametrize("number", [1e300, 1e-300, 10**200], ids=["huge", "tiny", "whole"])
def test_a_unit_that_no_mesh_has(folder, key, number):
    cameras = {"transforms": "t.json", "world_from_object": {"vase": {"scale": number}}} if key == "scale" else {"bop": ".", "mesh_unit_mm": number}
    (folder / "t.json").write_text("{}")
    assert refused(folder, {**SPEC, "cameras": cameras}).key.endswith(key)


GOOD = {"diffuse": [0.5, 0.1, 0.1], "specular": [0.1, 0.1, 0.1], "roughness": 0.3}


@pytest.mark.parametrize(
    "changed, key",
    [
        ({"roughness": -7}, "roughness"),
        ({"roughness": 1.01}, "roughness"),
        ({"roughness": float("nan")}, "roughness"),
        ({"diffuse": [0.5, -0.1, 0.1]}, "diffuse[1]"),
        ({"diffuse": [0.5, 0.1, 200]}, "diffuse[2]"),
        ({"specular": [1.5, 0.1, 0.1]}, "specular[0]"),
        ({"specular": [float("inf"), 0.1, 0.1]}, "specular[0]"),
    ],
)
def test_a_truth_out_of_its_range(folder, changed, key):
    (folder / "truth.yaml").write_text(yaml.safe_dump({"materials": {"red": GOOD | changed}}))
    assert refused(folder, {**SPEC, "truth": "truth.yaml"}).key == f"materials.red.{key}"


@pytest.mark.parametrize("changed", [{"roughness": 0}, {"roughness": 1, "diffuse": [0, 0, 1], "specular": [1, 1, 1]}])
def test_a_truth_at_the_ends_of_its_range(folder, changed):
    (folder / "truth.yaml").write_text(yaml.safe_dump({"materials": {"red": GOOD | changed}}))
    assert read_dataset(write(folder, {**SPEC, "truth": "truth.yaml"})).truth.materials["red"].roughness == changed["roughness"]


@pytest.mark.parametrize(
    "pose", [{"rotation": EYE, "translation": [0, 0, 1e300]}, {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 1]}]
)
def test_a_true_pose_that_is_none(folder, pose):
    (folder / "truth.yaml").write_text(yaml.safe_dump({"poses": {"hall": {"vase": pose}}}))
    assert refused(folder, {**SPEC, "truth": "truth.yaml"}).key.startswith("poses.hall.vase.")
