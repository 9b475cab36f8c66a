"""What stands at the head of a measure's column and beside its axis."""

from __future__ import annotations

from studies.core.measures import MEASURES


def with_unit(measure: str) -> str:
    """The measure's label, and its unit where it has one.

    >>> with_unit("peak"), with_unit("roughness")
    ('largest memory of the process (GB)', 'error of roughness')
    """
    about = MEASURES[measure]
    return about.label if about.unit == "1" else f"{about.label} ({about.unit})"
