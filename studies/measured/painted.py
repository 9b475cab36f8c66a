"""Scores of painted sets, and what textures regain: `make results ONLY=painted LIGHTS="FOLDER …"`.

The sets are six of `studies.measured.eames_like`, without and with paint: grain on wood, and a print or a patina on two
of the shells.  Every set runs through the pipeline once.
"""

import os
from pathlib import Path

import numpy as np

from studies.measured.eames_like import CAPTURED_SEEDS, SEEDS, SetResult, generate_set, run_captured, run_pipeline
from studies.measured.tools import Tables

COUNT = 3  # of the made sets, and as many of the captured ones
SCORE = "relit_set.mean_psnr_db"
ALBEDO = "albedo.overall.{}.median"


def rows() -> Tables:
    """Return a row for each set: scores without and with paint, and the error of albedo over all pixels."""
    folders = [Path(word) for word in os.environ.get("LIGHTS", "").split()]
    pairs = [[run_made(seed, painted) for painted in (False, True)] for seed in SEEDS[:COUNT]]
    captured = CAPTURED_SEEDS[:COUNT] if folders else ()
    pairs += [[run_captured(seed, folders, painted) for painted in (False, True)] for seed in captured]
    return {"Painted sets": rows_of(pairs)}


def run_made(seed: int, painted: bool) -> SetResult:
    """Return the set of a seed in made lights."""
    return run_pipeline(str(seed), generate_set(seed, painted=painted))


def rows_of(pairs: list[list[SetResult]]) -> list[list[str]]:
    """Return the table of pairs of sets without and with paint."""
    values = np.array(
        [
            [
                plain.value(SCORE),
                painted.value(SCORE),
                plain.value(SCORE) - painted.value(SCORE),
                100 * painted.value(ALBEDO.format("estimate")),
                100 * painted.value(ALBEDO.format("null")),
            ]
            for plain, painted in pairs
        ]
    )
    head = ["set", "relit set score, plain, dB", "painted, dB", "lost, dB", "error of albedo, median, %"]
    names = [plain.name for plain, _ in pairs]
    rows = [head + ["of one colour a material, %"]]
    rows += [[name, *(f"{v:.1f}" for v in row)] for name, row in zip(names, values, strict=True)]
    return [*rows, ["median", *(f"{v:.1f}" for v in np.median(values, axis=0))]]
