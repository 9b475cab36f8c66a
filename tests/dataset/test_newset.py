"""`make new`: a dataset.yaml of folders of files, that says what it does not know instead of guessing."""

import json

import numpy as np
import pytest
from PIL import Image

from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError
from factorlib.newset import new_dataset
from factorlib.validation import Validation
from factorlib.yamlfile import load_yaml

OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\ng shell\nf 1 2 3\nf 1 3 4\ng legs\nf 1 2 4\nf 2 3 4\n"


@pytest.fixture
def folders(tmp_path):
    """Photos and a mesh of two parts."""
    for name in ("photos", "masks", "meshes"):
        (tmp_path / name).mkdir()
    for photo in ("kitchen.jpg", "IMG 0412.png"):
        Image.fromarray(np.full((8, 10, 3), 90, np.uint8)).save(tmp_path / "photos" / photo)
    (tmp_path / "meshes" / "chair.obj").write_text("mtllib chair.mtl\n" + OBJ)
    (tmp_path / "meshes" / "chair.mtl").write_text("newmtl oak\n")
    return tmp_path


def mask(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.resize(np.array(values, np.uint8), (8, 10))).save(path)


def made(folders, meshes="meshes"):
    missing = new_dataset(
        folders / "data" / "mine", folders / "photos", folders / "masks", folders / meshes if meshes else None
    )
    return missing, load_yaml(folders / "data" / "mine" / "dataset.yaml")


def test_labels_of_pixels_become_materials_and_parts_are_left_open(folders):
    mask(folders / "masks" / "kitchen.png", [0, 1, 2, 255])
    mask(folders / "masks" / "IMG_0412.png", [0, 1])
    missing, spec = made(folders)
    assert spec["materials"] == ["label_1", "label_2"]
    assert spec["meshes"] == {"chair": {"file": "meshes/chair.obj", "parts": {"shell": "?", "legs": "?"}}}
    assert [photo["name"] for photo in spec["photos"]] == ["IMG_0412", "kitchen"]
    assert missing == ["mesh chair: write which material shell, legs are made of"]
    with pytest.raises(InputError, match=r"\?"):
        read_dataset(folders / "data" / "mine")


def test_beside_labels_a_further_mask_is_the_silhouette_of_an_object(folders):
    mask(folders / "masks" / "kitchen.png", [0, 1, 2])
    mask(folders / "masks" / "kitchen_left.png", [0, 1, 0])
    mask(folders / "masks" / "kitchen_right.png", [0, 0, 1])
    mask(folders / "masks" / "IMG_0412.png", [0, 1])
    _, spec = made(folders)
    assert spec["photos"][1]["objects"] == [
        {"name": n, "mesh": "chair", "mask": f"masks/kitchen_{n}.png"} for n in ("left", "right")
    ]
    assert spec["photos"][0]["objects"] == [{"name": "chair", "mesh": "chair"}]


def test_a_mask_for_each_material_names_the_parts_and_nothing_is_missing(folders):
    for photo in ("kitchen", "IMG_0412"):
        mask(folders / "masks" / f"{photo}_shell.png", [0, 255])
        mask(folders / "masks" / photo / "legs.png", [255, 0])
    missing, spec = made(folders)
    assert missing == [] and spec["materials"] == ["legs", "shell"]
    assert spec["meshes"]["chair"]["parts"] == {"shell": "shell", "legs": "legs"}
    dataset = read_dataset(folders / "data" / "mine")  # a good data set as it stands
    assert dataset.photo("kitchen").masks == {"legs": "masks/kitchen/legs.png", "shell": "masks/kitchen_shell.png"}
    assert (folders / "data" / "mine" / "meshes" / "chair.mtl").is_file()


def test_a_coco_file_names_the_materials_of_all_photos(folders):
    coco = {"images": [], "annotations": [], "categories": [{"id": 1, "name": "shell"}, {"id": 2, "name": "legs"}]}
    (folders / "masks" / "all.json").write_text(json.dumps(coco))
    missing, spec = made(folders)
    assert (
        missing == []
        and spec["materials"] == ["shell", "legs"]
        and {p["masks"] for p in spec["photos"]} == {"masks/all.json"}
    )


def test_what_is_missing_is_listed(folders):
    mask(folders / "masks" / "kitchen.png", [0, 1])
    missing, spec = made(folders, meshes=None)
    assert missing == [
        "photo IMG_0412: no mask called IMG_0412.png or IMG_0412_<material>.png",
        "there is no mesh: give MESHES=<folder>; rough ones will do",
    ]
    assert spec["photos"][0]["masks"] == "?" and spec["photos"][1]["objects"] == []


def test_of_several_meshes_a_photo_shows_those_it_is_named_for(folders):
    mask(folders / "masks" / "kitchen.png", [0, 1])
    mask(folders / "masks" / "IMG_0412.png", [0, 1])
    (folders / "meshes" / "kitchen.obj").write_text(OBJ)
    missing, spec = made(folders)
    assert [photo["objects"] for photo in spec["photos"]] == [
        [{"name": "?", "mesh": "?"}],
        [{"name": "kitchen", "mesh": "kitchen"}],
    ]
    assert missing == ["photo IMG_0412: write which of the meshes it shows"]


