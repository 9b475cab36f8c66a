"""From photos and masks alone: cameras, a hull, bodies of revolution, and the poses of all, through `masks`, `shapes` and `align`."""

import msgspec
import numpy as np
import pytest

from factorlib.dataset.read_dataset import read_dataset
from factorlib.dataset.schema import MeshEntry
from factorlib.generate.folder import write_labels, write_photo
from factorlib.generate.solids import SHAPES
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import read_exr
from factorlib.jsonfile import read_json, write_json
from factorlib.scenes.stage_runs import run_stages
from stages import align, masks, shapes
from tests.refusal import refusal
from tests.shapes.outlines import looking_from, outline, views_of

AROUND = [looking_from(20 + 15 * (k % 2), 18.0 * k) for k in range(8)]


def test_a_hull_is_refused_where_nothing_tells_the_focal_length():
    posed = [msgspec.structs.replace(outline(SHAPES["blob"](), pose, True), focal_sigma=0.5) for pose in AROUND[:2]]
    refusal("focal lengths", shapes.estimate_shape, MeshEntry(hull=True, material="red"), posed, shapes.Params(), print)


@pytest.mark.long
def test_photos_and_masks_of_a_body_at_rest_give_cameras_a_hull_and_normals(tmp_path):
    body, photos, folder = SHAPES["blob"](), [], tmp_path / "set"
    for name, view in views_of(body, AROUND, AROUND, 320).items():
        files = {"image": f"photos/{name}.png", "masks": f"masks/{name}.png"}
        [(folder / file).parent.mkdir(parents=True, exist_ok=True) for file in files.values()]
        write_photo(folder / files["image"], np.repeat(view.grey[..., None] / 255, 3, axis=-1))
        write_labels(folder / files["masks"], view.objects.astype(int))
        photos.append({"name": name, **files, "objects": [{"name": "thing", "mesh": "thing"}]})
    meshes = {"thing": {"hull": True, "material": "red"}}
    spec = {"format": 1, "materials": ["red"], "meshes": meshes, "photos": photos, "cameras": {"sfm": True}}
    write_json(folder / "dataset.yaml", spec)
    run_stages(read_dataset(folder), tmp_path / "out", (masks, shapes, align), {"shapes": {"cells": 48}})
    table = read_json(tmp_path / "out" / "shapes" / "shapes.json")
    names = [photo["name"] for photo in photos]
    assert sorted(table["cameras"]) == sorted(names) and table["meshes"]["thing"]["overlap"] > 0.97
    for number in (0, 5):
        entry = read_json(tmp_path / "out" / "align" / f"p{number}.json")
        obj = entry["objects"]["thing"]
        assert (entry["camera"]["focal_source"], obj["source"], obj["doubts"]) == ("sfm", "sfm", [])
        assert entry["camera"]["focal_px"] == pytest.approx(1.3 * 320, rel=0.03) and obj["silhouette_iou"] > 0.96
        result = read_exr(tmp_path / "out" / "align" / f"p{number}.exr")
        true = rasterise(body, Camera(320, 320, 1.3 * 320, (160.0, 160.0)), AROUND[number])
        both = (true.label > 0) & (result["label"] > 0)
        normal = np.stack([result[f"normal.{a}"] for a in "xyz"], axis=-1)
        assert np.median(np.rad2deg(np.arccos(np.clip(np.sum(normal * true.normal, axis=-1)[both], -1, 1)))) < 12
