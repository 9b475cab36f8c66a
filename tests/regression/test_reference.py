"""Stored numbers: a run fails where one is moved beyond what seeds change of it, either way, and says old and new."""

import msgspec
import numpy as np
import pytest

from benchmarks.numbers import NUMBERS
from benchmarks.reference import Number, Stored, checked, complaint, differences, quoted, read_stored, stored, tolerance
from factorlib.errors import InputError

PATH = "materials.worst_roughness"


def metrics(roughness=0.01, scale=1.0):
    """What evaluate writes, as far as NUMBERS look."""
    found = {}
    for k, path in enumerate(NUMBERS):
        *folders, last = path.split(".")
        at = found
        for folder in folders:
            at = at.setdefault(folder, {})
        at[last] = scale * (k + 1.0)
    found["materials"]["worst_roughness"] = roughness
    return found


def of_seeds(*roughness):
    return stored([metrics(r, 1 + k / 100) for k, r in enumerate(roughness)], "first", None)


FIVE = of_seeds(0.010, 0.011, 0.012, 0.009, 0.013)


def test_the_default_run_and_the_other_seeds_pass():
    for roughness in (0.010, 0.011, 0.012, 0.009, 0.013):
        assert not differences(metrics(roughness), FIVE)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_number_beyond_its_tolerance_fails_with_old_and_new(side):
    limit = FIVE.numbers[PATH].tolerance
    assert not differences(metrics(0.010 + side * 0.999 * limit), FIVE)
    (found,) = differences(metrics(moved := 0.010 + side * 1.001 * limit), FIVE)
    text = complaint([found])
    assert found.path == PATH and "old 0.01, " in text and f"new {moved:.4g}" in text and "make bench-reference" in text


@pytest.mark.parametrize("path", NUMBERS)
def test_every_stored_number_gates(path):
    """Each of the file that is kept, moved by itself."""
    kept = read_stored()
    right = {p: n.value for p, n in kept.numbers.items()}
    values = nested(right)
    assert not differences(values, kept)
    wrong = nested(right | {path: right[path] + 1.01 * kept.numbers[path].tolerance})
    assert [d.path for d in differences(wrong, kept)] == [path]


def nested(values):
    found = {}
    for path, value in values.items():
        *folders, last = path.split(".")
        at = found
        for folder in folders:
            at = at.setdefault(folder, {})
        at[last] = value
    return found


def test_a_missing_number_and_no_number_fail():
    without = metrics()
    del without["materials"]["worst_roughness"]
    assert "new missing" in complaint(differences(without, FIVE))
    assert [d.path for d in differences(metrics(float("nan")), FIVE)] == [PATH]


def test_a_tolerance_covers_two_runs_of_other_seeds_as_often_as_it_says():
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(4000, 7))
    beyond = np.mean([abs(a - b) > tolerance(rest, doubt=0.1) for a, b, *rest in draws])
    assert 0.08 < beyond < 0.12


def test_a_refresh_needs_a_reason_and_keeps_all_of_them_with_what_changed():
    with pytest.raises(InputError, match="no reason"):
        checked("  ")
    second = stored([metrics(r) for r in (0.02, 0.021)], "sharper lights", FIVE)
    assert [r.reason for r in second.refreshes] == ["sharper lights", "first"]
    assert second.refreshes[0].changed == {PATH: (0.010, 0.02)} and not second.refreshes[1].changed
    assert msgspec.convert(msgspec.to_builtins(second), Stored) == second


def test_a_number_that_the_metrics_lack_is_named():
    with pytest.raises(InputError, match="no such number"):
        stored([{}, {}], "none", None)


def test_what_is_kept_is_what_is_asked_for():
    kept = read_stored()
    assert kept.numbers.keys() == NUMBERS.keys() and kept.refreshes and kept.seeds >= 5
    assert all(isinstance(n, Number) and n.tolerance > 0 for n in kept.numbers.values())


def test_the_readme_quotes_what_is_stored():
    from benchmarks.markdown import ROOT

    assert quoted(read_stored()) in (ROOT / "README.md").read_text(encoding="utf-8")
    assert "roughness is wrong by .010 (.009 to .013)" in quoted(FIVE)
