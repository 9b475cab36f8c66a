"""What measurements promise: sections of docs/results.md, maps that a prior must not know, deviations in standard errors."""

from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree

from factorlib.errors import InputError
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.meshes.read_mesh import read_mesh
from factorlib.results.materials import MaterialTable, Reflectance, StandardErrors, attach_errors
from factorlib.results.metrics import Counts, Metrics, ResynthesisErrors
from studies.measured import gallery, real_sets, results, speed, verdict
from studies.measured.degradations import degrade
from studies.measured.eames_like import MAPS, SetResult, link_maps, split_maps
from studies.measured.standard_errors import light_deviations, material_deviations
from studies.measured.tools import ROOT, replace_sections


def test_a_section_is_replaced_and_the_rest_of_the_page_stays(tmp_path):
    page = tmp_path / "results.md"
    page.write_text(before := results.PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    for name in results.SECTIONS:
        assert find_spec(f"studies.measured.{name}")
        inner = before.partition(f"<!-- begin {name} -->\n")[2].partition(f"\n<!-- end {name} -->")[0]
        replace_sections(page, {name: inner})
        assert page.read_text(encoding="utf-8") == before
    new = results.section("align", {"Success": [["case", "right"], ["all", "1 of 1"]]}, "today")
    replace_sections(page, {"align": new})
    assert "**Success**\n\n| case | right |\n|---|---:|\n| all | 1 of 1 |\n<!-- end align -->" in page.read_text(
        "utf-8"
    )
    with pytest.raises(InputError, match="no place for the table 'other'"):
        replace_sections(page, {"other": ""})


def test_speed_is_drawn_inside_the_figure_with_every_point_numbered():
    points = [(20.0, 20.3), (130.0, 29.8), (85.0, 29.7)]
    figure = ElementTree.fromstring(speed.draw(points, {2}))
    circles = [element.attrib for element in figure.iter() if element.tag.endswith("circle")]
    x, y = ([float(circle[name]) for circle in circles] for name in ("cx", "cy"))
    assert np.argsort(x).tolist() == [0, 2, 1] and np.argsort(y).tolist() == [1, 2, 0]  # y points down
    assert min(x) >= 0 and max(x) <= speed.WIDTH and min(y) >= 0 and max(y) <= speed.HEIGHT
    assert [circle["fill"] == "#b22" for circle in circles] == [False, True, False]


def test_a_real_set_has_no_number_where_nothing_was_measured():
    counts = Counts(photos=2, materials=1, illuminations=2, components=1)
    nothing = ResynthesisErrors({}, None, None, None)
    empty = Metrics(counts, nothing, None, None, None, None, None, {})
    assert real_sets.row_of("set", empty, 2.4) == ["set", "0", "–", "–", "0", "–", "–", "2"]
    views = {name: {"predicted": dB, "nearest_photo": 20.0, "flat": 18.0} for name, dB in (("a", 24.0), ("b", 26.0))}
    cells = real_sets.row_of("set", msgspec.structs.replace(empty, views=views), 2.4)
    assert cells[4:6] == ["2", "25.0 (20.0; 18.0)"]


def test_the_gallery_shows_every_recipe():
    page, files = gallery.PAGE.read_text(encoding="utf-8"), sorted((gallery.PAGE.parent / "gallery").iterdir())
    recipes = {file.stem for folder in ("", gallery.DATASET) for file in (ROOT / "recipes" / folder).glob("*.yaml")}
    assert {file.stem for file in files} == recipes and all(f"RECIPE={name}</code>" in page for name in recipes)
    assert max(file.stat().st_size for file in files) <= 60_000


def test_a_prior_is_fitted_to_the_maps_that_light_no_photo(tmp_path):
    maps = [Path(f"maps/{name}.exr") for name in "abcdefghijkl"]
    lit, others = split_maps(maps, 6)
    assert len(lit) == MAPS and sorted(lit + others) == maps
    assert split_maps(maps, 6) == (lit, others) and split_maps(maps, 7)[0] != lit
    with pytest.raises(InputError, match="7 maps"):
        split_maps(maps[:7], 6)
    for folder in ("b", "a"):  # maps of one name both light a set
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "sky.exr").write_text(folder)
    both = link_maps([tmp_path / "b/sky.exr", tmp_path / "a/sky.exr"], tmp_path / "both")
    assert [path.read_text() for path in sorted(both.iterdir())] == ["b", "a"]


