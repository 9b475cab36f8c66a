"""The observations of all photos, as `urm` wrote them: those that are usable, merged."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import msgspec

from factorlib.model.observed import usable
from factorlib.model.problem import Spread
from factorlib.urm.merge import merge
from factorlib.urm.observations import Observations, read_observations


class PhotoObservations(msgspec.Struct, frozen=True):
    """Of one file: its usable observations, merged; how many it holds, and how many of those are not usable."""

    merged: Observations
    count: int
    unusable: int


def gathered(files: Sequence[Path], degrees: float, spread: Spread) -> list[PhotoObservations]:
    """Of each file, in this order; observations that are within `degrees` of each other are merged (`factorlib.urm.merge`)."""
    return spread(partial(of_file, degrees=degrees), files)


def of_file(path: Path, degrees: float) -> PhotoObservations:
    """Raises InputError for a file that holds no observations."""
    read = read_observations(path)
    seen = usable(read)
    return PhotoObservations(merge(seen, degrees), len(read), len(read) - len(seen))
