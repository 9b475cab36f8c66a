"""Errors of lights and materials on data/eames, and on sets made alike.

Measured by `make results ONLY=eames_like LIGHTS="FOLDER …"`:

data/eames  the set that settings were chosen on
made        `python -m factorlib.generate eames --seed N`: other materials, views and lights; no setting was chosen on
            them
captured    with LIGHTS, folders of captured lat-long maps: the same of the next seeds, each lit by six of these maps,
            chosen by its seed.  The prior on lights of such a set is fitted to the other maps alone,
            in a copy of the project

Each set runs through the pipeline once with the default seed of the solve (some minutes; the rendering of a set takes
three); what is current is not run again.  Sets lie in build/bench/eames-like, results in build/ (of captured ones in
the copies).
"""

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images.exr import read_rgb_exr
from factorlib.images.light_map import maps_in
from factorlib.jsonfile import write_json
from studies.measured.light_prior import cell_means, prior_of
from studies.measured.standard_errors import CELLS, light_deviations, material_deviations
from studies.measured.tools import ROOT, Tables, evaluate_dataset, value_at

PLACE = ROOT / "build/bench/eames-like"
SEEDS = (171, 172, 173, 174, 175)
CAPTURED_SEEDS = (176, 177, 178, 179, 180)
MAPS = 6  # of a set: one for each photo
PRIOR = Path("factorlib/light/prior.json")
COPIED = ("factorlib", "stages", "recipes", "pipeline.yaml")
DEVIATIONS = ("k_d", "k_s", "roughness", "log radiance of lights")
FIFTHS = ("darkest", "second", "third", "fourth", "brightest")  # of directions, by true radiance
LIGHT = "light.mean.channel_per_photo"
BALLS = "relighting.mean.channel_per_photo"
PSNR = "psnr_tonemapped_db"


class Quantity(NamedTuple):
    """Row of the table.

    path, null: dotted, in metrics.json;  digits: behind the point;  unit, scale: as it is printed
    """

    meaning: str
    path: str
    null: str | None
    digits: int
    unit: str = ""
    scale: float = 1.0

    def text(self, value: float) -> str:
        """Return the value with its unit.

        >>> Quantity("k_d", "", None, 0, " %", 100).text(0.163), Quantity("roughness", "", None, 3).text(0.0412)
        ('16 %', '0.041')
        """
        return f"{self.scale * value:.{self.digits}f}{self.unit}"


def _light(meaning: str, view: str, measure: str = "rmse", digits: int = 3, unit: str = "") -> Quantity:
    return Quantity(meaning, f"{LIGHT}.{view}.estimate.{measure}", f"{LIGHT}.{view}.null.{measure}", digits, unit)


def _material(meaning: str, part: str, *form: Any) -> Quantity:
    return Quantity(meaning, f"materials.mean_{part}", f"materials.null_mean_{part}", *form)


QUANTITIES = (
    _light("glossy sphere", "glossy"),
    _light("mirror sphere", "mirror"),
    _light("Lambertian sphere", "lambertian"),
    _light("angle of the map's RGB", "map_all", "rgb_angle_deg", 1, "°"),
    Quantity("balls in the recovered light, dB", f"{BALLS}.in_estimated_light.{PSNR}", f"{BALLS}.null_grey.{PSNR}", 1),
    Quantity("balls in the true light, dB", f"{BALLS}.in_true_light.{PSNR}", None, 1),
    _material("k_d", "diffuse", 0, " %", 100),
    _material("k_s", "specular", 0, " %", 100),
    _material("roughness", "roughness", 3),
    Quantity("relit set score, mean, dB", "relit_set.mean_psnr_db", "relit_set.null_mean_psnr_db", 1),
    Quantity("relit set score, worst pair, dB", "relit_set.worst_psnr_db", None, 1),
)


