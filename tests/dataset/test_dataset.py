"""Datasets: what is good is read, each fault is refused with file, key and cure, and slices are small."""

import copy
import json
import logging
import subprocess
import sys

import msgspec
import pytest
import yaml

from factorlib.dataset import schema
from factorlib.dataset.read import read_dataset
from factorlib.dataset.slices import SLICES, dataset_slice
from factorlib.errors import InputError
from factorlib.images.transfer import ENCODINGS
from factorlib.labels import LEFT_OUT

TURN = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
FILES = [
    "kitchen.jpg",
    "garden.exr",
    "kitchen.png",
    "red.png",
    "coco.json",
    "own.png",
    "chair.obj",
    "vase.ply",
    "box.gltf",
    "notes.txt",
]
SPEC = {
    "format": 1,
    "materials": ["red", "white", "wood"],
    "meshes": {
        "chair": {"file": "chair.obj", "parts": {"shell": "red", "legs": "wood"}},
        "vase": {"file": "vase.ply", "material": "white"},
        "box": {"file": "box.gltf", "material": "wood"},
    },
    "photos": [
        {
            "name": "kitchen",
            "image": "kitchen.jpg",
            "encoding": "srgb",
            "masks": "kitchen.png",
            "camera": {"focal_px": 812.0, "principal_point": [320.0, 240.0]},
            "objects": [
                {"name": "chair_1", "mesh": "chair", "materials": {"shell": "white"}, "mask": "own.png"},
                {"name": "vase_1", "mesh": "vase", "pose": {"rotation": TURN, "translation": [0, 0, 2.5]}},
            ],
        },
        {
            "name": "garden",
            "image": "garden.exr",
            "masks": {"red": "red.png"},
            "objects": [{"name": "chair_1", "mesh": "chair"}],
        },
        {"name": "hall", "image": "kitchen.jpg", "masks": "coco.json", "objects": [{"name": "box_1", "mesh": "box"}]},
    ],
}


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "set"
    path.mkdir()
    for name in FILES:
        (path / name).write_text("")
    (path / "chair.obj").write_text("# a chair\nmtllib chair.mtl\nusemtl shell\n")
    (path / "chair.mtl").write_text("newmtl shell\n")
    buffers = [{"uri": "box%201.bin", "byteLength": 0}, {"uri": "data:,x", "byteLength": 1}]
    (path / "box.gltf").write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": buffers}))
    (path / "box 1.bin").write_text("")
    (tmp_path / "outside.jpg").write_text("")
    return path


def write(folder, spec=SPEC):
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec, sort_keys=False))
    return folder


def changed(*path, value):
    """SPEC with one entry replaced, or removed where `value` is None."""
    spec = copy.deepcopy(SPEC)
    place = spec
    for step in path[:-1]:
        place = place[step]
    if value is None:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return spec


# ---- good ones -----------------------------------------------------------------------------------------------


def test_folder_and_file_are_the_same_dataset(folder):
    write(folder)
    dataset = read_dataset(folder)
    assert dataset == read_dataset(folder / "dataset.yaml") == read_dataset(str(folder) + "/")
    assert dataset.name == "set" and [photo.name for photo in dataset.spec.photos] == ["kitchen", "garden", "hall"]


