"""Numbers of data/synthetic that a run must reproduce.

`python -m studies.measured.reference "why they changed"` writes them anew.

It runs the pipeline on data/synthetic with `SEEDS` seeds of the solve (what is current is not run again), as it is and
SMALL, and writes synthetic.json and small.json in tests/studies/regression: each number with the default seed, its
range and deviation over seeds, its tolerance, and the reason and the changes of every refresh.
`make test` runs the default seed SMALL and compares, `make test-long` runs it as it is.  Of SMALL the files of each
stage count too, so that a change is named where it begins.

Tolerance    t · √2 · s, s the standard deviation over seeds and t Student's of n − 1 degrees of freedom at
             1 − DOUBT / 2: two runs that differ by nothing but their seeds lie further apart once in
             1 / DOUBT times, a number.  On the processors of docs/reproducibility.md a run gives the same bits, so that
             any change at all is one of the sources; a change within the tolerance is as small as another seed's.
             What knows no seed has ROUNDING of itself.
"""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
from scipy.stats import t as student

from factorlib.errors import InputError
from factorlib.images.exr import read_exr
from factorlib.jsonfile import read_json, write_json
from factorlib.runner import verbs
from factorlib.runner.project import Project, photo_sets
from studies.measured.tools import ROOT, Tables, evaluate_dataset, value_at

DATASET = "synthetic"
SEEDS = 5
DOUBT = 0.01
ROUNDING = 1e-5
FOLDER = ROOT / "tests" / "studies" / "regression"
COMMAND = '.venv/bin/python -m studies.measured.reference "why the numbers changed"'
SMALL = (
    *("masks.pixels=1500", "surface.observations=250", "solve.cells=100", "solve.observations=300"),
    *("solve.splittings=1", "texture.albedo=off", "export.height=64", "export.mitsuba_height=32"),
)
# dotted path in metrics.json -> lowest, highest, meaning; a quarter beyond the worst of five trained networks × two
# seeds of the solve
SPHERE = "light.mean.channel_per_photo.{}.estimate.rmse"
RMS = "sphere, of the truth's RMS"
BOUNDS = {
    "materials.worst_roughness": (0.0, 0.040, "roughness, worst material"),
    "materials.worst_diffuse": (0.0, 0.055, "diffuse, worst material and channel, relative"),
    "materials.worst_specular": (0.0, 0.038, "specular, worst material and channel, relative"),
    "resynthesis.worst_psnr_linear_db": (35.0, np.inf, "re-synthesis, worst photo, no gauge, linear"),
    "resynthesis.worst_psnr_tonemapped_db": (40.4, np.inf, "re-synthesis, worst photo, no gauge, tone-mapped"),
    "relighting.mean.scalar_per_set.in_true_light.psnr_tonemapped_db": (
        38.0,
        np.inf,
        "relit balls, one scalar per set",
    ),
    SPHERE.format("mirror"): (0.0, 0.276, f"mirror {RMS}"),
    SPHERE.format("glossy"): (0.0, 0.076, f"glossy {RMS}"),
    SPHERE.format("lambertian"): (0.0, 0.005, f"Lambertian {RMS}"),
}
NUMBERS = {
    **{path: meaning for path, (_, _, meaning) in BOUNDS.items()},
    "materials.mean_roughness": "roughness, mean over materials",
    "materials.mean_diffuse": "diffuse, mean, relative",
    "materials.mean_specular": "specular, mean, relative",
}
FILES = {  # stage -> those of its files that are images and tables of numbers
    "masks": "*.exr", "align": "*.exr", "urm": "*.parquet", "solve": "coverage/*.exr",
    "export": "illumination/*.exr", "render": "resynthesis/*.exr",
}  # fmt: skip


