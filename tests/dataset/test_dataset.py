"""Datasets: what is good is read, each fault is refused with file, key and cure, and slices are small."""

import copy
import json
import re

import msgspec
import pytest
import yaml

from factorlib.dataset import schema
from factorlib.dataset.read_dataset import hold_out, read_dataset
from factorlib.dataset.slices import SLICES, dataset_slice
from factorlib.validation import Validation
from tests.faults.sample import edited, put
from tests.refusal import refusal

TURN = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
MIRROR = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]
POSE = {"rotation": TURN, "translation": [0, 0, 2.5]}
FILES = {
    **dict.fromkeys(["kitchen.jpg", "garden.exr", "kitchen.png", "red.png", "coco.json", "own.png"], ""),
    **dict.fromkeys(["vase.ply", "notes.txt", "box 1.bin"], ""),
    "chair.obj": "# a chair\nmtllib chair.mtl\nusemtl shell\n",
    "chair.mtl": "newmtl shell\n",
    "box.gltf": json.dumps(
        {
            "asset": {"version": "2.0"},
            "buffers": [{"uri": "box%201.bin", "byteLength": 0}, {"uri": "data:,x", "byteLength": 1}],
        }
    ),
}
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
                {"name": "vase_1", "mesh": "vase", "pose": POSE},
            ],
        },
        {
            "name": "garden",
            "image": "garden.exr",
            "masks": {"red": "red.png"},
            "objects": [{"name": "a", "mesh": "chair"}],
        },
        {"name": "hall", "image": "kitchen.jpg", "masks": "coco.json", "objects": [{"name": "box_1", "mesh": "box"}]},
    ],
}


@pytest.fixture
def folder(tmp_path):
    for name, content in FILES.items():
        put(tmp_path / "set" / name, content)
    return tmp_path / "set"


def write(folder, spec=SPEC):
    return put(folder / "dataset.yaml", yaml.safe_dump(spec, sort_keys=False)).parent


def changed(key, value):
    """SPEC with another value at a key as errors write it, as in photos[0].camera."""
    return edited(SPEC, *(int(s) if s.isdigit() else s for s in re.findall(r"[^.\[\]]+", key)), value=value)


def test_a_slice_is_json_converts_to_its_type_and_names_the_files_it_needs(folder):
    dataset = read_dataset(write(folder))
    types = {
        "photo": schema.PhotoSlice,
        "objects": schema.ObjectsSlice,
        "light": schema.LightSlice,
        "set": schema.SetSlice,
    }
    slices = {name: dataset_slice(dataset, name, "kitchen") for name in SLICES}
    for name, one in slices.items():
        assert json.loads(json.dumps(one.facts)) == one.facts
        assert msgspec.to_builtins(msgspec.convert(one.facts, types.get(name, object))) is not None or name in (
            "truth",
            "shapes",
        )
    assert slices["photo"].files == ["kitchen.jpg", "kitchen.png", "own.png"]
    assert slices["objects"].files == ["chair.mtl", "chair.obj", "own.png", "vase.ply"]
    assert not any(slices[name].files for name in ("materials", "light", "set", "shapes", "truth"))
    assert dataset_slice(dataset, "objects", "hall").files == ["box 1.bin", "box.gltf"]
    files = ["coco.json", "garden.exr", "kitchen.jpg", "kitchen.png", "own.png", "red.png"]
    assert dataset_slice(dataset, "photo").files == files
    (folder / "chair.mtl").unlink()  # which is not needed
    assert dataset_slice(read_dataset(folder), "objects", "garden").files == ["chair.obj"]


def test_labels_of_one_name_are_one_material(folder):
    dataset = read_dataset(write(folder, changed("materials", ["red", "white", "red", "wood"])))
    slices = {name: dataset_slice(dataset, name, "kitchen").facts for name in ("materials", "set", "photo")}
    assert slices["materials"] == slices["set"]["materials"] == ["red", "white", "wood"]
    assert slices["photo"]["labels"] == ["red", "white", "red", "wood"]


def test_a_hull_that_names_no_material_has_a_part_of_each(folder):
    spec = changed("meshes.vase", {"hull": True})
    dataset = read_dataset(
        write(folder, spec | {"materials": ["red", "white", "red", "wood"], "cameras": {"sfm": True}})
    )
    assert dataset.spec.meshes["vase"].parts == {name: name for name in ("red", "white", "wood")}


