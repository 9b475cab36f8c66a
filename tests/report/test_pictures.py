"""Pictures keep their mean, their outline and their file."""

import base64
from types import SimpleNamespace

import numpy as np
import pytest

from factorlib.dataset.schema import Camera, MeshEntry, ObjectEntry, ObjectsSlice
from factorlib.images.exr import write_exr
from factorlib.images.picture import png_bytes
from factorlib.jsonfile import write_json
from factorlib.report.artifacts import Artifacts
from factorlib.report.pictures import box_of, data_uri, outline, reduced, surface_rows
from factorlib.results.surface import SurfaceTable


def test_the_data_uri_holds_the_file():
    head, data = data_uri(np.zeros((2, 2, 3), np.uint8)).split(",")
    assert head == "data:image/png;base64" and base64.b64decode(data) == png_bytes(np.zeros((2, 2, 3), np.uint8))


@pytest.mark.parametrize("size", [(100, 60), (61, 97)])
def test_reducing_keeps_the_mean_and_a_constant(size):
    picture = np.random.default_rng(2).uniform(size=(*size, 3)).astype(np.float32)
    small = reduced(picture, 25)
    assert max(small.shape[:2]) == 25 and small.mean() == pytest.approx(picture.mean(), rel=1e-4)
    assert reduced(np.ones((*size, 1), np.float32), 25) == pytest.approx(np.ones((*small.shape[:2], 1)), rel=1e-5)
    assert reduced(picture, 200) is picture


def test_the_box_is_the_mask_with_a_margin_and_the_outline_one_pixel_wide_and_open_at_the_border():
    mask = np.zeros((50, 60), bool)
    mask[10:20, 0:30] = True
    assert box_of(mask, 0.1) == (slice(7, 23), slice(0, 33)) and box_of(mask & False) == (slice(0, 50), slice(0, 60))
    mask, expected = np.zeros((2, 6, 6), bool)
    mask[:4, :4], expected[3, :4], expected[:4, 3] = True, True, True
    assert np.array_equal(outline(mask), expected)


def test_a_moved_mesh_is_shown_in_the_photo_that_shows_most_of_it_before_and_after(tmp_path):
    shape, lean = (20, 30), {"a": 0.0, "b": 0.6}
    for photo, count in (("a", 4), ("b", 9)):
        seen = np.zeros(shape)
        seen[:count, :count] = 2
        normal = {"normal.x": 0 * seen, "normal.y": 0 * seen, "normal.z": -(seen > 0).astype(float)}
        for stage in ("align", "surface/photos"):
            (tmp_path / stage).mkdir(parents=True, exist_ok=True)
        write_exr(tmp_path / "align" / f"{photo}.exr", {**normal, "object": seen})
        turned = {"normal.x": lean[photo] * (seen > 0), "normal.z": normal["normal.z"] * np.sqrt(1 - lean[photo] ** 2)}
        write_exr(tmp_path / "surface" / "photos" / f"{photo}.exr", {**normal, **turned, "detail": seen / 2})
    table = SurfaceTable(
        moved=True, painted=True, displacements={"egg": [0.03, -0.04]}, log_factors={"egg": [0.0, 0.0]}
    )
    write_json(tmp_path / "surface" / "surface.json", table)
    both = [ObjectEntry(name="other", mesh="ball"), ObjectEntry(name="mine", mesh="egg")]
    objects = ObjectsSlice(Camera(), both, {"egg": MeshEntry(file="egg.ply")})
    folders = {stage: tmp_path / stage for stage in ("align", "surface")}
    run = Artifacts(folders, SimpleNamespace(photos=["a", "b"]))
    (row,) = surface_rows(run, {"a": objects, "b": objects})
    assert (row.mesh, row.photo, row.largest) == ("egg", "b", 0.04) and np.isclose(row.typical, np.sqrt(0.00125))
    assert list(row.uris)[-1] == "detail of reflectance" and len(set(row.uris.values())) == 5
