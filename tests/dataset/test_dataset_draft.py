"""`make new`: a dataset.yaml of folders of files, that says what it does not know instead of guessing."""

import json
import shutil

import msgspec
import numpy as np
import pytest
from PIL import Image

from factorlib.dataset.read_dataset import read_dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.dataset_draft import new_dataset
from factorlib.labels.label_image import read_labels
from factorlib.validation import Validation
from factorlib.yamlfile import load_yaml
from tests.faults.sample import put
from tests.refusal import refusal

OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\ng shell\nf 1 2 3\nf 1 3 4\ng legs\nf 1 2 4\nf 2 3 4\n"
LABEL, SHELL, LEGS = [0, 1, 2, 255], [0, 255], [255, 0]


@pytest.fixture
def folder(tmp_path):
    """Photos and a mesh of two parts."""
    for name in ("photos", "masks", "meshes"):
        (tmp_path / name).mkdir()
    for photo in ("kitchen.jpg", "IMG 0412.png"):
        Image.fromarray(np.full((8, 10, 3), 90, np.uint8)).save(tmp_path / "photos" / photo)
    (tmp_path / "meshes" / "chair.obj").write_text("mtllib chair.mtl\n" + OBJ)
    (tmp_path / "meshes" / "chair.mtl").write_text("newmtl oak\n")
    return tmp_path


def masks(folder, **values):
    """A mask for each name, `__` in it for `/`."""
    for name, own in values.items():
        path = put(folder / "masks" / f"{name.replace('__', '/')}.png", "")
        Image.fromarray(np.resize(np.array(own, np.uint8), (8, 10))).save(path)


def made(folder, masks="masks", meshes="meshes"):
    """What is missing, and what dataset.yaml says."""
    missing = new_dataset(folder / "data" / "mine", *(name and folder / name for name in ("photos", masks, meshes)))
    return missing, load_yaml(folder / "data" / "mine" / "dataset.yaml")


def test_labels_become_materials_parts_are_left_open_and_a_further_mask_is_the_silhouette_of_an_object(folder):
    masks(folder, kitchen=LABEL, kitchen_left=[0, 1, 0], kitchen_right=[0, 0, 1], IMG_0412=[0, 1])
    missing, spec = made(folder)
    assert spec["materials"] == ["label_1", "label_2"]
    assert spec["meshes"] == {"chair": {"file": "meshes/chair.obj", "parts": {"shell": "?", "legs": "?"}}}
    assert [photo["name"] for photo in spec["photos"]] == ["IMG_0412", "kitchen"]
    assert [line.split(" (")[0] for line in missing] == [
        f"mesh chair: write which material {part} is made of" for part in ("shell", "legs")
    ]
    objects = [{"name": n, "mesh": "chair", "mask": f"masks/kitchen_{n}.png"} for n in ("left", "right")]
    assert spec["photos"][1]["objects"] == objects
    assert spec["photos"][0]["objects"] == [{"name": "chair", "mesh": "chair"}]
    refusal(r"\?", read_dataset, folder / "data" / "mine")


@pytest.mark.parametrize("kind", ["soft", "255", "transparent", "photo"])
def test_a_mask_without_labels_is_the_silhouette_of_one_material_and_that_is_said(folder, kind):
    grey = np.linspace(0, 255, 80).astype(np.uint8).reshape(8, 10)
    grey = {"255": np.where(grey > 127, 255, 0).astype(np.uint8)}.get(kind, grey)
    pixels = np.dstack([grey[::-1]] * 3 + [grey]) if kind in ("transparent", "photo") else grey
    for photo in ("kitchen", "IMG 0412"):
        Image.fromarray(pixels).save(folder / ("photos" if kind == "photo" else "masks") / f"{photo}.png")
    (folder / "photos" / "kitchen.jpg").unlink(missing_ok=kind != "photo")
    if kind != "photo":
        Image.fromarray(pixels).convert("RGB").save(folder / "photos" / "kitchen.jpg")
    (folder / "meshes" / "chair.obj").write_text(OBJ.replace("g ", "# "))  # without a name, as trimesh writes it
    missing, spec = made(folder, masks=None if kind == "photo" else "masks")
    assert spec["meshes"] == {"chair": {"file": "meshes/chair.obj", "material": "label_1"}}
    assert spec["materials"] == ["label_1"] and all(
        "cut at half, it is the silhouette of label_1" in line for line in missing
    )
    dataset = read_dataset(folder / "data" / "mine")
    inside = read_labels(dataset.photo("kitchen").masks, lambda name: dataset.folder / name, ["label_1"], (8, 10), "")
    assert np.array_equal(inside.label, grey > 127)


