"""Photographs without a truth: `make results ONLY=real_sets REAL="FOLDER[:PHOTO,…] …"`.

PSNR of the re-synthesis of the photos that were solved stands beside that of flat colours (each material of each photo
in its own mean colour), and that of photos that were held out beside the nearest photo, warped.  Photos are held out
by the data set (`held_out: true`), or are named after the folder.  The pipeline runs first, as `make evaluate` does, as
far as anything must run: some minutes a set.
"""

from pathlib import Path

import msgspec
import numpy as np

from factorlib.results.metrics import Metrics
from studies.measured.tools import Tables, environment_words, evaluate_dataset, processor_seconds

HEAD = [
    "set",
    "photos solved",
    "re-synthesis, dB (flat colours)",
    "DSSIM (flat colours)",
    "photos held out",
    "predicted, dB (nearest photo; flat colours)",
    "verdict: expected relit set score",
    "processor minutes",
]


def row_of(name: str, metrics: Metrics, minutes: float) -> list[str]:
    """Return the row of a set: means over photos, the verdict, and the cost."""
    cells = [name, str(len(metrics.resynthesis.photos)), "–", "–", "0", "–", "–", f"{minutes:.0f}"]
    if metrics.resynthesis.mean:
        errors = metrics.resynthesis.mean["none"]
        cells[2] = f"{errors.estimate.psnr_tonemapped_db:.1f} ({errors.null.psnr_tonemapped_db:.1f})"
        cells[3] = f"{errors.estimate.dssim:.3f} ({errors.null.dssim:.3f})"
    if metrics.views:
        mean = {
            key: np.mean([v[key] for v in metrics.views.values()]) for key in ("predicted", "nearest_photo", "flat")
        }
        cells[4] = str(len(metrics.views))
        cells[5] = f"{mean['predicted']:.1f} ({mean['nearest_photo']:.1f}; {mean['flat']:.1f})"
    if verdict := metrics.verdict:
        cells[6] = f"{verdict.trust}, {verdict.expected_relit_db:.0f} ± {verdict.deviation_db:.0f} dB"
    return cells


def measure(word: str) -> list[str]:
    """Return the row of a folder, with the photos to hold out after a colon."""
    folder, _, held_out = word.partition(":")
    path = Path(folder).resolve()
    metrics = msgspec.convert(evaluate_dataset(path, HELD_OUT=held_out), Metrics)
    seconds = processor_seconds(path, held_out=held_out.split(",") if held_out else ())
    return row_of(path.name, metrics, (sum(seconds.values()) - seconds["train"]) / 60)


def rows() -> Tables:
    """Return the rows of all folders.  InputError if none is named."""
    words = environment_words("REAL", "folders of photographs")
    return {"Photographs": [HEAD, *(measure(word) for word in words)]}