def test_a_slice_holds_what_its_readers_need_and_no_more(folder):
    before = read_dataset(write(folder))
    photos = SPEC["photos"][::-1] + [{**SPEC["photos"][1], "name": "attic"}]
    reordered = read_dataset(write(folder, SPEC | {"photos": photos}))
    posed = read_dataset(write(folder, changed("photos[0].objects[1].pose.translation", [0, 0, 3])))
    default = read_dataset(write(folder, changed("photos[1].illumination", "garden")))  # written out
    pairs = [(name, photo) for name in SLICES for photo in ("kitchen", "garden", "hall")]
    differ = [[pair[0] for pair in pairs if dataset_slice(before, *pair) != dataset_slice(after, *pair)]
              for after in (reordered, posed, default)]  # fmt: skip
    assert differ == [["set"] * 3, ["objects"], []]


TRUTH = {
    "materials": {"red": {"diffuse": [0.5, 0.1, 0.1], "specular": [0.1, 0.1, 0.1], "roughness": 0.3}},
    "illumination": {"garden": "truth/garden.exr"},
    "poses": {"kitchen": {"vase_1": POSE}},
}


def write_truth(folder, truth):
    put(folder / "truth" / "truth.yaml", yaml.safe_dump(truth))
    put(folder / "truth" / "garden.exr", "")
    return write(folder, {**SPEC, "truth": "truth/truth.yaml"})


def test_truth_is_its_own_slice_and_a_warning_where_it_is_missing(folder, caplog):
    plain, dataset = read_dataset(write(folder)), read_dataset(write_truth(folder, TRUTH))
    truth = dataset_slice(dataset, "truth")
    assert truth.files == ["truth/garden.exr"]
    assert msgspec.convert(truth.facts, schema.TruthFile).materials["red"].roughness == 0.3
    assert all(dataset_slice(plain, name) == dataset_slice(dataset, name) for name in SLICES if name != "truth")
    for missing in ("truth/garden.exr", "truth/truth.yaml"):
        (folder / missing).unlink()
        assert dataset_slice(read_dataset(folder), "truth").facts is None and missing in caplog.text


@pytest.mark.parametrize("truth, key, cure", [
    ({"materials": {"rde": TRUTH["materials"]["red"]}}, "materials.rde", "did you mean 'red'"),
    ({"illumination": {"gardn": "truth/garden.exr"}}, "illumination.gardn", "did you mean 'garden'"),
    ({"normals": {"hal": "truth/garden.exr"}}, "normals.hal", "did you mean 'hall'"),
    ({"albedo": {"hal": "truth/garden.exr"}}, "albedo.hal", "did you mean 'hall'"),
    ({"poses": {"kitchen": {"vase_2": POSE}}}, "poses.kitchen.vase_2", "did you mean 'vase_1'"),
    ({"illumination": {"garden": "../outside.exr"}}, "illumination.garden", "copy the file"),
])  # fmt: skip
def test_wrong_truth_is_refused(folder, truth, key, cure):
    caught = refusal(".", read_dataset, write_truth(folder, truth))
    assert "truth.yaml" in str(caught.file) and caught.key == key and cure in caught.cure


# ── bad ones: the key of the message, (what stands there, words in it); "key > inner": the message names the inner one ───

NAN, INF, K0 = float("nan"), float("inf"), "photos[0].objects[0].keypoints"
KEYPOINTS = [{"pixel": [float(x), float(y)], "point": [float(a), float(b), float(c)]}
             for x, y, a, b, c in ((1, 1, 0, 0, 0), (5, 1, 1, 0, 0), (5, 4, 1, 1, 0), (1, 4, 0, 1, 1))]  # fmt: skip
