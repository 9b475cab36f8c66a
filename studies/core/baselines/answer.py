"""A method's answer from what its step wrote, and the processor seconds that it took."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from benchmarks.tools import Clock
from factorlib.jsonfile import read_json
from factorlib.results.materials import Reflectance
from studies.core.baselines.case import Comparison
from studies.core.baselines.grey import grey
from studies.core.baselines.intrinsic import intrinsic
from studies.core.baselines.joint import Optimised
from studies.core.baselines.photos import Photos
from studies.core.baselines.prediction import Prediction
from studies.core.baselines.projective import projective
from studies.core.baselines.solved import mitsubas, ours

Truths = Mapping[str, Reflectance]
QUICK_ONES: dict[str, Callable[[Photos, Truths], Prediction]] = {
    "projective": lambda photos, truths: projective(photos),
    "intrinsic": intrinsic,
    "grey": grey,
}


def answer(case: Comparison, photos: Photos, found: Path, truths: Truths) -> tuple[Prediction, float]:
    """found: the folder that the method's step wrote, empty of those that take less than a second, which are computed here."""
    if case.method in QUICK_ONES:
        clock = Clock()
        return QUICK_ONES[case.method](photos, truths), clock.taken().processor
    if case.method == "mitsuba":
        optimised = msgspec.convert(read_json(found / "optimised.json"), Optimised, str_keys=True)
        return mitsubas(optimised, truths), optimised.processor
    return ours(found, case.lights, truths), read_json(found / "taken.json")["processor"]
