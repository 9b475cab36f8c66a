"""What measurements promise: sections of docs/results.md, a gallery of every recipe, maps that a prior must not know."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial import cKDTree

from factorlib.meshes.read_mesh import read_mesh
from studies.measured import gallery, results
from studies.measured.degradations import degrade
from studies.measured.eames_like import MAPS, split_maps
from studies.measured.tools import ROOT, replace_sections
from tests.refusal import refusal


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
    refusal("no place for the table 'other'", replace_sections, page, {"other": ""})


def test_the_gallery_shows_every_recipe():
    page, files = gallery.PAGE.read_text(encoding="utf-8"), sorted((gallery.PAGE.parent / "gallery").iterdir())
    recipes = {file.stem for folder in ("", gallery.DATASET) for file in (ROOT / "recipes" / folder).glob("*.yaml")}
    assert {file.stem for file in files} == recipes and all(f"RECIPE={name}</code>" in page for name in recipes)
    assert max(file.stat().st_size for file in files) <= 60_000


def test_a_prior_is_fitted_to_the_maps_that_light_no_photo():
    maps = [Path(f"maps/{name}.exr") for name in "abcdefghijkl"]
    lit, others = split_maps(maps, 6)
    assert len(lit) == MAPS and sorted(lit + others) == maps
    assert split_maps(maps, 6) == (lit, others) and split_maps(maps, 7)[0] != lit
    refusal("7 maps", split_maps, maps[:7], 6)


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
