"""From photos and masks alone: cameras, a hull, bodies of revolution, and the poses of all, through `masks`, `shapes` and `align`."""

import json

import numpy as np
import pytest
import yaml

from factorlib.dataset.read import read_dataset
from factorlib.dataset.slices import dataset_slice
from factorlib.generate.folder import write_labels, write_photo
from factorlib.generate.solids import SHAPES
from factorlib.geometry.camera import Camera
from factorlib.geometry.raster import rasterise
from factorlib.images.exr import read_exr
from factorlib.stage import Inputs
from stages import align, masks, shapes
from tests.shapes.outlines import looking_from, views_of

AROUND = [looking_from(20 + 15 * (k % 2), 18.0 * k) for k in range(8)]


def write_set(folder, meshes, photos, **more):
    """photos: name -> (grey [h, w], label [h, w], objects, focal length)"""
    for name in ("photos", "masks"):
        (folder / name).mkdir(parents=True)
    entries = []
    for name, (grey, label, objects, focal) in photos.items():
        write_photo(folder / f"photos/{name}.png", np.repeat(grey[..., None], 3, axis=-1))
        write_labels(folder / f"masks/{name}.png", label)
        files = {"image": f"photos/{name}.png", "masks": f"masks/{name}.png"}
        entries.append({"name": name, **files, "objects": objects, "camera": {"focal_px": focal} if focal else None})
    spec = {"format": 1, "materials": ["red", "blue"], "meshes": meshes, "photos": entries, **more}
    (folder / "dataset.yaml").write_text(yaml.safe_dump(spec))
    return read_dataset(folder)


def run(dataset, into, photos=None):
    """The folders of `masks`, `shapes` and `align`, of all photos or those named."""
    folders = {stage: into / stage for stage in ("masks", "shapes", "align")}
    for made in folders.values():
        made.mkdir(parents=True)
    names = [photo.name for photo in dataset.spec.photos]

    def inputs(photo, *slices):
        parts = {name: dataset_slice(dataset, name, photo) for name in slices}
        files = {path: dataset.folder / path for part in parts.values() for path in part.files}
        return Inputs(folders, {f"dataset.{name}": part.facts for name, part in parts.items()}, files, photo)

    for name in names:
        masks.main(masks.Params(), inputs(name, "materials", "photo"), folders["masks"])
    shapes.main(shapes.Params(cells=48), inputs(None, "materials", "shapes"), folders["shapes"], lambda *_: None)
    for name in names if photos is None else photos:
        align.main(align.Params(), inputs(name, "materials", "objects"), folders["align"], lambda *_: None)
    return folders


def test_photos_and_masks_of_a_body_at_rest_give_cameras_a_hull_and_normals(tmp_path):
    body, photos = SHAPES["blob"](), {}
    for name, view in views_of(body, AROUND, AROUND, 320).items():
        photos[name] = view.grey / 255, view.objects.astype(int), [{"name": "thing", "mesh": "thing"}], None
    meshes = {"thing": {"hull": True, "material": "red"}}
    folders = run(write_set(tmp_path / "set", meshes, photos, cameras={"sfm": True}), tmp_path / "out", ["p0", "p5"])
    table = json.loads((folders["shapes"] / "shapes.json").read_text())
    assert sorted(table["cameras"]) == sorted(photos) and table["meshes"]["thing"]["overlap"] > 0.97
    for number in (0, 5):
        entry = json.loads((folders["align"] / f"p{number}.json").read_text())
        obj = entry["objects"]["thing"]
        assert (entry["camera"]["focal_source"], obj["source"], obj["doubts"]) == ("sfm", "sfm", [])
        assert entry["camera"]["focal_px"] == pytest.approx(1.3 * 320, rel=0.03) and obj["silhouette_iou"] > 0.96
        found = read_exr(folders["align"] / f"p{number}.exr")
        true = rasterise(body, Camera(320, 320, 1.3 * 320, (160.0, 160.0)), AROUND[number])
        both = (true.label > 0) & (found["label"] > 0)
        normal = np.stack([found[f"normal.{a}"] for a in "xyz"], axis=-1)
        assert np.median(np.rad2deg(np.arccos(np.clip(np.sum(normal * true.normal, axis=-1)[both], -1, 1)))) < 12
