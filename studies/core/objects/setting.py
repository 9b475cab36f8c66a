"""A setting of a study whose cases are of objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from studies.core.entries import Entry
from studies.core.objects.case import ObjectsCase
from studies.core.study import Scale, Setting


def setting(scale: Scale, name: str, label: str, x: float, entries: Sequence[Entry], **how: Any) -> Setting:
    """Of equal entries for all seeds, at most `entry_pixels` observations of each; how: further fields of the cases."""
    seen = tuple(sorted(entries))
    return Setting(name, label, x, lambda seed: ObjectsCase(seed, seen, scale.entry_pixels, solve=scale.solve, **how))
