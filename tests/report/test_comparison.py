"""`make compare`: two results on one page."""

import html
import re
import shutil

import numpy as np
import pytest

from factorlib.errors import InputError
from factorlib.images.exr import LAT_LONG, write_rgb_exr
from factorlib.jsonfile import write_json
from factorlib.report.comparison import comparison
from factorlib.results.materials import Gauge, MaterialTable, Reflectance, StandardErrors, solved
from factorlib.results.photos import PhotoFacts
from factorlib.runner import verbs
from factorlib.runner.project import Project, Provider
from tests.runner import toy

ERROR = StandardErrors((0.01,) * 3, (0.01,) * 3, 0.02)
EVIL = "<script>alert(1)</script>"


def material(factor=1.0, roughness=0.3):
    return solved(Reflectance((0.3 * factor, 0.2 * factor, 0.1 * factor), (0.05 * factor,) * 3, roughness), ERROR)


def result(folder, roughness=0.3, factor=1.0, light=1.0, names=("red", EVIL), photo="kitchen"):
    materials = {name: material(factor, roughness) for name in names}
    write_json(folder / "masks" / "photos.json", {photo: PhotoFacts(8, 8, 1, (8, 8), illumination=photo)})
    write_json(folder / "export" / "materials.json", MaterialTable(materials))
    for place in ("export/illumination", "render/resynthesis"):
        (folder / place).mkdir(parents=True, exist_ok=True)
        write_rgb_exr(folder / place / f"{photo}.exr", np.full((8, 16, 3), light), LAT_LONG)
    return folder


@pytest.fixture
def folders(tmp_path):
    for name in "ab":
        for place in ("masks", "export"):
            (tmp_path / name / place).mkdir(parents=True)
    return tmp_path / "a", tmp_path / "b"


def apart(page):
    """The last column of the table of materials, as numbers."""
    cells = re.findall(r"<td>((?:<span.*?</span>(?:, )?)+)</td>", page)
    return [[float(v.replace("−", "-")) for v in re.findall(r">([^<]+)</span>", cell)] for cell in cells]


def test_equal_results_are_nowhere_apart(folders):
    page = comparison(result(folders[0]), result(folders[1]), [])
    assert all(v == 0 for row in apart(page) for v in row) and "bad" not in page.split("<h2>Materials")[1]
    assert "The same sources, parameters" in page and page.count("RMS difference 0.0 %") == 2
    page = comparison(*folders, None)
    assert EVIL not in page and html.escape(EVIL) in page and "no longer has the records" in page


def test_differences_are_in_standard_errors_after_the_free_factor(folders):
    result(folders[0]), result(folders[1], roughness=0.4, factor=0.5, light=1.5)
    page = comparison(*folders, ["solve: parameter lobes: 32 -> 64"])
    off = apart(page)
    assert off[0] == off[1] == [0, 0, 0]
    assert off[2] == [pytest.approx(0.1 / np.hypot(0.02, 0.02), abs=0.05)] and 'class="bad"' in page
    assert "solve: parameter lobes: 32 -&gt; 64" in page and page.count("RMS difference 50.0 %") == 2


def with_components(folder, factors, component):
    result(folder, names=tuple(factors))
    table = MaterialTable({name: material(factor) for name, factor in factors.items()}, Gauge(component=component))
    write_json(folder / "export" / "materials.json", table)
    return folder


@pytest.mark.parametrize(
    "first, second, equal",
    [
        ({"red": 0, "blue": 1}, {"red": 1, "blue": 0}, True),  # two components in both, whatever their numbers
        (
            {"red": 0, "blue": 0},
            {"red": 0, "blue": 1},
            True,
        ),  # linked in the first alone: the second's factors are free
        ({"red": 0, "blue": 0}, {"red": 0, "blue": 0}, False),  # linked in both: their ratio is observed
    ],
)
def test_every_component_has_a_factor_of_its_own(folders, first, second, equal):
    with_components(folders[0], {"red": 1.0, "blue": 1.0}, first)
    with_components(folders[1], {"red": 0.5, "blue": 2.0}, second)
    page = comparison(*folders, [])
    assert all(v == 0 for row in apart(page) for v in row) == equal


def test_what_only_one_has_is_named_and_nothing_in_common_is_refused(folders):
    page = comparison(result(folders[0], names=("red", "oak")), result(folders[1], names=("red",)), [])
    assert "Only in the first: oak." in page
    result(folders[1], names=("other",), photo="garden")
    with pytest.raises(InputError, match="no photo and no material in common"):
        comparison(*folders, [])


@pytest.mark.parametrize("missing", ["masks", "export"])
def test_a_result_that_is_not_whole_is_refused_with_the_stage_and_the_cure(folders, missing):
    result(folders[0]), result(folders[1])
    shutil.rmtree(folders[1] / missing)
    (folders[1] / "dataset.txt").write_text("data/chairs\n")  # b is a copy
    with pytest.raises(InputError, match="the result is incomplete") as error:
        comparison(*folders, [])
    words = f"the stage {missing!r}", "make all DATASET=chairs", str(folders[1])
    assert all(word in str(error.value) for word in words)


def test_the_command_says_what_changed_between_the_runs(tmp_path, capsys):
    project = toy.make_project(tmp_path / "root")
    project = Project(project.root, Provider(("photo",), toy.read))
    assert verbs.make(project, verbs.Request("set")) == 0
    shutil.copytree(project.build / "set", tmp_path / "before")
    assert verbs.make(project, verbs.Request("set", settings=["upper.times=2"])) == 0
    for folder in (tmp_path / "before", project.build / "set"):
        (folder / "masks").mkdir()
        (folder / "export").mkdir()
        result(folder)
    assert verbs.compare(project, tmp_path / "before", project.build / "set") == 0
    page = (project.build / "compare" / "before-set" / "index.html").read_text()
    assert html.escape("upper: parameter times: default -> 2") in page and page.count("<li>") == 1
    with pytest.raises(InputError, match="is no folder of results\n  known are: 'set'"):
        verbs.compare(project, tmp_path / "before", tmp_path / "nothing")
    project = Project(toy.make_project(tmp_path / "new").root, Provider(("photo",), toy.read))  # where nothing was run
    with pytest.raises(InputError, match="make all DATASET=<name> makes one"):
        verbs.compare(project, tmp_path / "a", tmp_path / "b")
