"""Masks: every way to give one means the same labels, and what is doubtful is refused by name; labels grown from strokes."""

import base64
import json
from itertools import groupby

import numpy as np
import pytest
from PIL import Image
from pycocotools import mask as pycocomask

from factorlib.images.picture import png_bytes
from factorlib.labels.grow import grow
from factorlib.labels.label_image import Labels, check_materials, describe_specks, read_labels, read_object_indices
from factorlib.labels.mask_files import read_inside, read_labels_in, read_values, run_lengths
from tests.refusal import refusal

MATERIALS = ["red", "white", "wood"]
H, W = 20, 30
LABEL = np.zeros((H, W), dtype=np.uint8)
LABEL[2:9, 3:12] = 1
LABEL[10:18, 5:25] = 3
KEY = "photos[kitchen].masks"


def save(path, values, **options):
    """values: an array, or a picture of Pillow."""
    (values if isinstance(values, Image.Image) else Image.fromarray(values)).save(path, **options)
    return path.name


def labels(folder, masks, size=(H, W), image="photos/kitchen.jpg", materials=MATERIALS):
    return read_labels(masks, lambda name: folder / name, materials, size, image, KEY)


def palette(path, values):
    image = Image.fromarray(values, mode="P")
    image.putpalette([0, 0, 0, 200, 10, 10, 250, 250, 250, 120, 80, 20] + [7] * 756)
    return save(path, image)


def coco(folder, annotations, images=None, categories=MATERIALS):
    """annotations: (category_id, segmentation); categories are numbered from 10."""
    content = {
        "info": {"year": 2020},
        "images": images or [{"id": 7, "file_name": "kitchen.jpg", "width": W, "height": H, "license": 1}],
        "categories": [{"id": 10 + k, "name": name, "supercategory": "material"} for k, name in enumerate(categories)],
        "annotations": [{"id": k, "image_id": 7, "iscrowd": 0, "category_id": category, "segmentation": segmentation}
                        for k, (category, segmentation) in enumerate(annotations)],
    }  # fmt: skip
    (folder / "coco.json").write_text(json.dumps(content))
    return "coco.json"