ON_A_LINE = [{"pixel": k["pixel"], "point": [0.1 * n, 0.2 * n, 0]} for n, k in enumerate(KEYPOINTS)]
BAD = [
    ("format", 2, "format: 1"),
    ("materials", [], "1 to 254"),
    ("materials", [f"m{k}" for k in range(255)], "1 to 254"),
    ("materials > [3]", ["red", "white", "wood", "a b"], "A-Z a-z 0-9"),
    ("photos", [], "at least one"),
    ("photos[1].objects", [], "no objects"),
    ("photos[1].name", "kitchen", "photos[0] has it already"),
    ("photos[1].name", "poses", "rename the photo"),
    ("photos[0].image", "kitchn.jpg", "did you mean 'kitchen.jpg'"),
    ("photos[0].image", "notes.txt", ".jpg"),
    ("photos[0].image", "", "outside the dataset"),
    ("photos[0].masks", "masks/gone.png", "masks/gone.png"),
    ("photos[0].masks", "notes.txt", ".png, .jpg"),
    ("photos[1].masks.red", "gone.png", "gone.png"),
    ("photos[1].masks.red", "garden.exr", "of a Cryptomatte, export the matte"),
    ("photos[0].image", "Kitchen.JPG", "did you mean 'kitchen.jpg'"),
    ("photos[0].image", "C:\\photos\\kitchen.jpg", "name it relative to"),
    ("photos[0].masks", "\\\\server\\kitchen.png", "name it relative to"),
    ("photos[1].masks", {}, "COCO"),
    ("photos[1].masks.rde", "red.png", "did you mean 'red'"),
    ("photos[0].encoding", "sgrb", "srgb"),
    ("photos[0].camera.focal_px", 0.0, "give finite pixels"),
    ("photos[0].camera.principal_point > [1]", [1.0, INF], "finite"),
    ("photos[0].objects[1].name", "chair_1", "objects[0] has it already"),
    ("photos[0].objects[0].mesh", "chiar", "did you mean 'chair'"),
    ("photos[0].objects[0].materials.shel", "red", "did you mean 'shell'"),
    ("photos[0].objects[0].materials.shell", "whit", "did you mean 'white'"),
    ("photos[0].objects[1].materials.lid", "red", "'vase'"),
    ("photos[0].objects[0].mask", "owm.png", "did you mean 'own.png'"),
    ("photos[0].objects[0].pose > .rotation", {**POSE, "rotation": [*TURN[:2], [0, 2.0, 0]]}, "unit vectors"),
    ("photos[0].objects[0].pose > .rotation", {**POSE, "rotation": MIRROR}, "reflection"),
    ("photos[0].objects[0].pose > .translation[1]", {**POSE, "translation": [0, NAN, 1]}, "finite"),
    (K0, KEYPOINTS[:3], "give 4 or more"),
    (K0, ON_A_LINE, "all points lie on one line"),
    (f"{K0} > [4].pixel", [*KEYPOINTS, {"pixel": KEYPOINTS[1]["pixel"], "point": [9, 9, 9]}], "keypoints[1]"),
    (f"{K0} > [3].pixel[1]", [*KEYPOINTS[:3], {"pixel": [9, NAN], "point": [0, 0, 1]}], "finite"),
    ("photos[0].objects[1].keypoints", KEYPOINTS, "keep one"),
    ("photos[0].world_from_camera", MIRROR, "reflection"),
    ("photos[0].world_from_camera > [0][0]", [[1e300, 0, 0], [0, 1, 0], [0, 0, 1]], "1e+300"),
    ("photos[0].ground > .normal", {"point": [0, 0, 1], "normal": [0, 0, 0]}, "points up"),
    ("photos[0].ground > .normal", {"point": [0, 0, 1], "normal": [0, 0, 1]}, "negate it"),
    ("photos[0].ground > .diffuse[0]", {"point": [0, 0, 1], "normal": [0, 0, -1], "diffuse": [2, 0, 0]}, "0 to 1"),
    ("meshes.a/b", {"file": "vase.ply", "material": "red"}, "A-Z a-z 0-9"),
    ("meshes.vase.file", "vaze.ply", "did you mean 'vase.ply'"),
    ("meshes.vase.file", "notes.txt", ".obj"),
    ("meshes.chair > ", {"file": "chair.obj", "material": "red", "parts": {"shell": "red"}}, "both"),
    ("meshes.vase > ", {"file": "vase.ply"}, "neither"),
    ("meshes.vase > ", {"material": "red"}, "exactly one of file"),
    ("meshes.vase > ", {"file": "vase.ply", "hull": True, "material": "red"}, "file and hull"),
    ("meshes.vase > .size", {"hull": True, "material": "red", "size": 2.0}, "leave it out"),
    ("meshes.vase > .hull", {"hull": True, "material": "red"}, "a hull needs at least two"),
    ("meshes.vase > .size", {"lathe": True, "material": "red", "size": 0.0}, "more than 0"),
    ("meshes.vase > .primitive", {"primitive": "cone", "material": "red"}, "cone"),
    ("meshes.vase > ", {"lathe": True, "hull": True, "material": "red"}, "hull and lathe"),
    ("meshes.chair > .parts", {"lathe": True, "parts": {"shell": "red"}}, "one part"),
    ("cameras > ", {"sfm": True, "colmap": "sparse"}, "colmap and sfm"),
    ("cameras > .world_from_camera", {"sfm": True, "world_from_camera": True}, "not known beforehand"),
    ("cameras > .up", {"sfm": True, "up": "z"}, "not known beforehand"),
    ("cameras > .up", {"colmap": "sparse", "up": "z"}, "add world_from_camera: true"),
    ("cameras > .up", {"colmap": "sparse", "world_from_camera": True, "up": "up"}, "x, y, z, -x"),
    ("meshes.vase.material", "wite", "did you mean 'white'"),
    ("meshes.chair.parts.legs", "woof", "did you mean 'wood'"),
    ("known > .materials.rde", {"materials": {"rde": {"diffuse": [0.5] * 3}}}, "did you mean 'red'"),
    ("known > .materials.red.diffuse[1]", {"materials": {"red": {"diffuse": [0.5, 128, 0.5]}}}, "0 to 1"),
    ("known > .materials.red", {"materials": {"red": {"diffuse": [0.5, 0, 0.5]}}}, "reflects nothing"),
    ("known > .materials.red", {"materials": {"red": {"diffuse": [0.7] * 3, "specular": [0.4] * 3}}}, "1.1 together"),
    ("known > .materials.red.kind", {"materials": {"red": {"kind": "velvet"}}}, "fabric"),
    ("known > .materials.red", {"materials": {"red": {"kind": "metal", "roughness": 0.3}}}, "diffuse reflectance is"),
    ("known > .materials.red", {"materials": {"red": {}}}, "or `kind` alone"),
    ("known > .illumination.kitchn", {"illumination": {"kitchn": "map.exr"}}, "did you mean 'kitchen'"),
    ("known > .illumination.kitchen", {"illumination": {"kitchen": "kitchen.png"}}, ".exr, .hdr"),
    ("known > .illumination.kitchen.chrome", {"illumination": {"kitchen": {"chrome": "bal"}}}, "unknown object 'bal'"),
    ("known > .illumination.kitchen.chrome", {"illumination": {"kitchen": {"chrome": "chair_1"}}}, "not a ball of one"),
    ("known > .illumination.kitchen.chrome", {"illumination": {"kitchen": {"chrome": "vase_1"}}}, "white' too"),
    ("known > .illumination.hall.chrome", {"illumination": {"hall": {"chrome": "box_1"}}}, "specular reflectance of"),
    ("known > .exposure.hal", {"exposure": {"hal": 1}}, "did you mean 'hall'"),
    ("known > .materials.red.roughness", {"materials": {"red": {"diffuse": [0.5] * 3, "roughness": 0.0}}}, "0.1 to 1"),
]


