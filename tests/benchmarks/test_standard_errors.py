"""Deviations in standard errors, of results whose errors are known."""

import numpy as np
import pytest

from benchmarks.standard_errors import light_deviations, main, material_deviations
from factorlib.errors import InputError
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.results.materials import MaterialTable, Reflectance, StandardErrors, solved, write_materials

ERROR = StandardErrors((0.02, 0.02, 0.02), (0.01, 0.01, 0.01), 0.05)


def results(folder, roughness, scale, light):
    """Two materials times a scale, and one light with a relative standard error of .1."""
    one = solved(Reflectance((0.4 * scale,) * 3, (0.1 * scale,) * 3, roughness), ERROR)
    two = solved(Reflectance((0.2 * scale,) * 3, (0.04 * scale,) * 3, 0.5), ERROR)
    write_materials(folder / "export/materials.json", MaterialTable({"one": one, "two": two}))
    write_rgb_exr(folder / "export/illumination/room.exr", light, LAT_LONG)
    write_rgb_exr(folder / "export/coverage/room.exr", 0.1 * light / light.mean(), LAT_LONG)
    return folder


@pytest.fixture
def folders(tmp_path):
    for name in ("a", "b"):
        for kind in ("illumination", "coverage"):
            (tmp_path / name / "export" / kind).mkdir(parents=True)
    return tmp_path / "a", tmp_path / "b"


def test_deviations_between_two_runs_are_in_standard_errors_after_the_free_factor(folders):
    light = np.ones((64, 128, 3))
    brighter = light.copy()
    brighter[:16] *= np.exp(0.2)  # the upper quarter of the rows: two standard errors
    one, other = results(folders[0], 0.3, 1.0, light), results(folders[1], 0.4, 2.0, 3 * brighter)
    found = material_deviations(one, other)
    assert found["diffuse"] == pytest.approx(np.zeros(6), abs=1e-9) and found["roughness"] == pytest.approx([2, 0])
    off = light_deviations(one, other)
    assert np.median(off) == pytest.approx(0, abs=1e-4) and off.max() == pytest.approx(2, rel=0.02)
    assert np.mean(off > 1.5) == pytest.approx((1 - np.cos(np.pi / 4)) / 2, abs=0.02)  # their share of the sphere


def test_results_of_another_data_set_are_refused(folders):
    one, other = (results(folder, 0.3, 1.0, np.ones((64, 128, 3))) for folder in folders)
    write_materials(
        other / "export/materials.json",
        MaterialTable({"three": solved(Reflectance((0.4,) * 3, (0.1,) * 3, 0.3), ERROR)}),
    )
    with pytest.raises(InputError, match="'one' is missing"):
        material_deviations(one, other)
    with pytest.raises(SystemExit, match="name folders of one data set"):
        main([one], other)
