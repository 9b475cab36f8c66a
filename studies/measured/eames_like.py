"""Errors of lights and materials on data/eames, and on sets made alike.

Measured by `make results ONLY=eames_like [LIGHTS="FOLDER …"]`:

data/eames  the set that settings were chosen on
made        `python -m factorlib.generate eames --seed N`: other materials, views and lights; no setting was chosen on
            them
captured    with LIGHTS, folders of captured lat-long maps: the same of the next seeds, each lit by six maps that are
            drawn from the folders' by its seed.  The prior on lights of such a set is fitted to the other maps alone,
            in a copy of the project

Each set runs through the pipeline once with the default seed of the solve; what is current is not run again.  Sets lie
in build/bench/eames-like, results in build/ (of captured ones in the copies).  `python -m studies.measured.eames_like
[seed …]` prints the table of data/eames and of sets of these seeds, in made light or, with LIGHTS, in captured light.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from factorlib.errors import InputError
from factorlib.images.light_map import maps_in
from factorlib.jsonfile import write_json
from studies.measured.light_prior import prior_of
from studies.measured.standard_errors import light_deviations, material_deviations
from studies.measured.tools import ROOT, Tables, evaluated, table, value_at

PLACE = ROOT / "build/bench/eames-like"
SEEDS = (101, 102, 103, 104, 105)
CAPTURED_SEEDS = (106, 107, 108, 109, 110)
MAPS = 6  # of a set: one for each photo
PRIOR = Path("factorlib/light/prior.json")
COPIED = ("factorlib", "stages", "recipes", "pipeline.yaml")
WITHIN = ("k_d", "k_s", "roughness", "log radiance of lights")
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


def _material(meaning: str, part: str, *how: Any) -> Quantity:
    return Quantity(meaning, f"materials.mean_{part}", f"materials.null_mean_{part}", *how)


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


class Set(NamedTuple):
    """A set and its results.  metrics: those of metrics.json;  results: the folder, build/<name>."""

    name: str
    metrics: dict
    results: Path

    def value(self, path: str) -> float:
        """Return a number of the results.  InputError where it is missing."""
        if (value := value_at(self.metrics, path)) is None:
            file = self.results / "evaluate/metrics.json"
            raise InputError(
                "there is no such number", file=file, key=path, cure="correct studies/measured/eames_like.py"
            )
        return value


def made(seed: int, lights: Path | None = None) -> Path:
    """Return the folder of the set of that seed, made where it is missing or factorlib/generate has changed."""
    sources = sorted(path for path in (ROOT / "factorlib/generate").iterdir() if path.is_file())
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:8]
    folder = PLACE / digest / ("captured" if lights else "made") / f"eames-like-{seed}"
    if not (folder / "dataset.yaml").exists():
        options = ["--seed", str(seed), "--out", str(folder), *(["--lights", str(lights)] if lights else [])]
        subprocess.run([sys.executable, "-m", "factorlib.generate", "eames", *options], cwd=ROOT, check=True)
    return folder


def drawn(maps: Sequence[Path], seed: int) -> tuple[list[Path], list[Path]]:
    """Return the maps that light the set of that seed, and all others.

    Raises InputError where no two are left for a prior.
    """
    if len(maps) < MAPS + 2:
        cure = f"{MAPS} light a set and the prior needs two more: name folders with {MAPS + 2}"
        raise InputError(f"{len(maps)} maps", key="LIGHTS", cure=cure)
    chosen = set(np.random.default_rng(seed).permutation(len(maps))[:MAPS].tolist())
    return [m for k, m in enumerate(maps) if k in chosen], [m for k, m in enumerate(maps) if k not in chosen]


def folder_of(maps: Sequence[Path], folder: Path) -> Path:
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
        whole = ROOT / name
        copy = folder / name
        if whole.is_dir():
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(whole, copy, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(whole, copy)
    write_json(folder / PRIOR, prior_of(maps, scored=False))
    return folder


def solved(name: str, dataset: Path, root: Path = ROOT) -> Set:
    """Return what the pipeline below `root` finds on a data set; name: of the set in the table."""
    (store := ROOT / "build/store").mkdir(parents=True, exist_ok=True)
    return Set(name, evaluated(dataset, root, FACTORLIB_STORE=str(store)), root / "build" / dataset.name)


def captured(seed: int, folders: Sequence[Path]) -> Set:
    """Return the set of that seed in captured lights, solved under a prior that knows none of them."""
    here = PLACE / f"captured-{seed}"
    maps, others = drawn(maps_in(folders), seed)
    print(f"set {seed} is lit by {', '.join(m.name for m in maps)}", flush=True)
    dataset = made(seed, folder_of(maps, here / "maps"))
    return solved(f"{seed}, captured", dataset, project_with_prior(others, here / "project"))


def within(one: Set) -> dict[str, np.ndarray]:
    """Return |estimate − truth| over the standard error: of materials, by part, and of the lights' log radiances."""
    parts = [*material_deviations(one.results, None).values(), light_deviations(one.results, None)]
    return dict(zip(WITHIN, parts, strict=True))


def rows_of(sets: Sequence[Set], unchosen: Sequence[Set]) -> list[list[str]]:
    """Return a column for each set, and mean and standard deviation over those that no setting was chosen on.

    Brackets hold the null's score.
    """
    rows = [["", *(one.name for one in sets), "mean ± spread of those that no setting was chosen on"]]
    for quantity in QUANTITIES:
        nulls = {one.name: one.value(quantity.null) for one in sets} if quantity.null else {}
        values = {one.name: one.value(quantity.path) for one in sets}
        cells = [quantity.text(v) + (f" ({quantity.text(nulls[n])})" if nulls else "") for n, v in values.items()]
        over = [values[one.name] for one in unchosen]
        null = f" ({quantity.text(np.mean([nulls[one.name] for one in unchosen]))})" if nulls else ""
        spread = f" ± {quantity.text(np.std(over, ddof=1))}" if len(over) > 1 else ""
        rows.append([quantity.meaning, *cells, f"{quantity.text(np.mean(over))}{spread}{null}"])
    shares = {one.name: within(one) for one in sets}
    for part in WITHIN:
        pooled = np.concatenate([shares[one.name][part] for one in unchosen])
        cells = [f"{100 * np.mean(d < 1):.0f} %" for d in (*(shares[one.name][part] for one in sets), pooled)]
        rows.append([f"{part} within one standard error", *cells])
    return rows


def rows(made_seeds: Sequence[int] = SEEDS, captured_seeds: Sequence[int] = CAPTURED_SEEDS) -> Tables:
    """Make the sets, run the pipeline on each, and compare with the truth."""
    folders = [Path(word) for word in os.environ.get("LIGHTS", "").split()]
    eames = solved("data/eames", ROOT / "data/eames")
    others = [solved(str(seed), made(seed)) for seed in made_seeds]
    others += [captured(seed, folders) for seed in captured_seeds] if folders else []
    return {"Sets": rows_of([eames, *others], others)}


if __name__ == "__main__":
    try:
        numbers = [int(word) for word in sys.argv[1:]]
        lit = bool(os.environ.get("LIGHTS"))
        found = rows(*([], numbers) if lit else (numbers, [])) if numbers else rows()
        print("\n\n".join(table(lines[0], lines[1:]) for lines in found.values()))
    except InputError as error:
        sys.exit(f"error: {error}")
