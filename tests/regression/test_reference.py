"""Stored numbers: a run fails where one is moved beyond what seeds change of it, either way, and says old and new."""

import msgspec
import numpy as np
import pytest

from benchmarks.reference import NUMBERS, Stored, complaint, differences, main, read_stored, stored, tolerance
from factorlib.errors import InputError

PATH = "materials.worst_roughness"


def metrics(values):
    """What evaluate writes, as far as NUMBERS look; values: by path."""
    nested = {}
    for path, value in values.items():
        *folders, last = path.split(".")
        at = nested
        for folder in folders:
            at = at.setdefault(folder, {})
        at[last] = value
    return nested


def of_seed(roughness, scale=1.0):
    return metrics({p: scale * (k + 1.0) for k, p in enumerate(NUMBERS)} | {PATH: roughness})


SEEDS = (0.010, 0.011, 0.012, 0.009, 0.013)
FIVE = stored([of_seed(r, 1 + k / 100) for k, r in enumerate(SEEDS)], "first", None)


def test_the_default_run_and_the_other_seeds_pass():
    assert not any(differences(of_seed(roughness), FIVE) for roughness in SEEDS)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_number_beyond_its_tolerance_fails_with_old_and_new(side):
    limit = FIVE.numbers[PATH].tolerance
    assert not differences(of_seed(0.010 + side * 0.999 * limit), FIVE)
    lines = differences(of_seed(moved := 0.010 + side * 1.001 * limit), FIVE)
    text = complaint(lines)
    assert (
        list(lines) == [PATH] and "old 0.01, " in text and f"new {moved:.4g}" in text and "benchmarks.reference" in text
    )


@pytest.mark.parametrize("path", NUMBERS)
def test_every_stored_number_gates(path):
    """Each of the file in this folder, moved by itself."""
    kept = read_stored()
    assert kept.numbers.keys() == NUMBERS.keys() and kept.refreshes and kept.seeds >= 5
    right = {p: n.value for p, n in kept.numbers.items()}
    assert not differences(metrics(right), kept) and kept.numbers[path].tolerance > 0
    wrong = right | {path: right[path] + 1.01 * kept.numbers[path].tolerance}
    assert list(differences(metrics(wrong), kept)) == [path]


def test_a_missing_number_and_no_number_fail():
    without = of_seed(0.01)
    del without["materials"]["worst_roughness"]
    assert "new missing" in complaint(differences(without, FIVE))
    assert list(differences(of_seed(float("nan")), FIVE)) == [PATH]
    with pytest.raises(InputError, match="no such number"):
        stored([{}, {}], "none", None)


def test_a_tolerance_covers_two_runs_of_other_seeds_as_often_as_it_says():
    draws = np.random.default_rng(0).normal(size=(4000, 7))
    beyond = np.mean([abs(a - b) > tolerance(rest, doubt=0.1) for a, b, *rest in draws])
    assert 0.08 < beyond < 0.12


def test_a_refresh_needs_a_reason_and_keeps_all_of_them_with_what_changed():
    with pytest.raises(InputError, match="no reason"):
        main("")
    second = stored([of_seed(r) for r in (0.02, 0.021)], "sharper lights", FIVE)
    assert [r.reason for r in second.refreshes] == ["sharper lights", "first"]
    assert second.refreshes[0].changed == {PATH: (0.010, 0.02)} and not second.refreshes[1].changed
    assert msgspec.convert(msgspec.to_builtins(second), Stored) == second
