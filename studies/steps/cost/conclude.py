"""What the study comes to, and the exponents: writes table.csv, table.json, figure.svg and paragraph.md."""

from __future__ import annotations

from pathlib import Path

import msgspec

from factorlib.stage import Inputs, Progress
from studies.core.exponents import called, exponents
from studies.core.measures import MEASURES
from studies.core.table import Conclusion, Spread
from studies.report.curves import curves
from studies.steps.conclusion import conclude

ANSWERS = {
    "linear": "agrees",
    "less than linear": "disagrees: less than linear",
    "more than linear": "disagrees: more than linear",
}


class Params(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Nothing to choose."""


def main(params: Params, inputs: Inputs, out: Path, progress: Progress) -> None:
    """Sum up the costs of all cases."""
    conclude(inputs, out, notes=notes, answer=answer, drawn=curves)


def notes(found: Conclusion) -> list[str]:
    """Exponents, where there are two sizes or more; and what a GPU would do."""
    kinds = {"6 lobes a light": "", "as the solve is by default": "default-"}
    said = [
        _said(found, words, prefix, m)
        for words, prefix in kinds.items()
        for m in ("seconds", "grown")
        if len(_sizes(found, prefix)) > 1
    ]
    return [*said, "The paper's 30 minutes are of other pictures, another machine and a GPU: no ratio is drawn."]


def answer(found: Conclusion) -> str:
    """Of time with few lobes, against the paper's linear."""
    return ANSWERS.get(called(_exponent(found, "", "seconds")), "not decided")


def _said(found: Conclusion, words: str, prefix: str, measure: str) -> str:
    sizes, e = _sizes(found, prefix), _exponent(found, prefix, measure)
    start = f"{MEASURES[measure].label} grows as entries to the power {e.mean:.2f}"
    between = f"{min(sizes):,} to {max(sizes):,} entries, {words}"
    if e.low is None:
        return f"{start} ({between}; one seed, no interval)."
    return f"{start}, {e.low:.2f} to {e.high:.2f} over {e.seeds} seeds ({between}): {called(e)}."


def _exponent(found: Conclusion, prefix: str, measure: str) -> Spread:
    rows = {row.name: row for row in found.rows}
    return exponents({n: rows[f"{prefix}{n}"].cells[measure].values for n in _sizes(found, prefix)}, found.seeds)


def _sizes(found: Conclusion, prefix: str) -> list[int]:
    """Numbers of entries of the settings that begin so."""
    names = [row.name.removeprefix(prefix) for row in found.rows if row.name.startswith(prefix)]
    return [int(name) for name in names if name.isdigit()]
