"""The numbers of data/synthetic that a run must reproduce: `python -m studies.measured.reference "why they changed"` writes them anew.

It runs the pipeline on data/synthetic with `SEEDS` seeds of the solve (what is current is not run again) and writes
tests/regression/synthetic.json: of each number its value with the default seed, its range and deviation over seeds, the tolerance that
follows, and the reasons of all refreshes with what each changed.  `make test` runs the default seed and compares.

Tolerance    t · √2 · s, s the standard deviation over seeds and t Student's of n − 1 degrees of freedom at 1 − DOUBT / 2: two runs that
             differ by nothing but their seeds lie further apart once in 1 / DOUBT times, a number.  On the processors of
             docs/reproducibility.md a run gives the same bits, so that any change at all is one of the sources; a change within
             the tolerance is as small as another seed's.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from scipy.stats import t as student

from factorlib.errors import InputError
from factorlib.evaluate.table import SYNTHETIC, value_at
from factorlib.jsonfile import read_json, write_json
from studies.measured.tools import ROOT, Tables, evaluated

DATASET, SEEDS, DOUBT = "synthetic", 5, 0.01
STORED = ROOT / "tests" / "regression" / "synthetic.json"
COMMAND = '.venv/bin/python -m studies.measured.reference "why the numbers changed"'
NUMBERS = {  # dotted path in metrics.json -> meaning
    **{bound.path: bound.meaning for bound in SYNTHETIC},
    "materials.mean_roughness": "roughness, mean over materials",
    "materials.mean_diffuse": "diffuse, mean, relative",
    "materials.mean_specular": "specular, mean, relative",
}


class Number(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """value: of the default seed;  low, high, deviation: over seeds;  tolerance: in the number's own unit, either way."""

    meaning: str
    value: float
    low: float
    high: float
    deviation: float
    tolerance: float


class Refresh(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Why numbers were written anew, and those that became others: path -> (old, new)."""

    reason: str
    changed: dict[str, tuple[float, float]]


class Stored(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file.  numbers: by their dotted path in metrics.json;  refreshes: the newest first."""

    dataset: str
    seeds: int
    doubt: float
    numbers: dict[str, Number]
    refreshes: list[Refresh]


def tolerance(values: Sequence[float], doubt: float = DOUBT) -> float:
    """The tolerance of a number that has these values with some seeds.

    >>> round(tolerance([0.0, 1.0, 2.0, 3.0, 4.0]), 3)
    10.295
    """
    return float(student.ppf(1 - doubt / 2, len(values) - 1) * np.sqrt(2) * np.std(values, ddof=1))


def differences(metrics: object, stored: Stored) -> dict[str, str]:
    """Path -> a line for people, of each number that is missing or further from the stored one than its tolerance, for better or worse."""
    lines = {}
    for path, old in stored.numbers.items():
        new = value_at(metrics, path)
        if new is None or not abs(new - old.value) <= old.tolerance:
            change = "missing" if new is None else f"{new:.4g}, by {new - old.value:+.2g}"
            lines[path] = f"{old.meaning}: old {old.value:.4g}, new {change}, tolerance {old.tolerance:.2g} ({path})"
    return lines


def complaint(lines: dict[str, str]) -> str:
    """The differences, and what to do about them."""
    listed = "\n".join(f"  {line}" for line in lines.values())
    return f"{len(lines)} number(s) of data/{DATASET} are not those stored:\n{listed}\nif that is meant, store them: {COMMAND}"


def read_stored() -> Stored:
    """The stored numbers."""
    return msgspec.convert(read_json(STORED), Stored)


def stored(runs: Sequence[object], reason: str, before: Stored | None) -> Stored:
    """The numbers of runs with several seeds, the default one first.  InputError where a number is missing."""
    values = {path: [value_at(metrics, path) for metrics in runs] for path in NUMBERS}
    if missing := [path for path, of in values.items() if None in of]:
        raise InputError(
            "there is no such number", file=Path("metrics.json"), key=missing[0], cure="correct NUMBERS in studies/measured/reference.py"
        )  # fmt: skip
    numbers = {
        p: Number(NUMBERS[p], v[0], min(v), max(v), float(np.std(v, ddof=1)), tolerance(v)) for p, v in values.items()
    }
    old = before.numbers if before else {}
    changed = {p: (old[p].value, n.value) for p, n in numbers.items() if p in old and old[p].value != n.value}
    refreshes = [Refresh(reason, changed), *(before.refreshes if before else [])]
    return Stored(DATASET, len(runs), DOUBT, numbers, refreshes)


def rows() -> Tables:
    """The stored numbers, which `make test` holds the pipeline to."""
    kept = read_stored()
    lines = [[n.meaning, *(f"{v:.4g}" for v in (n.value, n.low, n.high))] for n in kept.numbers.values()]
    return {
        f"Default seed of the solve, and {kept.seeds} seeds": [["number", "default seed", "least", "largest"], *lines]
    }


def main(reason: str) -> None:
    """Run all seeds, the default one last, so that build/ has it afterwards; write, and print what changed."""
    if not reason:
        raise InputError("no reason is given", key="reason", cure=COMMAND)
    before = read_stored() if STORED.exists() else None
    runs = [evaluated(DATASET, SET=f"solve.seed={seed}") for seed in reversed(range(SEEDS))][::-1]
    write_json(STORED, new := stored(runs, reason, before))
    changed = [f"{new.numbers[p].meaning}: {a:.4g} -> {b:.4g}" for p, (a, b) in new.refreshes[0].changed.items()]
    print("\n".join(changed) or "nothing changed")


if __name__ == "__main__":
    try:
        main(" ".join(sys.argv[1:]).strip())
    except InputError as error:
        sys.exit(f"error: {error}")
