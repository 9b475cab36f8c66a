"""Which setting of a study is best, and which ones are not shown to be worse."""

from __future__ import annotations

from studies.core.measures import MEASURES
from studies.core.statistics import difference
from studies.core.table import Conclusion


def best(found: Conclusion, measure: str) -> str:
    """A sentence: the setting of the least mean, and those from which no difference is shown, all of them compared with it.

    The best was picked from what it is compared with, so that the sentence is weaker than a claim.
    """
    rows = [row for row in found.rows if measure in row.cells]
    least = min(rows, key=lambda row: row.cells[measure].spread.mean)
    against = {
        row.label: difference(least.cells[measure].values, row.cells[measure].values, len(rows) - 1).verdict
        for row in rows
        if row is not least
    }
    start = f"Least mean of {MEASURES[measure].label}: “{least.label}”"
    if "too few seeds" in against.values():
        return f"{start}; of too few seeds to say whether any other is worse."
    alike = ", ".join(f"“{label}”" for label, verdict in against.items() if verdict == "not shown")
    return f"{start}; not shown to be worse: {alike}." if alike else f"{start}; all others are shown to be worse."
