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
from tests.export import made_export


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made_export.make_result(tmp_path_factory.mktemp("root"))


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