class SetResult(NamedTuple):
    """Result of a set: its name, its metrics.json, and its folder, build/<name>."""

    name: str
    metrics: dict
    build: Path

    def value(self, path: str) -> float:
        """Return a number of the metrics.  InputError if it is missing."""
        if (value := value_at(self.metrics, path)) is None:
            cure = "correct QUANTITIES in studies/measured/eames_like.py"
            raise InputError("there is no such number", file=self.build / "evaluate/metrics.json", key=path, cure=cure)
        return value

    def deviations(self) -> list[np.ndarray]:
        """Return |estimate − truth| over the standard error, in the order of `DEVIATIONS`."""
        return [*material_deviations(self.build).values(), light_deviations(self.build)]

    def lights(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield each light and the true one, in `CELLS` cells, in the gauge of the relit set score."""
        cells, factor = fibonacci_sphere(CELLS), np.array(self.metrics["relit_set"]["factor"])
        for path in sorted((self.build / "evaluate/illumination").glob("*.exr")):
            true = cell_means(read_rgb_exr(path), cells)
            yield cell_means(read_rgb_exr(self.build / "export/illumination" / path.name), cells) / factor, true

    def fifths(self) -> np.ndarray:
        """Return estimated over true radiance of the `FIFTHS`, over all lights, each relative to its true mean.

        Directions are sorted by the truth: sorted by the estimate, one whose light shrinks toward its mean would look
        better for that.
        """
        sums = np.zeros((2, len(FIFTHS)))
        for light, true in self.lights():
            parts = np.array_split(true.sum(1).argsort(), len(FIFTHS))
            sums += [[radiance[part].sum() / true.mean() for part in parts] for radiance in (light, true)]
        return sums[0] / sums[1]

    def chroma(self) -> tuple[float, float]:
        """Return the RMS error of the logarithm of lights' chroma, and that of the true light's mean chroma."""
        errors, nulls = [], []
        for light, true in self.lights():
            tints = [np.log(np.maximum(each, 1e-6 * true.mean())) @ (np.eye(3) - 1 / 3) for each in (light, true)]
            errors.append(tints[0] - tints[1])
            nulls.append(tints[1] - tints[1].mean(0))
        return float(np.sqrt(np.square(errors).mean())), float(np.sqrt(np.square(nulls).mean()))


def generate_set(seed: int, lights: Path | None = None, kind: str = "eames", painted: bool = False) -> Path:
    """Return the folder of the set of a seed; generate it if it is missing or if factorlib/generate has changed."""
    sources = sorted(path for path in (ROOT / "factorlib/generate").iterdir() if path.is_file())
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:8]
    name = f"{kind}-like-{seed}" + ("-painted" if painted else "")
    folder = PLACE / digest / ("captured" if lights else "made") / name
    if not (folder / "dataset.yaml").exists():
        options = ["--seed", str(seed), "--out", str(folder), *(["--lights", str(lights)] if lights else [])]
        options += ["--painted"] if painted else []
        subprocess.run([sys.executable, "-m", "factorlib.generate", kind, *options], cwd=ROOT, check=True)
    return folder


def split_maps(maps: Sequence[Path], seed: int) -> tuple[list[Path], list[Path]]:
    """Return the maps that light the set of a seed, and the remaining maps, for the prior.

    Raises InputError if no two are left for a prior.
    """
    if len(maps) < MAPS + 2:
        cure = f"{MAPS} light a set and the prior needs two more: name folders with {MAPS + 2}"
        raise InputError(f"only {len(maps)} maps are named", key="LIGHTS", cure=cure)
    held_out = set(np.random.default_rng(seed).permutation(len(maps))[:MAPS].tolist())
    return [m for k, m in enumerate(maps) if k in held_out], [m for k, m in enumerate(maps) if k not in held_out]


def link_maps(maps: Sequence[Path], folder: Path) -> Path:
    """Return a folder with links to these maps alone; they keep their order."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for number, path in enumerate(maps):
        (folder / f"{number}_{path.name}").symlink_to(path.resolve())
    return folder


def project_with_prior(maps: Sequence[Path], folder: Path) -> Path:
    """Copy the project, with the prior on lights fitted to these maps.

    Its results and its store, in build/, stay from run to run.
    """
    for name in COPIED:
        source = ROOT / name
        copy = folder / name
        if source.is_dir():
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(source, copy, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, copy)
    write_json(folder / PRIOR, prior_of(maps, scored=False))
    return folder


def run_pipeline(name: str, dataset: Path, root: Path = ROOT) -> SetResult:
    """Run the pipeline below `root` on a data set; name: of the set in the table."""
    (store := ROOT / "build/store").mkdir(parents=True, exist_ok=True)
    return SetResult(name, evaluate_dataset(dataset, root, FACTORLIB_STORE=str(store)), root / "build" / dataset.name)


def run_captured(seed: int, folders: Sequence[Path], painted: bool = False) -> SetResult:
    """Return the set of a seed in captured lights, solved under a prior that was fitted to other maps."""
    folder = PLACE / f"captured-{seed}"
    maps, others = split_maps(maps_in(folders), seed)
    print(f"set {seed} is lit by {', '.join(m.name for m in maps)}", flush=True)
    dataset = generate_set(seed, link_maps(maps, folder / "maps"), painted=painted)
    return run_pipeline(f"{seed}, captured", dataset, project_with_prior(others, folder / "project"))


def rows() -> Tables:
    """Generate the sets, run the pipeline on each, and compare with the truth."""
    folders = [Path(word) for word in os.environ.get("LIGHTS", "").split()]
    eames = run_pipeline("data/eames", ROOT / "data/eames")
    others = [run_pipeline(str(seed), generate_set(seed)) for seed in SEEDS]
    others += [run_captured(seed, folders) for seed in CAPTURED_SEEDS] if folders else []
    return {"Sets": rows_of([eames, *others])}


def rows_of(results: Sequence[SetResult]) -> list[list[str]]:
    """Return a column for each set, and mean and deviation over all but the first, on which settings were chosen.

    Brackets hold the null's score.
    """
    table = [["", *(result.name for result in results), "mean ± spread of those that no setting was chosen on"]]
    for quantity in QUANTITIES:
        values = [result.value(quantity.path) for result in results]
        nulls = [result.value(quantity.null) for result in results] if quantity.null else []
        cells = [quantity.text(value) for value in [*values, np.mean(values[1:])]]
        cells[-1] += f" ± {quantity.text(np.std(values[1:], ddof=1))}"
        if nulls:
            brackets = [quantity.text(null) for null in [*nulls, np.mean(nulls[1:])]]
            cells = [f"{cell} ({null})" for cell, null in zip(cells, brackets, strict=True)]
        table.append([quantity.meaning, *cells])
    for name, *ratios in zip(FIFTHS, *(result.fifths() for result in results), strict=True):
        cells = [f"{ratio:.2f}" for ratio in [*ratios, np.mean(ratios[1:])]]
        table.append([f"{name} fifth of directions by true radiance, estimated over true", *cells])
    pairs = [result.chroma() for result in results]
    pairs.append(tuple(np.mean(pairs[1:], axis=0)))
    table.append(["chroma of lights, log", *(f"{error:.3f} ({null:.3f})" for error, null in pairs)])
    for name, *columns in zip(DEVIATIONS, *(result.deviations() for result in results), strict=True):
        shares = [f"{100 * np.mean(column < 1):.0f} %" for column in [*columns, np.concatenate(columns[1:])]]
        table.append([f"{name} within one standard error", *shares])
    return table
