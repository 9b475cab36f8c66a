"""What people are shown: pictures of the study `comparison`, by what the truth, ours and the intrinsic decomposition are in each."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec

from factorlib.jsonfile import read_json
from studies.core.baselines.case import ShownShot
from studies.core.study import Scale, case_name

KINDS = ("novel_view", "novel_light")
OURS, OTHER = "ours", "intrinsic"


class Trial(msgspec.Struct, frozen=True):
    """One question.  Files are PNG; dssim: nothing scaled."""

    name: str
    caption: str
    reference: Path
    ours: Path
    other: Path
    dssim_ours: float
    dssim_other: float


def trials(scores: Path, scale: Scale, most: int) -> list[Trial]:
    """At most so many, evenly spread over seeds, materials, lights and views; scores: the folder of the study's step `score`."""
    every = [trial for seed in scale.seeds for trial in _of_seed(scores, seed)]
    count = min(most, len(every))
    return [every[(2 * k + 1) * len(every) // (2 * count)] for k in range(count)]


def _of_seed(scores: Path, seed: int) -> list[Trial]:
    ours, other = (scores / case_name(method, seed) for method in (OURS, OTHER))
    errors = {shot.asked.name: shot.dssim for shot in _shots(other)}
    found = []
    for shot in _shots(ours):
        name = shot.asked.name
        if shot.asked.kind in KINDS:
            files = (ours / f"{name}-truth.png", ours / f"{name}.png", other / f"{name}.png")
            found.append(Trial(f"{name}-seed{seed}", _caption(shot, seed), *files, shot.dssim, errors[name]))
    return found


def _caption(shot: ShownShot, seed: int) -> str:
    a = shot.asked
    what = f"new view ({a.view})" if a.kind == "novel_view" else "new light"
    return f"{a.material}, light {a.light}, {what}, seed {seed}"


def _shots(folder: Path) -> list[ShownShot]:
    return msgspec.convert(read_json(folder / "shots.json"), list[ShownShot])


def digest(found: list[Trial]) -> str:
    """Sixteen digits that name the questions: of all names and pictures."""
    whole = hashlib.sha256()
    for trial in found:
        for part in (trial.name.encode(), *(file.read_bytes() for file in (trial.reference, trial.ours, trial.other))):
            whole.update(hashlib.sha256(part).digest())
    return whole.hexdigest()[:16]