class Number(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Stored number and its tolerance.

    value: of the default seed;  low, high, deviation: over seeds;  tolerance: in the number's own unit, either way
    """

    meaning: str
    value: float
    low: float
    high: float
    deviation: float
    tolerance: float


class Refresh(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Reason for writing numbers anew, and those that changed: path -> (old, new)."""

    reason: str
    changed: dict[str, tuple[float, float]]


class Stored(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a file of stored numbers.

    numbers: by their dotted path in metrics.json, or stage and channel;  refreshes: the newest first
    """

    dataset: str
    seeds: int
    doubt: float
    numbers: dict[str, Number]
    refreshes: list[Refresh]


def tolerance(values: Sequence[float], doubt: float = DOUBT) -> float:
    """Return the tolerance of a number, given its values with several seeds.

    >>> round(tolerance([0.0, 1.0, 2.0, 3.0, 4.0]), 3)
    10.295
    """
    return float(student.ppf(1 - doubt / 2, len(values) - 1) * np.sqrt(2) * np.std(values, ddof=1))


def metric_numbers(metrics: object) -> dict[str, float | None]:
    """Return the NUMBERS of the content of a metrics.json; None for each that is missing."""
    return {path: value_at(metrics, path) for path in NUMBERS}


def stage_numbers(folder: Path) -> dict[str, float]:
    """Return {"stage.channel": root mean square over all FILES of that stage} of the results of a run."""
    values: dict[str, list[np.ndarray]] = {}
    for stage, pattern in FILES.items():
        for path in sorted((folder / stage).glob(pattern)):
            for name, channel in (read_exr(path) if path.suffix == ".exr" else _columns(path)).items():
                values.setdefault(f"{stage}.{name}", []).append(channel[np.isfinite(channel)].astype(float).ravel())
    return {name: float(np.sqrt(np.mean(np.square(np.concatenate(parts))))) for name, parts in values.items()}


def _columns(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a table, each as one array; of columns of bytes, the bytes."""
    columns = {}
    for name, rows in pq.read_table(path).to_pydict().items():
        columns[name] = np.frombuffer(b"".join(rows), np.uint8) if isinstance(rows[0], bytes) else np.array(rows)
    return columns


def run_small(root: Path, seed: int = 0) -> dict[str, float | None]:
    """Run data/synthetic SMALL and return its numbers, by a project of its own in the folder `root`."""
    for name in ("pipeline.yaml", "stages", "factorlib", "data"):
        if not (root / name).exists():
            (root / name).symlink_to(ROOT / name)
    project = Project(root, photo_sets())
    request = verbs.Request(DATASET, targets=["evaluate"], settings=[*SMALL, f"solve.seed={seed}"])
    if verbs.make(project, request):
        raise SystemExit(1)  # its own message is on the screen
    build = project.build / DATASET
    return metric_numbers(read_json(build / "evaluate" / "metrics.json")) | stage_numbers(build)


def differences(values: dict[str, float | None], stored: Stored) -> dict[str, str]:
    """Describe each number that is missing or further from the stored one than its tolerance, better or worse.

    The result is path -> a line for people.
    """
    lines = {}
    for path, old in stored.numbers.items():
        new = values.get(path)
        if new is None or not abs(new - old.value) <= old.tolerance:
            change = "missing" if new is None else f"{new:.4g}, by {new - old.value:+.2g}"
            lines[path] = f"{old.meaning}: old {old.value:.4g}, new {change}, tolerance {old.tolerance:.2g} ({path})"
    return lines


def complaint(lines: dict[str, str]) -> str:
    """Format the differences as a message, with what to do about them."""
    listed = "\n".join(f"  {line}" for line in lines.values())
    return (
        f"{len(lines)} number(s) of data/{DATASET} are not those stored:\n{listed}\n"
        f"if that is meant, store them: {COMMAND}"
    )


def read_stored(name: str = DATASET) -> Stored:
    """Return the stored numbers of a run: `synthetic`, as it is, or `small`."""
    return msgspec.convert(read_json(FOLDER / f"{name}.json"), Stored)


def summarise(runs: Sequence[dict[str, float | None]], reason: str, before: Stored | None) -> Stored:
    """Return the numbers of runs with several seeds, the default one first.  InputError if a number is missing."""
    values = {path: [run.get(path) for run in runs] for path in runs[0]}
    if missing := [path for path, samples in values.items() if None in samples]:
        raise InputError(
            "there is no such number",
            file=Path("metrics.json"),
            key=missing[0],
            cure="correct NUMBERS in studies/measured/reference.py",
        )
    numbers = {path: _number(path, samples) for path, samples in values.items()}
    old = before.numbers if before else {}
    changed = {p: (old[p].value, n.value) for p, n in numbers.items() if p in old and old[p].value != n.value}
    refreshes = [Refresh(reason, changed), *(before.refreshes if before else [])]
    return Stored(DATASET, len(runs), DOUBT, numbers, refreshes)


def _number(path: str, values: list[float]) -> Number:
    allowed = max(tolerance(values), ROUNDING * abs(values[0]))
    meaning = NUMBERS.get(path, f"{path}, root mean square")
    return Number(meaning, values[0], min(values), max(values), float(np.std(values, ddof=1)), allowed)


def rows() -> Tables:
    """Return the stored numbers, which `make test` holds the pipeline to."""
    table = read_stored()
    lines = [[n.meaning, *(f"{v:.4g}" for v in (n.value, n.low, n.high))] for n in table.numbers.values()]
    return {
        f"Default seed of the solve, and {table.seeds} seeds": [["number", "default seed", "least", "largest"], *lines]
    }


def main(reason: str) -> None:
    """Run all seeds, the default one last, so that build/ has it afterwards; write, and print what changed."""
    if not reason:
        raise InputError("no reason is given", key="reason", cure=COMMAND)
    with tempfile.TemporaryDirectory() as folder:
        small = [run_small(Path(folder), seed) for seed in range(SEEDS)]
    seeds = reversed(range(SEEDS))
    whole = [metric_numbers(evaluate_dataset(DATASET, SET=f"solve.seed={seed}")) for seed in seeds][::-1]
    for name, runs in (("small", small), (DATASET, whole)):
        write_json(FOLDER / f"{name}.json", new := summarise(runs, reason, _before(name)))
        changed = [f"{new.numbers[p].meaning}: {a:.4g} -> {b:.4g}" for p, (a, b) in new.refreshes[0].changed.items()]
        print("\n".join([f"{name}:", *changed]) if changed else f"{name}: nothing changed")


def _before(name: str) -> Stored | None:
    return read_stored(name) if (FOLDER / f"{name}.json").exists() else None


if __name__ == "__main__":
    try:
        main(" ".join(sys.argv[1:]).strip())
    except InputError as error:
        sys.exit(f"error: {error}")
