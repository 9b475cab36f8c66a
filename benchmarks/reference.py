"""The numbers of data/synthetic that a run must reproduce: `make bench-reference REASON="why they changed"` writes them anew.

Runs the pipeline on data/synthetic with several seeds of the solve (what is current is not run again) and writes
tests/regression/synthetic.json: of each number its value with the default seed, how far other seeds lie apart, the tolerance that
follows, and below them the reasons of all refreshes with what each changed; and the paragraph of README.md that quotes them.
`make test` runs the default seed and compares.

Tolerance    t · √2 · s, s the standard deviation over seeds and t Student's of n − 1 degrees of freedom at 1 − DOUBT / 2: two runs that
             differ by nothing but their seeds lie further apart once in 1 / DOUBT times, a number.  On the processors of
             docs/reproducibility.md a run gives the same bits, so that any change at all is one of the sources; a change within
             the tolerance is as small as another seed's.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
from scipy.stats import t as student

from benchmarks.markdown import refresh
from benchmarks.numbers import NUMBERS
from factorlib.errors import InputError
from factorlib.evaluate.table import value_at
from factorlib.jsonfile import read_json, write_json
from factorlib.results.metrics import read_metrics
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets

DATASET = "synthetic"
STORED = LIBRARY / "tests" / "regression" / "synthetic.json"
SEEDS = 5
DOUBT = 0.01
COMMAND = 'make bench-reference REASON="why the numbers changed"'


class Number(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """value: of the default seed;  low, high, deviation: over seeds;  tolerance: in the number's own unit, either way."""

    meaning: str
    value: float
    low: float
    high: float
    deviation: float
    tolerance: float


class Refresh(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Why numbers were written anew, and those that became others: path -> [old, new]."""

    reason: str
    changed: dict[str, tuple[float, float]]


class Stored(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All of the file.  numbers: by their dotted path in metrics.json;  refreshes: the newest first."""

    dataset: str
    seeds: int
    doubt: float
    numbers: dict[str, Number]
    refreshes: list[Refresh]


class Difference(msgspec.Struct, frozen=True):
    """A number that is not what is stored; new: None where it is missing."""

    path: str
    old: Number
    new: float | None

    def line(self) -> str:
        """Old and new, for people.

        >>> Difference("a.b", Number("roughness", 0.01, 0.009, 0.011, 0.001, 0.005), 0.02).line()
        'roughness: old 0.01, new 0.02, by +0.01, tolerance 0.005 (a.b)'
        """
        found = "missing" if self.new is None else f"{self.new:.4g}, by {self.new - self.old.value:+.2g}"
        return f"{self.old.meaning}: old {self.old.value:.4g}, new {found}, tolerance {self.old.tolerance:.2g} ({self.path})"


def tolerance(values: Sequence[float], doubt: float = DOUBT) -> float:
    """Of a number whose values with some seeds are these.

    >>> round(tolerance([0.0, 1.0, 2.0, 3.0, 4.0]), 3)
    10.295
    """
    n = len(values)
    return float(student.ppf(1 - doubt / 2, n - 1) * np.sqrt(2) * np.std(values, ddof=1))


def differences(metrics: object, stored: Stored) -> list[Difference]:
    """The numbers that are further from what is stored than their tolerance, or missing; a better one too, for it has to be stored."""
    found = [Difference(path, number, value_at(metrics, path)) for path, number in stored.numbers.items()]
    return [d for d in found if d.new is None or not abs(d.new - d.old.value) <= d.old.tolerance]


def complaint(found: Sequence[Difference]) -> str:
    """What to do about them."""
    lines = "\n".join(f"  {d.line()}" for d in found)
    return f"{len(found)} number(s) of data/{DATASET} are not those stored:\n{lines}\nif that is meant, store them: {COMMAND}"


def read_stored(path: Path = STORED) -> Stored:
    """The stored numbers."""
    return msgspec.convert(read_json(path), Stored)


def stored(runs: Sequence[object], reason: str, before: Stored | None) -> Stored:
    """From the metrics of all seeds, the default one first.  InputError where a number is missing."""
    values = {path: [value_at(metrics, path) for metrics in runs] for path in NUMBERS}
    for path in (p for p, v in values.items() if None in v):
        raise InputError(
            "there is no such number", file=Path("metrics.json"), key=path, cure="correct benchmarks/numbers.py"
        )
    numbers = {
        p: Number(NUMBERS[p], v[0], min(v), max(v), float(np.std(v, ddof=1)), tolerance(v)) for p, v in values.items()
    }
    old: Mapping[str, Number] = before.numbers if before else {}
    changed = {p: (old[p].value, n.value) for p, n in numbers.items() if p in old and old[p].value != n.value}
    return Stored(DATASET, len(runs), DOUBT, numbers, [Refresh(reason, changed), *(before.refreshes if before else [])])


def checked(reason: str) -> str:
    """The reason without blanks around it.  InputError where nothing is left."""
    if not reason.strip():
        raise InputError("no reason is given", key="reason", cure=COMMAND)
    return reason.strip()


def quoted(found: Stored) -> str:
    """The paragraph of README.md."""

    def shown(path: str, form: str, scale: float = 1.0) -> str:
        """A number and its range."""
        n = found.numbers[path]
        value, low, high = (
            (form % (scale * v)).replace("0.", ".", 1 if scale * v < 1 else 0) for v in (n.value, n.low, n.high)
        )
        return f"{value} ({low} to {high})"

    return (
        f"On `data/{found.dataset}` (known answer, exact meshes; the default seed, and the range of {found.seeds} seeds of the solve,\n"
        f"`python -m benchmarks.reference`): roughness is wrong by {shown('materials.worst_roughness', '%.3f')},\n"
        f"diffuse by {shown('materials.worst_diffuse', '%.1f', 100)} %, specular by {shown('materials.worst_specular', '%.1f', 100)} %\n"
        f"of the worst material and channel, after one factor a channel; re-synthesis "
        f"{shown('resynthesis.worst_psnr_linear_db', '%.1f')} dB linear in\nthe worst photo; balls of the materials in the true light "
        f"{shown('relighting.mean.scalar_per_set.in_true_light.psnr_tonemapped_db', '%.1f')} dB."
    )


def run(project: Project, seed: int) -> object:
    """The metrics of a run of the pipeline with that seed of the solve."""
    if verbs.make(project, verbs.Wish(DATASET, ["evaluate"], [f"solve.seed={seed}"])) != 0:
        raise SystemExit(1)
    return msgspec.to_builtins(read_metrics(project.build / DATASET / "evaluate" / "metrics.json"))


def main(
    reason: Annotated[str, typer.Argument(help="why the numbers changed; it is stored beside them", envvar="REASON")],
    seeds: Annotated[int, typer.Option(help="of the solve, the default one among them", min=3)] = SEEDS,
) -> None:
    """Run all seeds, the default one last, so that build/ shows it afterwards; write, and print what changed."""
    why, project, before = checked(reason), Project(LIBRARY, photo_sets()), read_stored() if STORED.exists() else None
    runs = [run(project, seed) for seed in reversed(range(seeds))][::-1]
    write_json(STORED, found := stored(runs, why, before))
    refresh(LIBRARY / "README.md", {"synthetic": quoted(found)})
    print(
        "\n".join(f"{found.numbers[p].meaning}: {a:.4g} -> {b:.4g}" for p, (a, b) in found.refreshes[0].changed.items())
        or "nothing changed"
    )


if __name__ == "__main__":
    try:
        typer.run(main)
    except InputError as error:
        sys.exit(f"error: {error}")