def test_reading_costs_no_numpy(folder):
    write(folder)
    code = (
        "import sys; from factorlib.dataset.read import read_dataset; from factorlib.dataset.slices import SLICES, dataset_slice\n"
        f"d = read_dataset({str(folder)!r}); [dataset_slice(d, s) for s in SLICES]\n"
        "heavy = {'numpy', 'torch', 'OpenImageIO', 'PIL'} & set(sys.modules); sys.exit(', '.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_constants_agree_with_those_of_the_readers():
    assert schema.ENCODINGS == ENCODINGS and schema.LEFT_OUT == LEFT_OUT and schema.MAX_MATERIALS == LEFT_OUT - 1


# ---- slices --------------------------------------------------------------------------------------------------


def test_a_slice_is_json_and_converts_to_its_type(folder):
    dataset = read_dataset(write(folder))
    types = {
        "photo": schema.PhotoSlice,
        "objects": schema.ObjectsSlice,
        "light": schema.LightSlice,
        "set": schema.SetSlice,
    }
    for name in SLICES:
        one = dataset_slice(dataset, name, "kitchen")
        assert json.loads(json.dumps(one.facts)) == one.facts
        assert msgspec.to_builtins(msgspec.convert(one.facts, types.get(name, object))) is not None or name == "truth"
        assert one.files == sorted(set(one.files)) and all((folder / file).is_file() for file in one.files)


def test_slices_name_the_files_they_need(folder):
    dataset = read_dataset(write(folder))
    files = {name: dataset_slice(dataset, name, "kitchen").files for name in SLICES}
    assert files["photo"] == ["kitchen.jpg", "kitchen.png", "own.png"]
    assert files["objects"] == ["chair.mtl", "chair.obj", "own.png", "vase.ply"]
    assert files["materials"] == files["light"] == files["set"] == files["truth"] == []
    assert dataset_slice(dataset, "objects", "hall").files == ["box 1.bin", "box.gltf"]
    assert dataset_slice(dataset, "photo").files == [
        "coco.json",
        "garden.exr",
        "kitchen.jpg",
        "kitchen.png",
        "own.png",
        "red.png",
    ]


def test_an_mtl_that_is_not_there_is_not_needed(folder):
    (folder / "chair.mtl").unlink()
    assert dataset_slice(read_dataset(write(folder)), "objects", "garden").files == ["chair.obj"]


def test_order_of_photos_changes_no_photo(folder):
    before = read_dataset(write(folder))
    spec = copy.deepcopy(SPEC)
    spec["photos"] = spec["photos"][::-1] + [{**SPEC["photos"][1], "name": "attic"}]
    after = read_dataset(write(folder, spec))
    for name in ("photo", "objects", "light", "materials"):
        for photo in ("kitchen", "garden", "hall"):
            assert dataset_slice(before, name, photo) == dataset_slice(after, name, photo)
    assert dataset_slice(before, "set") != dataset_slice(after, "set")


def test_a_slice_holds_what_its_readers_need_and_no_more(folder):
    before = read_dataset(write(folder))
    posed = read_dataset(write(folder, changed("photos", 0, "objects", 1, "pose", "translation", value=[0, 0, 3])))
    differ = {
        name
        for name in SLICES
        for photo in ("kitchen", "garden")
        if dataset_slice(before, name, photo) != dataset_slice(posed, name, photo)
    }
    assert differ == {"objects"}
    assert dataset_slice(before, "objects", "garden") == dataset_slice(posed, "objects", "garden")
    said = read_dataset(write(folder, changed("photos", 1, "illumination", value="garden")))  # the default, written out
    assert all(dataset_slice(before, name) == dataset_slice(said, name) for name in SLICES)


# ---- truth ---------------------------------------------------------------------------------------------------

TRUTH = {
    "materials": {"red": {"diffuse": [0.5, 0.1, 0.1], "specular": [0.1, 0.1, 0.1], "roughness": 0.3}},
    "illumination": {"garden": "truth/garden.exr"},
    "poses": {"kitchen": {"vase_1": {"rotation": TURN, "translation": [0, 0, 2.5]}}},
}


def write_truth(folder, truth):
    (folder / "truth").mkdir(exist_ok=True)
    (folder / "truth" / "truth.yaml").write_text(yaml.safe_dump(truth))
    (folder / "truth" / "garden.exr").write_text("")
    return write(folder, {**SPEC, "truth": "truth/truth.yaml"})


def test_truth_is_its_own_slice(folder):
    plain = read_dataset(write(folder))
    dataset = read_dataset(write_truth(folder, TRUTH))
    truth = dataset_slice(dataset, "truth")
    assert truth.files == ["truth/garden.exr"]
    assert msgspec.convert(truth.facts, schema.TruthFile).materials["red"].roughness == 0.3
    assert all(dataset_slice(plain, name) == dataset_slice(dataset, name) for name in SLICES if name != "truth")


@pytest.mark.parametrize("gone", ["truth/truth.yaml", "truth/garden.exr"])
def test_missing_truth_is_a_warning(folder, gone, caplog):
    write_truth(folder, TRUTH)
    (folder / gone).unlink()
    with caplog.at_level(logging.WARNING):
        dataset = read_dataset(folder)
    assert dataset_slice(dataset, "truth").facts is None and gone in caplog.text


@pytest.mark.parametrize(
    "truth, key, cure",
    [
        ({"materials": {"rde": TRUTH["materials"]["red"]}}, "materials.rde", "did you mean 'red'"),
        ({"illumination": {"gardn": "truth/garden.exr"}}, "illumination.gardn", "did you mean 'garden'"),
        ({"normals": {"hal": "truth/garden.exr"}}, "normals.hal", "did you mean 'hall'"),
        (
            {"poses": {"kitchen": {"vase_2": TRUTH["poses"]["kitchen"]["vase_1"]}}},
            "poses.kitchen.vase_2",
            "did you mean 'vase_1'",
        ),
        ({"illumination": {"garden": "../outside.exr"}}, "illumination.garden", "copy the file"),
    ],
)
def test_wrong_truth_is_refused(folder, truth, key, cure):
    with pytest.raises(InputError) as caught:
        read_dataset(write_truth(folder, truth))
    assert "truth.yaml" in str(caught.value.file) and caught.value.key == key and cure in caught.value.cure


# ---- bad ones: (what is changed, key of the message, words in it) -----------------------------------------------

P0, P1, O0 = ("photos", 0), ("photos", 1), ("photos", 0, "objects", 0)
NO_TURN = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]]
MIRROR = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]
NAN = float("nan")
KEYPOINTS = [
    {"pixel": [float(x), float(y)], "point": [float(a), float(b), float(c)]}
    for x, y, a, b, c in ((1, 1, 0, 0, 0), (5, 1, 1, 0, 0), (5, 4, 1, 1, 0), (1, 4, 0, 1, 1))
]
BAD = {
    "another format": (("format",), 2, "format", "format: 1"),
    "no materials": (("materials",), [], "materials", "1 to 254"),
    "too many materials": (("materials",), [f"m{k}" for k in range(255)], "materials", "1 to 254"),
    "material twice": (("materials",), ["red", "white", "wood", "red"], "materials[3]", "named twice"),
    "bad material name": (("materials",), ["red", "white", "wood", "a b"], "materials[3]", "A-Z a-z 0-9"),
    "no photos": (("photos",), [], "photos", "at least one"),
    "no objects": ((*P1, "objects"), [], "photos[1].objects", "no objects"),
    "duplicate photo name": ((*P1, "name"), "kitchen", "photos[1].name", "photos[0] has it already"),
    "bad photo name": ((*P1, "name"), "../garden", "photos[1].name", "A-Z a-z 0-9"),
    "name of a result": ((*P1, "name"), "poses", "photos[1].name", "rename the photo"),
    "bad illumination name": ((*P1, "illumination"), "a/b", "photos[1].illumination", "A-Z a-z 0-9"),
    "missing image": ((*P0, "image"), "kitchn.jpg", "photos[0].image", "did you mean 'kitchen.jpg'"),
    "missing mask": ((*P0, "masks"), "masks/gone.png", "photos[0].masks", "masks/gone.png"),
    "missing mask of a material": ((*P1, "masks"), {"red": "gone.png"}, "photos[1].masks.red", "gone.png"),
    "no mask": ((*P1, "masks"), {}, "photos[1].masks", "COCO"),
    "mask of no material": ((*P1, "masks"), {"rde": "red.png"}, "photos[1].masks.rde", "did you mean 'red'"),
    "unsupported mask": ((*P0, "masks"), "notes.txt", "photos[0].masks", ".png, .json"),
    "unsupported image": ((*P0, "image"), "notes.txt", "photos[0].image", ".jpg"),
    "image outside": ((*P0, "image"), "../outside.jpg", "photos[0].image", "outside the dataset"),
    "image by absolute path": ((*P0, "image"), "/etc/hostname", "photos[0].image", "outside the dataset"),
    "image by a link that leads out": ((*P0, "image"), "link.jpg", "photos[0].image", "outside the dataset"),
    "empty path": ((*P0, "image"), "", "photos[0].image", "outside the dataset"),
    "unknown encoding": ((*P0, "encoding"), "sgrb", "photos[0].encoding", "did you mean 'srgb'"),
    "focal of zero": ((*P0, "camera"), {"focal_px": 0.0}, "photos[0].camera.focal_px", "more than 0"),
    "focal that is NaN": ((*P0, "camera"), {"focal_px": NAN}, "photos[0].camera.focal_px", "finite"),
    "infinite principal point": (
        (*P0, "camera"),
        {"principal_point": [1.0, float("inf")]},
        "photos[0].camera.principal_point[1]",
        "finite",
    ),
    "duplicate object": (
        (*P0, "objects", 1, "name"),
        "chair_1",
        "photos[0].objects[1].name",
        "objects[0] has it already",
    ),
    "bad object name": ((*O0, "name"), "chair 1", "photos[0].objects[0].name", "A-Z a-z 0-9"),
    "unknown mesh": ((*O0, "mesh"), "chiar", "photos[0].objects[0].mesh", "did you mean 'chair'"),
    "unknown part": (
        (*O0, "materials"),
        {"shel": "red"},
        "photos[0].objects[0].materials.shel",
        "did you mean 'shell'",
    ),
    "unknown material of a part": (
        (*O0, "materials"),
        {"shell": "whit"},
        "photos[0].objects[0].materials.shell",
        "did you mean 'white'",
    ),
    "part of a mesh of one": (
        (*P0, "objects", 1, "materials"),
        {"lid": "red"},
        "photos[0].objects[1].materials.lid",
        "'vase'",
    ),
    "missing object mask": ((*O0, "mask"), "owm.png", "photos[0].objects[0].mask", "did you mean 'own.png'"),
    "stretched pose": (
        (*O0, "pose"),
        {"rotation": NO_TURN, "translation": [0, 0, 1]},
        "photos[0].objects[0].pose.rotation",
        "unit vectors",
    ),
    "mirrored pose": (
        (*O0, "pose"),
        {"rotation": MIRROR, "translation": [0, 0, 1]},
        "photos[0].objects[0].pose.rotation",
        "reflection",
    ),
    "NaN pose": (
        (*O0, "pose"),
        {"rotation": TURN, "translation": [0, NAN, 1]},
        "photos[0].objects[0].pose.translation[1]",
        "finite",
    ),
    "three keypoints": ((*O0, "keypoints"), KEYPOINTS[:3], "photos[0].objects[0].keypoints", "give 4 or more"),
    "keypoints on a line": (
        (*O0, "keypoints"),
        [{"pixel": k["pixel"], "point": [0.1 * n, 0.2 * n, 0]} for n, k in enumerate(KEYPOINTS)],
        "photos[0].objects[0].keypoints",
        "every point lies on one line",
    ),
    "one pixel named twice": (
        (*O0, "keypoints"),
        [*KEYPOINTS, {"pixel": KEYPOINTS[1]["pixel"], "point": [9, 9, 9]}],
        "photos[0].objects[0].keypoints[4].pixel",
        "keypoints[1]",
    ),
    "keypoints beside a pose": (
        (*P0, "objects", 1, "keypoints"),
        KEYPOINTS,
        "photos[0].objects[1].keypoints",
        "keep one",
    ),
    "NaN keypoint": (
        (*O0, "keypoints"),
        [*KEYPOINTS[:3], {"pixel": [9, NAN], "point": [0, 0, 1]}],
        "photos[0].objects[0].keypoints[3].pixel[1]",
        "finite",
    ),
    "mirrored world": ((*P0, "world_from_camera"), MIRROR, "photos[0].world_from_camera", "reflection"),
    "bad mesh name": (("meshes", "a/b"), {"file": "vase.ply", "material": "red"}, "meshes.a/b", "A-Z a-z 0-9"),
    "missing mesh": (("meshes", "vase", "file"), "vaze.ply", "meshes.vase.file", "did you mean 'vase.ply'"),
    "unsupported mesh": (("meshes", "vase", "file"), "notes.txt", "meshes.vase.file", ".obj"),
    "mesh with both": (("meshes", "chair", "material"), "red", "meshes.chair", "both"),
    "mesh with neither": (("meshes", "vase", "material"), None, "meshes.vase", "neither"),
    "mesh of unknown material": (
        ("meshes", "vase", "material"),
        "wite",
        "meshes.vase.material",
        "did you mean 'white'",
    ),
    "part of unknown material": (
        ("meshes", "chair", "parts", "legs"),
        "woof",
        "meshes.chair.parts.legs",
        "did you mean 'wood'",
    ),
    "truth outside": (("truth",), "../truth.yaml", "truth", "outside the dataset"),
    "focal of no camera": ((*P0, "camera"), {"focal_px": 1e300}, "photos[0].camera.focal_px", "1e+300"),
    "focal of a hundredth": ((*P0, "camera"), {"focal_px": 0.01}, "photos[0].camera.focal_px", ".01"),
    "centre far outside": (
        (*P0, "camera"),
        {"principal_point": [1e9, 0.0]},
        "photos[0].camera.principal_point",
        "1e+09",
    ),
    "pose beyond all": (
        (*O0, "pose"),
        {"rotation": TURN, "translation": [0, 0, 1e300]},
        "photos[0].objects[0].pose.translation[2]",
        "1e+300",
    ),
    "turn beyond all": (
        (*P0, "world_from_camera"),
        [[1e300, 0, 0], [0, 1, 0], [0, 0, 1]],
        "photos[0].world_from_camera[0][0]",
        "1e+300",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_dataset_is_refused_with_file_key_and_cure(folder, name):
    path, value, key, words = BAD[name]
    (folder / "link.jpg").symlink_to(folder.parent / "outside.jpg")
    before = sorted(folder.parent.rglob("*"))
    with pytest.raises(InputError) as caught:
        read_dataset(write(folder, changed(*path, value=value)))
    assert caught.value.key == key and str(caught.value.file).endswith("set/dataset.yaml") and caught.value.cure
    assert words in str(caught.value)
    assert sorted(folder.parent.rglob("*")) == sorted([*before, folder / "dataset.yaml"]), "something was written"


def test_photos_of_one_light_agree_on_its_frame(folder):
    spec = copy.deepcopy(SPEC)
    for photo in spec["photos"][:2]:
        photo["illumination"] = "studio"
    spec["photos"][0]["world_from_camera"] = TURN
    with pytest.raises(InputError, match="'studio'") as caught:
        read_dataset(write(folder, spec))
    assert caught.value.key == "photos[1].world_from_camera"
    spec["photos"][1]["world_from_camera"] = TURN
    dataset = read_dataset(write(folder, spec))
    assert dataset_slice(dataset, "light", "garden").facts == {"illumination": "studio", "world_from_camera": TURN}


@pytest.mark.parametrize("name", ["studies", "bench", "store"])
def test_names_of_build_are_no_datasets(folder, name):
    write(folder)
    with pytest.raises(InputError, match=name):
        read_dataset(folder.rename(folder.parent / name))


def test_no_dataset_there(tmp_path):
    with pytest.raises(InputError, match="no such dataset") as caught:
        read_dataset(tmp_path)
    assert "dataset.yaml" in str(caught.value.file) and caught.value.cure


TEXT = """format: 1
materials: [red]
meshes: {vase: {file: vase.ply, material: red}}
photos:
- name: kitchen
  image: kitchen.jpg
  masks: kitchen.png
  objects: [{name: vase, mesh: vase}]
"""


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("mesh: vase}", "mehs: vase}", ["mehs", "did you mean 'mesh'"]),
        ("masks:", "mask:", ["mask", "did you mean 'masks'"]),
        ("  masks: kitchen.png\n", "", ["masks"]),
        ("  image: kitchen.jpg\n", "  image: kitchen.jpg\n  image: garden.exr\n", ["image"]),
        ("materials: [red]", "materials: red", ["materials"]),
        ("photos:", "photos: [", ["dataset.yaml"]),
        ("format: 1", "format: one", ["format"]),
    ],
)
def test_bad_yaml_is_refused(folder, old, new, words):
    (folder / "dataset.yaml").write_text(TEXT)
    read_dataset(folder)
    (folder / "dataset.yaml").write_text(TEXT.replace(old, new))
    with pytest.raises(InputError) as caught:
        read_dataset(folder)
    assert "dataset.yaml" in str(caught.value.file)
    assert all(word in str(caught.value) for word in words), str(caught.value)