def test_masks_of_labelme_and_of_cvat_are_copied_and_name_the_materials(folder):
    for photo in ("kitchen", "IMG 0412"):
        shapes = [{"label": name, "points": [[1, 1], [5, 1], [5, 5]]} for name in ("shell", "legs")]
        (folder / "masks" / f"{photo}.json").write_text(json.dumps({"shapes": shapes}))
    _, spec = made(folder)
    assert spec["materials"] == ["shell", "legs"] and spec["photos"][1]["masks"] == "masks/kitchen.json"
    shutil.rmtree(folder / "data")
    shutil.rmtree(folder / "masks")
    masks(folder, SegmentationClass__kitchen=[0], SegmentationClass__IMG_0412=[0], SegmentationObject__kitchen=[0])
    (folder / "masks" / "labelmap.txt").write_text("background:0,0,0::\nshell:9,0,0::\nlegs:0,9,0::\n")
    _, spec = made(folder)
    assert spec["materials"] == ["shell", "legs"]
    assert spec["photos"][1]["masks"] == "masks/SegmentationClass/kitchen.png"
    assert "masks/labelmap.txt" in dataset_slice(read_dataset(folder / "data" / "mine"), "photo", "kitchen").files


def test_a_mask_for_each_material_names_the_parts_and_nothing_is_missing_but_pictures_of_other_kinds(folder):
    for name in [
        "good.webp",
        "kitchen_mask.webp",
        "thumbnail.bmp",
        "depth/7.webp",
        "images_2/8.gif",
        "masks/9.gif",
        "b.AVIF",
    ]:
        put(folder / "photos" / name, "")
    masks(folder, kitchen_shell=SHELL, IMG_0412_shell=SHELL, kitchen__legs=LEGS, IMG_0412__legs=LEGS)
    missing, spec = made(folder)
    kinds = "left out, for photos of this kind are not read: b.AVIF, good.webp; save them as PNG or JPEG"
    assert missing == [kinds] and spec["materials"] == ["legs", "shell"]
    assert spec["meshes"]["chair"]["parts"] == {"shell": "shell", "legs": "legs"}
    dataset = read_dataset(folder / "data" / "mine")  # a good data set as it stands
    assert dataset.photo("kitchen").masks == {"legs": "masks/kitchen/legs.png", "shell": "masks/kitchen_shell.png"}
    assert (folder / "data" / "mine" / "meshes" / "chair.mtl").is_file()
    for more, cautions in ([], []), (["oak"], ["no mask shows 'oak': remove it, or it is guessed"]):
        named = msgspec.structs.replace(dataset.spec, materials=[*dataset.spec.materials, *more])
        validation = Validation(msgspec.structs.replace(dataset, spec=named))
        assert validation.faults([("photo", None, {}, folder)]) == [] and validation.cautions() == cautions


@pytest.mark.parametrize("photos, files, expected", [
    ("front/7 back/7", "front/7.png back/7.jpg.png", {"front_7": "front/7.png", "back_7": "back/7.jpg.png"}),
    ("rig/front/7 rig/back/7", "front/7.bmp back/7_mask.png", {"rig_front_7": "front/7.bmp", "rig_back_7": "back/7_mask.png"}),
    ("front/7 back/7", "rig/front/7.png 7.png", {"front_7": "rig/front/7.png", "back_7": "back_7.png"}),
    ("front/7 back/7", "front/7_oak.png back/7/oak.png", {"front_7": {"oak": "front/7_oak.png"}, "back_7": {"oak": "back/7/oak.png"}}),
    ("front/7 8", "7.tif 8.gif", {"8": "8.gif"}),
    ("ku\u0308che", "k\u00fcche.png", {"k_che": "k\u00fcche.png"}),
])  # fmt: skip
def test_masks_in_folders_are_those_of_the_photos_in_such_folders(folder, photos, files, expected):
    shutil.rmtree(folder / "photos")
    for name in [*(f"photos/{photo}.png" for photo in photos.split()), *(f"masks/{file}" for file in files.split())]:
        Image.fromarray(np.resize(np.uint8([0, 1]), (8, 10))).save(put(folder / name, ""))
    named = {photo["name"]: photo["masks"] for photo in made(folder, meshes=None)[1]["photos"]}
    assert json.loads(json.dumps(named).replace("masks/", "")) == expected


