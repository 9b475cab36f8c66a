"""Sets like data/eames: which maps light them, and what is said of their results."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import eames_like
from benchmarks.eames_like import MAPS, QUANTITIES, Set, as_table, drawn, folder_of, paragraph
from factorlib.errors import InputError

MAPS_THERE = [Path(f"maps/{name}.exr") for name in "abcdefghijkl"]


def results(name, value):
    """Every number of a set is `value`, every null its double."""
    metrics = {}
    for quantity in QUANTITIES.values():
        for path, number in ((quantity.path, value), (quantity.null, 2 * value)):
            if path:
                *folders, key = path.split(".")
                at = metrics
                for folder in folders:
                    at = at.setdefault(folder, {})
                at[key] = number
    return Set(name, metrics, Path("build") / name)


@pytest.fixture
def deviations(monkeypatch):
    """Half of what a set finds lies within a standard error."""
    monkeypatch.setattr(eames_like, "within", lambda one: dict.fromkeys(eames_like.WITHIN, np.array([0.5, 2.0])))


def test_a_prior_is_fitted_to_the_maps_that_light_no_photo():
    lit, others = drawn(MAPS_THERE, 6)
    assert len(lit) == MAPS and sorted(lit + others) == MAPS_THERE
    assert drawn(MAPS_THERE, 6) == (lit, others) and drawn(MAPS_THERE, 7)[0] != lit
    with pytest.raises(InputError, match="7 maps"):
        drawn(MAPS_THERE[:7], 6)


def test_maps_of_one_name_from_two_folders_both_light_a_set_and_keep_their_order(tmp_path):
    paths = []
    for folder in ("b", "a"):
        (tmp_path / folder).mkdir()
        paths.append(tmp_path / folder / "sky.exr")
        paths[-1].write_text(folder)
    found = folder_of(paths, tmp_path / "both")
    assert [path.read_text() for path in sorted(found.iterdir())] == ["b", "a"]


def test_the_mean_is_over_sets_that_no_setting_was_chosen_on(deviations):
    eames, others = results("data/eames", 0.5), [results("1", 0.1), results("2", 0.3)]
    lines = as_table([eames, *others], others).splitlines()
    assert lines[2] == "| glossy sphere | .500 (1.000) | .100 (.200) | .300 (.600) | .200 ± .141 (.400) |"
    assert lines[-1] == "| log radiance of lights within one standard error | 50 % | 50 % | 50 % | 50 % |"
    assert "±" not in as_table([eames, others[0]], others[:1])


def test_readme_says_what_the_set_has_and_the_range_of_the_others():
    text = paragraph(results("data/eames", 0.5), [results("1", 0.1), results("2", 0.3)])
    assert "specular by 50 % (100 %)" in text and "On 2 sets made alike that no setting was chosen on" in text
    assert "diffuse by 20 (10 to 30) %" in text and "roughness is wrong by .200 (.100 to .300)" in text
    one = paragraph(results("data/eames", 0.5), [results("1", 0.1)])
    assert "On a set made alike" in one and "diffuse by 10 %" in one and " to " not in one


def test_a_number_that_is_missing_is_named():
    with pytest.raises(InputError, match="relighting.mean"):
        without = results("1", 0.1).metrics
        del without["relighting"]
        paragraph(Set("1", without, Path("build/1")), [results("2", 0.3)])
