"""Re-synthesis of photographs without a truth: `make results ONLY=real_sets REAL="FOLDER …"`.

DSSIM and PSNR of the re-synthesis of the photos that were solved stand beside those of flat colours: each material of
each photo in its own mean colour.  The pipeline runs first, as `make evaluate` does, as far as anything must run: some
minutes a set.
"""

from pathlib import Path

import msgspec

from factorlib.results.metrics import Metrics
from studies.measured.tools import Tables, environment_words, evaluate_dataset, format_number

PSNR = "PSNR, tone-mapped, of the re-synthesis (dB)"
FLAT = "of flat colours"
HEAD = ["set, mean over photos", "DSSIM of the re-synthesis", FLAT, PSNR, FLAT]


def rows_of(name: str, metrics: Metrics) -> list[list[str]]:
    """Return the row of a set: mean DSSIM and PSNR of the re-synthesis, beside those of flat colours."""
    if not metrics.resynthesis.mean:
        return []
    errors = metrics.resynthesis.mean["none"]
    values = errors.estimate, errors.null
    return [[name, *(format_number(e.dssim, 3) for e in values), *(f"{e.psnr_tonemapped_db:.1f}" for e in values)]]


def rows() -> Tables:
    """Return the rows of all folders.  InputError if none is named."""
    folders = [Path(word).resolve() for word in environment_words("REAL", "folders of photographs")]
    lines = [row for f in folders for row in rows_of(f.name, msgspec.convert(evaluate_dataset(f), Metrics))]
    return {"Re-synthesis": [HEAD, *lines]}