def test_fifths_and_chroma_of_lights_are_in_the_gauge_of_the_set(tmp_path):
    """Lights times a factor per channel are exact, but for the directions near the top, which are too dark."""
    true = np.broadcast_to(1 + np.linspace(0, 4, 64)[:, None, None], (64, 128, 3)) * [1.0, 0.8, 1.2]
    factor, darker = [1.3, 0.9, 1.1], np.where(np.arange(64)[:, None, None] < 5, 0.5, 1.0)
    for folder, light in (("export", true * factor * darker), ("evaluate", true)):
        (tmp_path / folder / "illumination").mkdir(parents=True)
        write_rgb_exr(tmp_path / folder / "illumination" / "sky.exr", light.astype(np.float32), LAT_LONG)
    result, other = (SetResult("", {"relit_set": {"factor": each}}, tmp_path) for each in (factor, [1, 1, 1]))
    assert result.fifths()[0] < 0.98 and result.fifths()[1:] == pytest.approx(1, rel=1e-3)
    assert result.chroma()[0] < 1e-3 and other.chroma()[0] > 0.1


def written(folder, roughness, scale, light, names=("one", "two")):
    """Two materials times a scale, and one light with a relative standard error of .1."""
    stderr = StandardErrors((0.02, 0.02, 0.02), (0.01, 0.01, 0.01), 0.05)
    one = attach_errors(Reflectance((0.4 * scale,) * 3, (0.1 * scale,) * 3, roughness), stderr)
    two = attach_errors(Reflectance((0.2 * scale,) * 3, (0.04 * scale,) * 3, 0.5), stderr)
    for kind in ("illumination", "coverage"):
        (folder / "export" / kind).mkdir(parents=True)
    write_json(folder / "export/materials.json", MaterialTable(dict(zip(names, (one, two), strict=True))))
    write_rgb_exr(folder / "export/illumination/room.exr", light, LAT_LONG)
    write_rgb_exr(folder / "export/coverage/room.exr", 0.1 * light / light.mean(), LAT_LONG)
    return folder


def test_deviations_between_two_runs_are_in_standard_errors_after_the_free_factor(tmp_path):
    light = np.ones((64, 128, 3))
    brighter = light.copy()
    brighter[:16] *= np.exp(0.2)  # the upper quarter of the rows: two standard errors
    one, other = written(tmp_path / "a", 0.3, 1.0, light), written(tmp_path / "b", 0.4, 2.0, 3 * brighter)
    deviations = material_deviations(one, other)
    assert deviations["diffuse"] == pytest.approx(np.zeros(6), abs=1e-9)
    assert deviations["roughness"] == pytest.approx([2, 0])
    off = light_deviations(one, other)
    assert np.median(off) == pytest.approx(0, abs=1e-4) and off.max() == pytest.approx(2, rel=0.02)
    assert np.mean(off > 1.5) == pytest.approx((1 - np.cos(np.pi / 4)) / 2, abs=0.02)  # their share of the sphere
    with pytest.raises(InputError, match="'one' is missing"):
        material_deviations(one, written(tmp_path / "c", 0.3, 1.0, light, ("three", "four")))


def test_weights_of_the_verdict_are_those_that_made_the_scores(monkeypatch, capsys):
    """Scores that follow the formula with other weights give these weights; every set has its row."""
    weights, terms = (
        np.array([0.1, 0.3, verdict.UNEXPLAINED, 0.5]),
        np.random.default_rng(0).uniform(0.01, 0.1, (12, 4)),
    )
    scores = verdict.expected_psnr(weights, terms).tolist()
    sets = [
        verdict.VerdictOnSet(f"way {k}", score, "good", 20.0 + k, row.tolist())
        for k, (score, row) in enumerate(zip(scores, terms, strict=True))
    ]
    np.testing.assert_allclose(verdict.fit_weights(sets), weights, rtol=0.01)
    monkeypatch.setattr(verdict, "measure", lambda kind: sets)
    monkeypatch.setattr("sys.argv", ["verdict", "fit"])
    verdict.main()
    printed = capsys.readouterr().out
    assert all(f"| way {k} | {score:.1f} | {20 + k:.1f} | good |" in printed for k, score in enumerate(scores))


def test_degraded_solids_keep_the_truth_of_what_they_show(tmp_path):
    degrade(ROOT / "data/synthetic", tmp_path / "set", ["bent", "few"], 3)
    spec, truth = (
        yaml.safe_load((tmp_path / f"set/{name}").read_text()) for name in ("dataset.yaml", "truth/truth.yaml")
    )
    names = [photo["name"] for photo in spec["photos"]]
    assert len(names) == 2 and sorted(truth["illumination"]) == sorted(truth["normals"]) == sorted(names)
    whole, coarse = (
        read_mesh(folder / "meshes/vase.ply", ["all"], "all") for folder in (ROOT / "data/synthetic", tmp_path / "set")
    )
    assert len(coarse.faces) <= 500 < len(whole.faces)
    off = cKDTree(whole.vertices).query(coarse.vertices)[0].max() / np.linalg.norm(np.ptp(whole.vertices, axis=0))
    assert 0.005 < off < 0.05
