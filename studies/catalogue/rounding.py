"""Rounding: how much does it decide?

Varied     n materials in n lights, each radiance times 1 + 10⁻⁷ · normal, which is less than a photograph's last bit: as it is, and perturbed
           in three ways.  Processors and libraries round differently too, so their answers differ by as much.
Measured   the errors of each, and by how much solves of one world lie apart at most.
"""

from __future__ import annotations

from typing import Any

from studies.study import Scale, Setting, Study, full_matrix

SIZES = {"full": (1, 2, 3), "quick": (2,)}
TIMES = {"full": 3, "quick": 1}


def settings(scale: Scale) -> list[Setting]:
    """Each size as it is, then perturbed."""
    return [
        scale.setting(f"{n}x{n}" + f"-rounding-{k}" * (k > 0), f"{n} × {n}" + f", again {k}" * (k > 0), full_matrix(n, n), rounding=k)
        for n in SIZES[scale.name]
        for k in range(TIMES[scale.name] + 1)
    ]  # fmt: skip


def notes(table: Any) -> list[str]:
    """Of each size, how far solves of one world lie apart."""
    from studies.conclusion import farthest

    solves: dict[str, list] = {}
    for row in table.rows:
        solves.setdefault(row.label.partition(",")[0], []).append({m: row.cells[m].values for m in table.measures})
    return [f"{size}: {farthest(*of)}." for size, of in solves.items()]


STUDY = Study(
    name="rounding",
    title="Rounding",
    question="How much does rounding decide?",
    paper="Nothing.",
    varied="materials × lights, rounded anew",
    measures=("diffuse", "specular", "roughness", "stated_roughness", "entries"),
    settings=settings,
    notes=notes,
)