def test_a_coco_file_names_the_materials_of_all_photos_and_what_is_no_name_is_to_be_renamed(folder):
    outline = {"category_id": 1, "segmentation": [[1, 1, 5, 1, 5, 5]]}
    coco = {
        "images": [{"id": 0, "file_name": "kitchen.jpg"}, {"id": 1, "file_name": "IMG 0412.png"}],
        "annotations": [outline | {"id": k, "image_id": k} for k in (0, 1)],
        "categories": [
            {"id": 1, "name": "red shell", "supercategory": "chairs"},
            {"id": 2, "name": "legs"},
            {"id": 0, "name": "chairs", "supercategory": "none"},  # as Roboflow names its project
        ],
    }
    (folder / "masks" / "all.json").write_text(json.dumps(coco))
    (folder / "meshes" / "chair.obj").write_text(OBJ.replace("g shell", "g red_shell"))
    missing, spec = made(folder)
    assert missing == [
        "masks/all.json: rename its category 'red shell' to 'red_shell': names are made of A-Z a-z 0-9 _ and -"
    ]
    assert spec["materials"] == ["red_shell", "legs"] and {p["masks"] for p in spec["photos"]} == {"masks/all.json"}
    dataset = read_dataset(folder / "data" / "mine")
    arguments = "photo", None, {}, folder / "pipeline.yaml"
    faults = Validation(dataset).faults([arguments])
    assert ["category 'red shell' is not a material" in str(fault) for fault in faults] == [True, True]
    file = folder / "data" / "mine" / "masks" / "all.json"
    file.write_text(file.read_text().replace("red shell", "red_shell"))
    assert Validation(dataset).faults([arguments]) == []


def test_without_a_mesh_a_hull_by_structure_from_motion_is_written_and_that_is_said(folder):
    masks(folder, kitchen=[0, 1, 2], IMG_0412=[0, 1])
    missing, spec = made(folder, meshes=None)
    assert [line.split(":")[0] for line in missing] == ["there is no mesh"] and "lathe: true" in missing[0]
    dataset = read_dataset(folder / "data" / "mine")
    assert dataset.spec.cameras.sfm and dataset.spec.meshes["thing"].hull
    assert dataset.spec.meshes["thing"].parts == {"label_1": "label_1", "label_2": "label_2"}
    assert [[obj.mesh for obj in photo.objects] for photo in dataset.spec.photos] == [["thing"], ["thing"]]


def test_an_object_is_of_the_mesh_that_its_mask_names(folder):
    """And a photo whose masks are named as a mesh or its parts shows that mesh."""
    (folder / "meshes" / "stool.obj").write_text(OBJ.replace("shell", "seat").replace("legs", "feet"))
    masks(folder, kitchen=LABEL, kitchen_old_stool=[0, 1, 0], kitchen_chair=[0, 0, 1])
    _, spec = made(folder)
    assert {obj["name"]: obj["mesh"] for obj in spec["photos"][1]["objects"]} == {
        "old_stool": "stool",
        "chair": "chair",
    }
    shutil.rmtree(folder / "data")
    shutil.rmtree(folder / "masks")
    masks(folder, kitchen_seat=SHELL, IMG_0412_shell=SHELL)
    _, spec = made(folder)
    assert [[obj["mesh"] for obj in photo["objects"]] for photo in spec["photos"]] == [["chair"], ["stool"]]


def test_a_folder_that_is_there_is_left_alone_and_nothing_half_made_stays(folder):
    (folder / "data" / "mine").mkdir(parents=True)
    refusal("exists already", made, folder)
    (folder / "data" / "mine").rmdir()
    (folder / "meshes" / "broken.obj").write_text("v 1 2\nf 1 2 3\n")
    refusal(r"broken\.obj", made, folder)
    assert not list((folder / "data").iterdir())


@pytest.mark.parametrize("kind", ["photos", "masks", "meshes"])
def test_a_link_is_refused_for_it_may_lead_to_what_is_not_to_be_copied(folder, kind):
    masks(folder, kitchen=LABEL)
    file = next(path for path in sorted((folder / kind).iterdir()) if path.suffix != ".mtl")
    file.rename(folder / "secret")
    file.symlink_to(folder / "secret")
    assert refusal("is a link", made, folder).file == file and not (folder / "data" / "mine").exists()