@pytest.mark.parametrize("key, value, words", BAD)
def test_bad_dataset_is_refused_with_file_key_and_cure(folder, key, value, words):
    outer, _, inner = key.partition(" > ")
    before = sorted(folder.parent.rglob("*"))
    caught = refusal(".", read_dataset, write(folder, changed(outer, value)))
    assert caught.key == outer + inner and caught.cure and words in str(caught)
    assert re.search(r"set/dataset\.yaml(:\d+)?$", str(caught.file))
    assert sorted(folder.parent.rglob("*")) == sorted([*before, folder / "dataset.yaml"]), "something was written"


@pytest.mark.parametrize("path, disk", [
    ("photos\\hall.jpg", "photos/hall.jpg"), ("a\\b.jpg", "a\\b.jpg"),
    ("\u00fc/k\u00fcche.jpg", "u\u0308/ku\u0308che.jpg"), ("u\u0308\\ku\u0308che.jpg", "\u00fc/k\u00fcche.jpg"),
])  # fmt: skip
def test_a_path_is_found_with_backslashes_and_in_either_form_of_unicode(folder, path, disk):
    put(folder / disk, "")
    assert read_dataset(write(folder, changed("photos[0].image", path))).photo("kitchen").image == disk


def test_photos_held_out_by_the_file_or_for_one_run_exist_and_leave_one_to_solve_from(folder):
    spec = changed("photos[1].held_out", True)
    dataset = read_dataset(write(folder, spec))
    some = hold_out(dataset, ["hall,garden"])
    assert [photo.held_out for photo in some.spec.photos] == [False, True, True]
    assert hold_out(some, []) == some and hold_out(dataset, ["hall"]) == some
    for names, words in (["attic"], "no photo 'attic'"), (["kitchen"], "none is left to solve from"):
        error = refusal(words, hold_out, some, names)
        assert error.key == "HELD_OUT" and "kitchen, garden, hall" in error.cure
    for photo in spec["photos"]:
        photo["held_out"] = True
    assert refusal("none is left to solve from", read_dataset, write(folder, spec)).key == "photos"