def test_labels_of_one_name_are_one_material(tmp_path):
    names = ["white", "red", "white", "wood"]
    save(tmp_path / "a.png", np.where(LABEL == 1, 2, LABEL) + LABEL // 3)  # 2 and 4
    save(tmp_path / "b.png", LABEL)  # 1 and 3
    split = [labels(tmp_path, name, materials=names).label for name in ("a.png", "b.png")]
    by_name = {"wood": save(tmp_path / "c.png", LABEL == 3), "white": save(tmp_path / "d.png", LABEL == 1)}
    assert np.array_equal(split[0], np.where(LABEL == 1, 2, LABEL))
    assert np.array_equal(split[1], LABEL > 0)
    assert np.array_equal(labels(tmp_path, by_name, materials=names).label, LABEL)


def rle(counts, size=(H, W)):
    return {"size": list(size), "counts": counts}


def counts_of(inside):
    """Uncompressed RLE by hand: runs down the columns, starting outside."""
    runs = [(value, len(list(run))) for value, run in groupby(inside.T.ravel().tolist())]
    return [0] * bool(runs[0][0]) + [length for _, length in runs]


def compressed(inside):
    return pycocomask.encode(np.asfortranarray(inside.astype(np.uint8)))["counts"].decode()


def box(x0, y0, x1, y1):
    return [x0, y0, x1, y0, x1, y1, x0, y1]


def labelme(folder, shapes, size=(H, W)):
    """shapes: (label, points, shape_type); a mask has the pixels of LABEL in its box."""
    shapes = [{"label": name, "points": points, "shape_type": kind, "mask": None} for name, points, kind in shapes]
    for shape in (shape for shape in shapes if shape["shape_type"] == "mask"):
        (left, top), (right, bottom) = shape["points"]
        inside = np.pad(LABEL, (0, 9))[top : bottom + 1, left : right + 1] == MATERIALS.index(shape["label"]) + 1
        shape["mask"] = base64.b64encode(png_bytes(255 * inside[..., None].astype(np.uint8))).decode()
    content = {"version": "5", "shapes": shapes, "imagePath": "a.jpg", "imageHeight": size[0], "imageWidth": size[1]}
    (folder / "labelme.json").write_text(json.dumps(content))
    return "labelme.json"


def cvat(folder, mode):
    (folder / "m/SegmentationClass").mkdir(parents=True)
    (folder / "m/labelmap.txt").write_text(
        "# label:color_rgb:parts:actions\nbackground:0,0,0::\n\nred:250,250,0::\nwood:0,0,77::\n"
    )
    colours = np.array([[0, 0, 0], [250, 250, 0], [9, 9, 9], [0, 0, 77]], np.uint8)
    Image.fromarray(colours[LABEL]).convert(mode, palette=Image.Palette.ADAPTIVE).save(
        folder / "m/SegmentationClass/a.png"
    )
    return "m/SegmentationClass/a.png"


def cut_out(inside):
    return np.dstack(
        [np.indices((H, W)).sum(0).astype(np.uint8)] * 3 + [np.where(inside, 200, 60 * (LABEL > 0)).astype(np.uint8)]
    )


RED, WOOD = LABEL == 1, LABEL == 3
TURNED = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06" + bytes(6)  # to be turned clockwise
FORMS = {
    "grey": lambda at: save(at / "a.png", LABEL),
    "palette": lambda at: palette(at / "a.png", LABEL),
    "rgb": lambda at: save(at / "a.png", np.dstack([LABEL] * 3)),
    "rgba": lambda at: save(at / "a.png", np.dstack([LABEL] * 3 + [np.full_like(LABEL, 255)])),
    "16 bit": lambda at: save(at / "a.png", LABEL.astype(np.uint16)),
    "one each, 255": lambda at: {"wood": save(at / "w.png", WOOD * np.uint8(255)), "red": save(at / "r.png", RED * np.uint8(255))},
    "one each, 1": lambda at: {"red": save(at / "r.png", RED * np.uint8(1)), "wood": save(at / "w.png", WOOD * np.uint8(1))},
    "one each, 16 bit": lambda at: {"red": save(at / "r.png", RED * np.uint16(65535)), "wood": save(at / "w.png", WOOD * np.uint16(50000))},
    "one each, 1 bit": lambda at: {"red": save(at / "r.png", RED), "wood": save(at / "w.png", WOOD)},
    "one each, soft": lambda at: {"red": save(at / "r.png", RED * np.uint8(255) + WOOD * np.uint8(100)), "wood": save(at / "w.png", WOOD * np.uint8(200))},
    "transparent": lambda at: {"red": save(at / "r.png", cut_out(RED)), "wood": save(at / "w.png", cut_out(WOOD))},
    "transparent palette": lambda at: {"red": save(at / "r.png", Image.fromarray(cut_out(RED)).quantize(200)), "wood": save(at / "w.png", Image.fromarray(cut_out(WOOD)).quantize(200))},
    "opaque everywhere": lambda at: {"red": save(at / "r.png", np.dstack([RED * np.uint8(255)] * 3 + [np.full_like(LABEL, 254)])), "wood": save(at / "w.png", WOOD)},
    "colours": lambda at: cvat(at, "RGB"),
    "colours of a palette": lambda at: cvat(at, "P"),
    "2 bits": lambda at: save(at / "a.png", LABEL, bits=2),
    "4 bits": lambda at: save(at / "a.png", LABEL, bits=4),
    "TIFF": lambda at: save(at / "a.tif", LABEL),
    "BMP": lambda at: save(at / "a.bmp", LABEL),
    "TGA": lambda at: save(at / "a.tga", LABEL),
    "GIF, whose palette has other numbers": lambda at: save(at / "a.gif", LABEL),
    "WebP": lambda at: save(at / "a.webp", np.dstack([LABEL] * 3), lossless=True),
    "one each, JPEG": lambda at: {"red": save(at / "r.jpg", RED * np.uint8(255), quality=90), "wood": save(at / "w.jpg", np.dstack([WOOD * np.uint8(255)] * 3), quality=90)},
    "one each, lossy": lambda at: {"red": save(at / "r.webp", np.dstack([RED * np.uint8(255)] * 3), quality=95), "wood": save(at / "w.tif", WOOD * np.uint8(255), compression="jpeg")},
    "one each, turned": lambda at: {"red": save(at / "r.jpg", np.rot90(RED) * np.uint8(255), exif=TURNED), "wood": save(at / "w.tif", WOOD)},
    "pixels of labelme": lambda at: labelme(at, [("red", [[0, 0], [20, 10]], "mask"), ("wood", [[5, 10], [25, 10], [25, 18], [5, 18]], "rectangle")]),
    "labelme": lambda at: labelme(at, [("red", [[3, 2], [12, 9]], "rectangle"), ("wood", [[5, 10], [25, 10], [25, 18], [5, 18]], "polygon")]),
    "stored size": lambda at: coco(at, [(10, [box(3, 2, 12, 9)]), (12, [box(5, 10, 25, 18)])], [{"id": 7, "file_name": "kitchen.jpg", "width": H, "height": W}]),
    "flat polygon": lambda at: coco(at, [(12, [box(5, 10, 25, 18), [1, 1, 1, 5]]), (10, [box(3, 2, 12, 9)])], [{"id": 7, "file_name": "kitchen.jpg", "width": 30.0, "height": 20.0}]),
    "polygons": lambda at: coco(at, [(12, [box(5, 10, 15, 18), box(15, 10, 25, 18)]), (10, [box(3, 2, 12, 9)])]),
    "RLE": lambda at: coco(at, [(10, rle(counts_of(RED))), (12, rle(compressed(WOOD)))]),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_the_same_labels(tmp_path, form):
    result = labels(tmp_path, FORMS[form](tmp_path))
    np.testing.assert_array_equal(result.label, LABEL)
    assert not result.left_out.any()


def test_forty_labels_are_labels_and_a_soft_matte_has_none(tmp_path):
    many = np.arange(H * W, dtype=np.uint16).reshape(H, W) // 15
    for values in (many, many.astype(np.uint8)):
        assert read_labels_in(tmp_path / save(tmp_path / "a.png", values, exif=TURNED), KEY) == set(range(1, 40))
    for matte in (np.linspace(0, 255, H * W).reshape(H, W).astype(np.uint8), many * 1600):
        assert read_labels_in(tmp_path / save(tmp_path / "a.png", matte), KEY) == set()


DISC = np.hypot(*(np.indices((240, 320)) - [[[120]], [[140]]])) < 80


@pytest.mark.parametrize("quality, chroma", [(90, 2), (60, 2), (95, 0)])
def test_a_jpeg_of_two_values_is_a_mask_also_with_colours_at_its_edges(tmp_path, quality, chroma):
    rim = np.indices(DISC.shape)[1] > 218  # the disc's last pixels are orange: of another program's soft brush
    picture = np.dstack([DISC * np.uint8(255), DISC * np.where(rim, 160, 255), DISC * np.where(rim, 60, 255)])
    file = tmp_path / save(tmp_path / "a.jpg", picture.astype(np.uint8), quality=quality, subsampling=chroma)
    assert read_labels_in(file, KEY) == set()
    inside = read_inside(file, KEY)
    assert (inside != DISC).mean() < 0.002 and np.array_equal(read_values(file, KEY) == 255, inside)


@pytest.mark.parametrize("quality", [60, 95])
def test_a_jpeg_of_three_values_is_refused_however_small_the_third_is_beside_the_first(tmp_path, quality):
    values = np.where(DISC, 255, 0).astype(np.uint8)
    values[10:60, 250:300] = 130
    file = tmp_path / save(tmp_path / "a.jpg", values, quality=quality)
    assert "save labels as PNG" in refusal("is of a lossy format", read_labels_in, file, KEY).cure


def test_rle_is_decoded_as_pycocotools_does_and_so_are_millions_of_runs():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        inside = rng.random((rng.integers(1, 40), rng.integers(1, 40))) < rng.random()
        assert run_lengths(compressed(inside), inside.size).tolist() == counts_of(inside)
    assert len(run_lengths("10" * 500_000, 1 + 499_999 * 500_000 // 2)) == 1_000_000


def pictured(*names):
    """A COCO file of a shape in the first of such pictures."""
    images = [{"id": 7 + k, "file_name": name} for k, name in enumerate(names)]
    return lambda at: coco(at, [(10, [box(3, 2, 12, 9)])], images)


BLACK, WHITE = np.zeros((H, W), np.uint8), np.full((H, W), 255, np.uint8)
REFUSED = {
    r"a\.png: photos\[kitchen\]\.masks: the mask is empty: no": lambda at: dict.fromkeys(("red", "wood"), save(at / "a.png", BLACK)),
    r"coco\.json: photos\[kitchen\]\.masks: the mask is empty": lambda at: coco(at, []),
    r"w\.png: .*'red' and 'wood' share 63 pixels with r\.png": lambda at: {"wood": save(at / "w.png", np.uint8(255) * (LABEL > 0)), "red": save(at / "r.png", RED)},
    r"share 9 pixels": lambda at: coco(at, [(10, [box(12, 12, 15, 15)]), (12, [box(12, 12, 15, 15)])]),
    r"shapes\[0\]\.shape_type: 'line' is not read.*\n.*draw its outline": lambda at: labelme(at, [("red", [[1, 1], [9, 9]], "line")]),
    r"shapes\[1\]: .*leave the photo": lambda at: labelme(at, [("red", [[3, 2], [12, 9]], "rectangle"), ("wood", [[25, 10], [35, 18]], "mask")]),
    r"shapes\[0\]: category 'rde' .*\n.*did you mean 'red'": lambda at: labelme(at, [("rde", [[3, 2], [12, 9]], "rectangle")]),
    r"is of a lossy format.*\n.*as PNG; or": lambda at: save(at / "a.jpg", LABEL),
    r"is of a lossy format": lambda at: save(at / "a.webp", np.dstack([LABEL * np.uint8(80)] * 3), quality=90),
    r"holds only 0 and 255": lambda at: save(at / "a.jpg", RED * np.uint8(255)),
    r"is a colour picture": lambda at: {"red": save(at / "a.jpg", np.dstack([WHITE, BLACK, BLACK]))},
    r"the mask is 20 × 30 pixels.*\n.*EXIF": lambda at: {"red": save(at / "a.jpg", WHITE, exif=TURNED)},
    r"holds several pictures": lambda at: {"red": save(at / "a.gif", WHITE, save_all=True, append_images=[Image.fromarray(BLACK)])},
    r"32 bits": lambda at: save(at / "a.tif", LABEL.astype(np.float32)),
    r"has 2 images 'kitchen\.jpg'": pictured("a/kitchen.jpg", "b/kitchen.jpg"),
    r"did you mean 'kitchem\.jpg'": pictured("kitchem.jpg"),
}  # fmt: skip


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_no_mask_is_refused(tmp_path, words):
    error = refusal(words, labels, tmp_path, REFUSED[words](tmp_path))
    assert str(tmp_path) in str(error.file) and error.key


def test_specks_far_from_the_thing_are_named():
    mask = np.kron(LABEL == 3, np.ones((40, 40), bool))
    mask[20:30, 20:22] = mask[730:740, 1050:1052] = True  # far, and near
    assert describe_specks(mask & False) == ""
    assert describe_specks(mask).startswith("specks far from the thing (1): 20 px at (20, 23);")


def test_an_outline_within_another_is_in_front_of_it(tmp_path, caplog):
    result = labels(tmp_path, coco(tmp_path, [(10, [box(12, 12, 15, 15)]), (12, [box(5, 10, 25, 18)])]))
    assert (result.label == 1).sum() == 9 and (result.label == 3).sum() == 151 and "'red' is in front" in caplog.text


@pytest.mark.parametrize("name", [
    "photos/kitchen.jpg", "set/photos/kitchen.jpg", "set\\photos\\kitchen.jpg", "a\\1/90fbb0c7-kitchen.jpg", f"kitchen_jpg.rf.{'0f1e2d3c' * 4}.jpg",
])  # fmt: skip
def test_a_photo_of_coco_goes_by_its_folders_and_its_name_as_programs_change_it(tmp_path, name):
    others = ("b/kitchen.jpg",) if "photos" in name else ("no.jpg",)
    assert labels(tmp_path, pictured(name, *others)(tmp_path)).label.any()
    assert labels(tmp_path, pictured("ku\u0308che.jpg")(tmp_path), image="photos/k\u00fcche.jpg").label.any()


def test_objects_are_numbered_in_their_order_and_bad_masks_of_them_are_refused(tmp_path):
    objects = lambda *masks: read_object_indices(masks, lambda name: tmp_path / name, (H, W), "photos[kitchen].objects")  # noqa: E731
    one, three = (save(tmp_path / f"{k}.png", np.uint8(255) * (LABEL == k)) for k in (1, 3))
    result = objects(("a", None), ("b", three), ("c", one))
    np.testing.assert_array_equal(result, np.select([LABEL == 3, LABEL == 1], [2, 3], 0))
    for bad, said in ((LABEL > 0, "'a' and 'b' share 63 pixels"), (LABEL > 9, "'b' is empty"), (LABEL.T > 0, "EXIF")):
        words = rf"(?s)bad\.png: photos\[kitchen\]\.objects\[1\]\.mask: .*{said}"
        refusal(words, objects, ("a", one), ("b", save(tmp_path / "bad.png", bad)))


def test_objects_of_other_materials_than_the_mask_shows_are_refused_and_what_is_hidden_or_has_no_mesh_is_not(tmp_path):
    shown, none = Labels(LABEL, LABEL > 9), np.zeros((H, W), np.uint16)

    def check(objects, *object_materials):
        check_materials(shown, objects, list(object_materials), MATERIALS, tmp_path / "m.png", "photos[x].objects")

    for fine in ({"red", "wood"}, {"wood"}, {"red", "white", "wood"}):
        check(none, ("chair", fine))
    words = "the mask shows 'red' in 28% of the pixels of 'chair', but no 'white'"
    error = refusal(words, check, none, ("chair", {"white", "wood"}))
    assert error.key == "photos[x].objects[0].materials" and "white, wood" in error.cure
    each = np.select([LABEL == 1, LABEL == 3], [1, 2], 0)
    check(each, ("a", {"red"}), ("b", {"wood"}))
    refusal("'red' in 100% of the pixels of 'a', but no 'wood'", check, each, ("a", {"wood"}), ("b", {"red"}))


# ── Labels grown from strokes, on pictures whose parts are known ────────────────────────────────────────────────────


def scene(size=60, noise=8.0):
    """A red disc on a thin brown stem, before grey; the truth's labels, its picture, and a box around both."""
    y, x = np.indices((size, size)) * 60 / size
    truth = np.where(np.hypot(x - 30, y - 22) < 14, 1, np.where((abs(x - 30) < 2) & (y > 30) & (y < 52), 2, 0))
    picture = np.array([[90, 90, 90], [200, 40, 40], [150, 110, 60]])[truth] + np.random.default_rng(0).normal(
        0, noise, (size, size, 3)
    )
    return truth.astype(np.uint8), picture.clip(0, 255).astype(np.uint8), tuple(k * size // 60 for k in (10, 4, 50, 56))


def clicked(truth, box):
    """What the page sends: the box filled with label 1, a click on each part."""
    label, sure, unit = np.zeros_like(truth), np.zeros(truth.shape, bool), len(truth) // 60
    label[box[1] : box[3], box[0] : box[2]] = 1
    for row, kind in ((22, 1), (45, 2)):
        at = np.s_[row * unit : (row + 2) * unit, 29 * unit : 31 * unit]
        label[at], sure[at] = kind, True
    return label, sure


@pytest.mark.parametrize("size, most, least", [(60, 10**6, 0.9), (240, 60 * 60, 0.75)])
def test_a_click_on_each_part_finds_the_parts(size, most, least):
    truth, picture, box = scene(size)
    result = grow(box, 1, picture, *clicked(truth, box), most)
    for kind in (1, 2):
        assert ((result == kind) & (truth == kind)).sum() > least * ((result == kind) | (truth == kind)).sum()
    assert np.array_equal(result, grow(box, 1, picture, *clicked(truth, box), most))


def test_a_box_alone_finds_what_is_of_another_colour():
    truth, picture, box = scene(noise=30.0)
    label, sure = clicked(truth, box)
    result = grow(box, 1, picture, np.minimum(label, 1), np.zeros_like(sure))
    assert ((result > 0) == (truth > 0)).mean() > 0.98 and set(np.unique(result)) == {0, 1}


def test_sure_pixels_and_what_is_beside_the_box_stay():
    truth, picture, box = scene()
    label, sure = clicked(truth, box)
    label[:3], label[50, 20], sure[50, 20] = 2, 1, True  # both wrong, but said
    twice, wide = picture.repeat(2, 0).repeat(2, 1), [each.repeat(2, 0).repeat(2, 1) for each in (label, sure)]
    wide[0][80, 40:44], wide[1][80, 40:44] = (1, 2, 1, 2), True  # finer than the walk
    assert np.array_equal(grow(tuple(2 * k for k in box), 1, twice, *wide, 3600)[80, 40:44], (1, 2, 1, 2))
    result = grow(box, 1, picture, label, sure)
    outside = np.ones_like(sure)
    outside[box[1] : box[3], box[0] : box[2]] = False
    assert np.array_equal(result[sure | outside], label[sure | outside])
    assert np.array_equal(grow(box, 1, picture, label, np.ones_like(sure)), label)


def test_another_object_keeps_its_labels_and_lends_them_to_none():
    """A grey ball before grey, and one that is partly red and partly grey as well, which reaches into its box, is labelled 2, and was mended by the brush there."""
    y, x = np.indices((60, 90))
    truth = np.where(np.hypot(x - 30, y - 30) < 14, 1, np.where(np.hypot(x - 60, y - 30) < 17, 2, 0)).astype(np.uint8)
    picture = np.array([[90, 90, 90], [120, 120, 120], [200, 40, 40]], np.uint8)[np.where(x > 70, truth, truth > 0)]
    box, label, sure = (12, 12, 48, 48), np.where(truth == 2, 2, 0).astype(np.uint8), (truth == 2) & (x < 47)
    inside = np.s_[12:48, 12:48]
    label[inside] = np.where(label[inside] > 0, label[inside], 1)
    for marked in (sure, np.zeros_like(sure)):
        assert (grow(box, 1, picture, label, marked) == truth).mean() > 0.99
    wrong = np.where(truth == 1, 2, 0).astype(np.uint8)  # the box was drawn with another label before
    assert (grow(box, 1, picture, wrong, np.zeros_like(sure)) == np.where(truth == 1, 1, 0))[truth < 2].mean() > 0.99
