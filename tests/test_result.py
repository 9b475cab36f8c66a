"""`factorlib.load_result`: what was solved, in Python."""

import subprocess
import sys

import numpy as np
import pytest

import factorlib
from factorlib.errors import InputError
from factorlib.images.exr import read_exr, read_rgb_exr
from factorlib.images.light_map import read_light_map
from factorlib.images.picture import read_png
from factorlib.jsonfile import write_json
from factorlib.stage import silent
from stages import export
from tests.export import made_export


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """As the runner leaves it: build/<dataset> with links to results, beside the data set."""
    root = tmp_path_factory.mktemp("root")
    build, dataset = root / "build" / "set", root / "data" / "set"
    inputs = made_export.make(build)
    (build / "export").mkdir()
    export.main(export.Params(height=16, mitsuba_height=16), inputs, build / "export", silent)
    dataset.mkdir(parents=True)
    (build / "dataset.txt").write_text("data/set\n")
    meshes = {}
    for photo in made_export.MESHES:
        meshes |= inputs.facts["dataset.objects"][photo]["meshes"]
    for name, file in inputs.files.items():
        (dataset / name).write_bytes(file.read_bytes())
    photos = [
        {"name": photo, "image": f"{photo}.png", "masks": f"{photo}_mask.png", "objects": [{"name": "chair", "mesh": mesh}]}
        for photo, mesh in made_export.MESHES.items()
    ]
    photos[1] |= {"illumination": "room", "world_from_camera": made_export.WORLD_FROM_CAMERA["side"].tolist()}
    for photo in photos:
        for key in ("image", "masks"):
            (dataset / photo[key]).write_bytes(b"")
    meshes = {name: {k: v for k, v in mesh.items() if v is not None} for name, mesh in meshes.items()}
    write_json(dataset / "dataset.yaml", {"format": 1, "materials": made_export.NAMES, "meshes": meshes, "photos": photos})
    return build


@pytest.fixture(scope="module")
def result(folder):
    return factorlib.load_result(folder)


def test_materials_have_their_numbers_and_standard_errors(result):
    assert list(result.materials) == made_export.NAMES and result.materials["red"].roughness == 0.35
    assert result.materials["red"].stderr.roughness == 0.1
    assert result.objects == ["front/chair", "side/chair"]


def test_what_is_not_there_is_refused_with_what_is(result, tmp_path):
    for ask, words in [
        (lambda: result.materials["rde"], "did you mean 'red'"),
        (lambda: result.environment("frnt"), "did you mean 'front'"),
        (lambda: result.relight("chiar", "front"), "did you mean 'chair'"),
        (lambda: result.relight("chair", "sde"), "did you mean 'side'"),
        (lambda: result.render("nothing"), "known are: 'front', 'side'"),
        (lambda: factorlib.load_result(tmp_path), "there is no result here"),
        (lambda: factorlib.nothing, "has no attribute 'nothing'"),
    ]:
        with pytest.raises((InputError, AttributeError)) as error:
            ask()
        assert words in str(error.value)


def test_environments_are_the_exported_ones_turned_and_written(result, folder, tmp_path):
    light = result.environment("side")
    assert np.array_equal(light.lat_long, read_rgb_exr(folder / "export" / "illumination" / "room.exr"))
    light.to_exr(tmp_path / "room.exr")
    light.to_hdr(tmp_path / "room.hdr")
    found, brightest = read_light_map(tmp_path / "room.hdr"), light.lat_long.max(axis=-1, keepdims=True)
    assert (np.abs(found - light.lat_long) <= brightest / 128).all()
    assert np.array_equal(read_rgb_exr(tmp_path / "room.exr"), light.lat_long.astype(np.float32))
    spot = factorlib.result.Environment(np.zeros((16, 32, 3)))
    spot.lat_long[8, 16] = 1  # toward the viewer
    assert spot.rotated(90).lat_long.sum(axis=(0, 2)).argmax() in (7, 8)  # +x is a quarter from the left


def test_pictures_are_those_of_the_photo(result, tmp_path):
    picture = result.render("front", samples=4)
    covered = read_exr(result.folder / "align" / "front.exr")["confidence"] > 0
    assert ((picture.pixels[..., 3] > 0.5) == covered).mean() > 0.98
    picture.to_png(tmp_path / "front.png")
    picture.to_exr(tmp_path / "front.exr")
    assert read_png(tmp_path / "front.png").shape == (*covered.shape, 4)
    assert result.render("front", azimuth=90, width=32, samples=1).pixels.shape == (28, 32, 4)


def test_an_object_in_another_light_is_that_lights_colour(result, tmp_path):
    red = factorlib.result.Environment(np.broadcast_to([1.0, 0.0, 0.0], (16, 32, 3)).copy())
    red.to_exr(tmp_path / "red.exr")
    for light in (red, str(tmp_path / "red.exr")):
        pixels = result.relight("front/chair", light, samples=2).pixels
        assert pixels[..., 0].max() > 0 and not pixels[..., 1:3].any()
    assert result.relight("chair", "side", samples=1).pixels[..., :3].any()


def test_a_notebook_shows_tables_and_pictures_and_names_are_names(result):
    shown = result._repr_html_()
    assert "0.350 ± 0.100" in shown and "front, side" in shown
    assert result.render("front", samples=1)._repr_html_().startswith('<img src="data:image/png;base64,')
    assert result.environment("front")._repr_html_().startswith("<img")


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, factorlib; assert not {'numpy', 'torch', 'mitsuba'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