@pytest.mark.parametrize("count, test", [(7, None), (8, "p4"), (9, "p4")])
def test_of_eight_photos_in_a_light_the_middle_one_is_predicted_before_it_rejoins_unless_the_user_says_otherwise(
    folder, count, test
):
    spec = copy.deepcopy(SPEC)
    photo = spec["photos"][0] | {"illumination": "room"}
    spec["photos"] = [photo | {"name": f"p{k}"} for k in range(count)]
    dataset = read_dataset(write(folder, spec))
    facts = dataset_slice(hold_out(dataset, []), "light").facts
    apart = {"held_out": True, "rejoins": True}
    plain = {"illumination": "room", "world_from_camera": None}
    assert facts == {f"p{k}": plain | (apart if f"p{k}" == test else {}) for k in range(count)}
    given = msgspec.convert(facts, dict[str, schema.LightSlice])
    assert schema.solved_photos(schema.with_all_rejoined(given)) == list(facts)
    for words, own in (["none"], None), (["p1"], "p1"):
        facts = dataset_slice(hold_out(dataset, words), "light").facts
        assert facts == {f"p{k}": plain | ({"held_out": True} if f"p{k}" == own else {}) for k in range(count)}
    spec["photos"][count // 2]["objects"] = [spec["photos"][0]["objects"][0] | {"name": "seen_once"}]
    assert hold_out(read_dataset(write(folder, spec)), []).test_photo in (("p3", "p5") if test else (None,))


def test_what_is_known_is_a_slice_of_maps_and_of_balls_with_their_materials(folder):
    spec = changed("photos[2].illumination", "kitchen")
    spec["known"] = {
        "materials": {"wood": {"diffuse": [0, 0, 0], "specular": [0.5, 0.5, 0.5]}},
        "illumination": {"garden": "garden.exr", "kitchen": {"chrome": "box_1"}},
    }
    caught = refusal("2 photos of unknown exposure", read_dataset, write(folder, spec))
    spec["known"]["exposure"] = {"kitchen": 1.0}
    refusal("'hall', of the same light, has none", read_dataset, write(folder, spec))
    spec["known"]["exposure"]["hall"] = -1
    known = dataset_slice(read_dataset(write(folder, spec)), "known")
    assert caught.key == "known.illumination.kitchen.chrome" and known.files == ["garden.exr"]
    slice_ = msgspec.convert(known.facts, schema.KnownSlice)
    assert slice_.balls == {"kitchen": schema.BallSlice("hall", "wood")} and slice_.maps == {"garden": "garden.exr"}
    (folder / "box.obj").write_text("v 0 0 0\nv 1 0 0\nv .2 2 0\nf 1 2 3\n")
    spec["meshes"]["box"] = {"file": "box.obj", "material": "wood"}
    faults = Validation(read_dataset(write(folder, spec))).faults([("known", None, {}, folder)])
    assert [fault.key for fault in faults] == ["known.illumination.garden", "known.illumination.kitchen.chrome"]
    assert "it is not a ball" in str(faults[1])
    spec["materials"].append("gold")
    spec["known"]["materials"]["gold"] = {"diffuse": [0.5, 0.4, 0.1]}
    refusal("no object is made of material 'gold'", read_dataset, write(folder, spec))


def test_photos_of_one_light_agree_on_its_frame(folder):
    spec = changed("photos[0].illumination", "studio")
    spec["photos"][0] |= {"world_from_camera": TURN}
    spec["photos"][1] |= {"illumination": "studio"}
    assert refusal("'studio'", read_dataset, write(folder, spec)).key == "photos[1].world_from_camera"
    spec["photos"][1] |= {"world_from_camera": TURN}
    facts = dataset_slice(read_dataset(write(folder, spec)), "light", "garden").facts
    assert facts == {"illumination": "studio", "world_from_camera": TURN}
