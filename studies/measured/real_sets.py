"""Photo sets of which nothing is known but the photographs: `make results ONLY=real_sets REAL="FOLDER …"`.

There is no truth of photographs: all that can be said is how well the answer gives back the photos it was solved from.
So DSSIM and PSNR of the re-synthesis stand beside that of flat colours, each material of each photo in its own mean
colour, which nothing solved knows of. The pipeline runs first, as `make evaluate` does, as far as anything must run.
"""

from pathlib import Path

import msgspec

from factorlib.results.metrics import Metrics
from studies.measured.tools import Tables, evaluated, exact, needed

PSNR = "PSNR, tone-mapped, of the re-synthesis (dB)"
FLAT = "of flat colours"
HEAD = ["set, mean over photos", "DSSIM of the re-synthesis", FLAT, PSNR, FLAT]


def rows_of(name: str, metrics: Metrics) -> list[list[str]]:
    """Return the row of a set: mean DSSIM and PSNR of the re-synthesis, beside those of flat colours."""
    if not metrics.resynthesis.mean:
        return []
    errors = metrics.resynthesis.mean["none"]
    both = errors.estimate, errors.null
    return [[name, *(exact(e.dssim, 3) for e in both), *(f"{e.psnr_tonemapped_db:.1f}" for e in both)]]


def rows() -> Tables:
    """Return the rows of all folders.  InputError where none is named."""
    folders = [Path(word).resolve() for word in needed("REAL", "folders of photographs")]
    lines = [row for f in folders for row in rows_of(f.name, msgspec.convert(evaluated(f), Metrics))]
    return {"Re-synthesis": [HEAD, *lines]}