def test_a_folder_that_is_there_is_left_alone_and_nothing_half_made_stays(folders):
    (folders / "data" / "mine").mkdir(parents=True)
    with pytest.raises(InputError, match="is there already"):
        made(folders)
    (folders / "data" / "mine").rmdir()
    (folders / "meshes" / "broken.obj").write_text("v 1 2\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"broken\.obj"):
        made(folders)
    assert not list((folders / "data").iterdir())


@pytest.mark.parametrize("key, break_", [("PHOTOS", "photos"), ("MASKS", "masks"), ("MESHES", "meshes")])
def test_a_folder_that_is_not_there_is_named(folders, key, break_):
    (folders / break_).rename(folders / "elsewhere")
    with pytest.raises(InputError) as error:
        made(folders)
    assert key in str(error.value) and "no such folder" in str(error.value)


def test_two_photos_of_one_name_are_refused(folders):
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(folders / "photos" / "kitchen.png")
    with pytest.raises(InputError, match="would both be called 'kitchen'"):
        made(folders)


@pytest.mark.parametrize("name", ["photos", "poses"])
def test_a_photo_whose_name_the_results_take_is_listed(folders, name):
    (folders / "photos" / "kitchen.jpg").rename(folders / "photos" / f"{name}.jpg")
    for photo in (name, "IMG_0412"):
        mask(folders / "masks" / f"{photo}_shell.png", [0, 255])
        mask(folders / "masks" / f"{photo}_legs.png", [255, 0])
    missing, _ = made(folders)
    assert missing == [f"photo {name}: write another `name`: a file of the results is called {name}"]
    file = folders / "data" / "mine" / "dataset.yaml"
    with pytest.raises(InputError, match="rename the photo"):
        read_dataset(file)
    file.write_text(file.read_text().replace(f"name: {name}", "name: hall"))  # and that is all
    assert read_dataset(file).photo("hall").image == f"photos/{name}.jpg"


def test_coco_categories_that_are_no_names_are_to_be_renamed(folders):
    outlines = [{"id": k, "image_id": k, "category_id": 1, "segmentation": [[1, 1, 5, 1, 5, 5]]} for k in (0, 1)]
    images = [{"id": k, "file_name": photo} for k, photo in enumerate(("kitchen.jpg", "IMG 0412.png"))]
    coco = {
        "images": images,
        "annotations": outlines,
        "categories": [{"id": 1, "name": "red shell"}, {"id": 2, "name": "legs"}],
    }
    (folders / "masks" / "all.json").write_text(json.dumps(coco))
    (folders / "meshes" / "chair.obj").write_text(OBJ.replace("g shell", "g red_shell"))
    missing, spec = made(folders)
    assert missing == [
        "masks/all.json: rename its category 'red shell' to 'red_shell': names are made of A-Z a-z 0-9 _ and -"
    ]
    assert spec["materials"] == ["red_shell", "legs"]
    dataset = read_dataset(folders / "data" / "mine")
    arguments = "photo", None, {}, folders / "pipeline.yaml"
    assert [
        "category 'red shell' is no material" in str(fault) for fault in Validation(dataset).faults(*arguments)
    ] == [True, True]
    file = folders / "data" / "mine" / "masks" / "all.json"
    file.write_text(file.read_text().replace("red shell", "red_shell"))
    assert Validation(dataset).faults(*arguments) == []


def test_where_no_mask_names_a_material_that_is_said_and_refused(folders):
    missing = new_dataset(folders / "data" / "mine", folders / "photos", None, folders / "meshes")
    assert "no mask names a material: write the names in `materials`, label k of a mask the k-th" in missing
    with pytest.raises(InputError, match="0 materials"):
        read_dataset(folders / "data" / "mine")


def test_a_mask_without_labels_is_listed(folders):
    mask(folders / "masks" / "kitchen.png", [0, 255])
    mask(folders / "masks" / "IMG_0412.png", [0, 1])
    missing, _ = made(folders)
    assert missing == [
        "photo kitchen: kitchen.png has no label, for 255 means left out; the mask of one material is called kitchen_<material>.png"
    ]


def test_a_mesh_is_shown_where_its_name_is_a_whole_word_of_the_photos(folders):
    for photo in ("armchair.jpg", "red_chair-2.jpg"):
        (folders / "photos" / "kitchen.jpg").with_name(photo).write_bytes(
            (folders / "photos" / "kitchen.jpg").read_bytes()
        )
    (folders / "meshes" / "stool.obj").write_text(OBJ)
    _, spec = made(folders)
    shown = {photo["name"]: [each["mesh"] for each in photo["objects"]] for photo in spec["photos"]}
    assert shown == {"IMG_0412": ["?"], "armchair": ["?"], "kitchen": ["?"], "red_chair-2": ["chair"]}
