"""The benchmark's quadrature, lobes, figures and tables; what it measures is not repeated here."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from benchmarks.markdown import refresh, table
from benchmarks.operator import spheres
from benchmarks.operator.figures import QUANTITIES, errors_by_input, time_against_error
from benchmarks.operator.stability import DOCS
from benchmarks.operator.tables import SLOPES, as_tables
from benchmarks.rounded import exact
from factorlib.conventions import YUP_FROM_CAMERA
from factorlib.errors import InputError
from factorlib.evaluate.ball import ball_normals
from factorlib.light.latlong import lat_long_of_lobes, map_energy

ERROR = {"median": 0.001, "p95": 0.02, "p99": 0.1, "worst": 3.0, "samples": 7}


def result() -> dict:
    bins = {quantity: {"0 to 1": ERROR, "1 to 2": ERROR} for quantity in QUANTITIES}
    row = {"specular": ERROR | bins, "diffuse": ERROR, "gradients": dict.fromkeys(SLOPES, ERROR)}
    time = {name: {"least": 0.3, "median": 0.4} for name in ("values", "values_and_gradients")}
    labels = ("closed_form float32", "another float32", "another float32 torch", "reference 10⁻²")
    return {
        "operators": {label: row | {"microseconds": time} for label in labels},
        "bfloat16": {"another": row | {"specular": {"not finite": 3}}},
    }


def smooth_light(height: int = 32) -> np.ndarray:
    from factorlib.conventions import lat_long_directions

    directions = lat_long_directions(height, 2 * height)
    spot = np.exp(60 * (directions @ np.array([0.6, 0.48, 0.64]) - 1))
    return (0.3 + 0.2 * directions[..., 1] + 8 * spot)[..., None] * [1.0, 0.8, 0.6]


def test_figures_are_whole_for_any_operators():
    for figure in (time_against_error(result()["operators"]), errors_by_input(result()["operators"])):
        ET.fromstring(figure)
        assert "another" in figure and "nan" not in figure


def test_every_table_has_its_place_and_the_rest_stays(tmp_path):
    tables = as_tables(result(), {"light as lobes": {"diffuse": 40.0}}) | dict.fromkeys(("stability", "special values", "laws"), "x")
    text = DOCS.read_text(encoding="utf-8")
    page = tmp_path / "operator.md"
    page.write_text(text, encoding="utf-8")
    refresh(page, tables)
    once = page.read_text(encoding="utf-8")
    assert all(inner in once for inner in tables.values()) and "## Stability" in once
    refresh(page, tables)
    assert page.read_text(encoding="utf-8") == once
    with pytest.raises(InputError, match="no place for the table 'other'"):
        refresh(page, {"other": ""})


def test_numbers_are_short():
    assert [exact(v) for v in (0.00099999, 0.0123, 1.0, 250.0, 1e-6, 64000.0)] == [".001", ".012", "1", "250", "1.0·10⁻⁶", "6.4·10⁴"]
    assert table(["a", "b"], [["x", "1"]]).splitlines()[1] == "|---|---:|"


def test_both_quadratures_of_a_map_agree():
    light, (normals, _) = smooth_light(64), ball_normals(12)
    wide = spheres.summed(*spheres.texels_of(light), normals, 0.35)
    assert np.abs(spheres.narrow(light, normals, 0.35) - wide).max() < 0.02 * wide.max()


def test_constant_light_is_what_white_reflects():
    light, (normals, _) = np.ones((64, 128, 3)), ball_normals(12)
    np.testing.assert_allclose(spheres.summed(*spheres.texels_of(light), normals, None), 1, atol=2e-3)
    assert (spheres.narrow(light, normals, 0.1) <= 1.001).all() and spheres.narrow(light, normals, 0.1).max() > 0.98


def test_fitted_lobes_keep_the_light_and_its_energy(monkeypatch):
    monkeypatch.setattr(spheres, "LATTICES", ((32, 7.0), (128, 28.0)))
    monkeypatch.setattr(spheres, "SPOT_SHARPNESS", (60.0,))
    monkeypatch.setattr(spheres, "BLOCKS", (1, 2, 4, 8))
    light = smooth_light()
    lobes = spheres.fitted_lobes(light)
    again = lat_long_of_lobes(lobes.turned(YUP_FROM_CAMERA), 32, 64)
    np.testing.assert_allclose(map_energy(again), map_energy(light), rtol=0.01)
    assert np.sqrt(np.mean((again - light) ** 2)) < 0.1 * np.sqrt(np.mean(light**2))


def test_a_picture_scores_itself_as_the_same():
    normals, _ = ball_normals(8)
    radiance = np.abs(normals)
    assert spheres.psnr(0.5 * radiance, radiance, 1.0) < 20 < spheres.psnr(0.999 * radiance, radiance, 1.0)
