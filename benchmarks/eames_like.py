"""How right lights and materials are on data/eames, and on sets made alike: `python -m benchmarks.eames_like [--lights FOLDER] [--docs]`.

data/eames  the set that settings were chosen on
made        `python -m factorlib.generate eames --seed N`: other materials, views and lights; no setting was chosen on them
captured    with `--lights`: the same of the next seeds, each lit by six maps that are drawn from the folders' by its seed.  The prior on
            lights of such a set is fitted to the other maps alone, in a copy of the project

Each set runs through the pipeline once with the default seed of the solve; what is current is not run again.  Sets lie in
build/bench/eames-like, results in build/ (of captured ones in the copies).  `--docs` writes the table of docs/light-prior.md and the
paragraph of README.md.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer

from benchmarks.markdown import ROOT, refresh, sources_hash, table
from benchmarks.rounded import exact
from benchmarks.standard_errors import light_deviations, material_deviations
from factorlib.errors import InputError
from factorlib.evaluate.table import value_at
from factorlib.jsonfile import write_json
from factorlib.light_prior import maps_in, prior_of
from factorlib.results.metrics import read_metrics

PLACE = ROOT / "build/bench/eames-like"
SEEDS = (101, 102, 103, 104, 105)
CAPTURED_SEEDS = (106, 107, 108, 109, 110)
MAPS = 6  # of a set: one for each photo
PRIOR = Path("factorlib/light/prior.json")
COPIED = ("factorlib", "stages", "recipes", "pipeline.yaml")


class Quantity(msgspec.Struct, frozen=True):
    """A row of the table.  path, null: dotted, in metrics.json;  scale, unit: as it is shown;  digits: behind the point."""

    meaning: str
    path: str
    null: str | None
    digits: int
    unit: str = ""
    scale: float = 1.0

    def shown(self, value: float) -> str:
        """The value with its unit.

        >>> Quantity("k_d", "", None, 0, " %", 100).shown(0.163), Quantity("roughness", "", None, 3).shown(0.0412)
        ('16 %', '.041')
        """
        text = f"{self.scale * value:.{self.digits}f}"
        return (text[1:] if text.startswith("0.") else text) + self.unit


def _light(meaning: str, view: str, measure: str = "rmse", digits: int = 3, unit: str = "") -> Quantity:
    path = f"light.mean.channel_per_photo.{view}"
    return Quantity(meaning, f"{path}.estimate.{measure}", f"{path}.null.{measure}", digits, unit)


BALLS = "relighting.mean.channel_per_photo"
PSNR = "psnr_tonemapped_db"
QUANTITIES = {
    "glossy": _light("glossy sphere", "glossy"),
    "mirror": _light("mirror sphere", "mirror"),
    "lambertian": _light("Lambertian sphere", "lambertian"),
    "angle": _light("angle of the map's RGB", "map_all", "rgb_angle_deg", 1, "°"),
    "balls": Quantity(
        "balls in the recovered light, dB", f"{BALLS}.in_estimated_light.{PSNR}", f"{BALLS}.null_grey.{PSNR}", 1
    ),
    "true light": Quantity("balls in the true light, dB", f"{BALLS}.in_true_light.{PSNR}", None, 1),
    "diffuse": Quantity("k_d", "materials.mean_diffuse", "materials.null_mean_diffuse", 0, " %", 100),
    "specular": Quantity("k_s", "materials.mean_specular", "materials.null_mean_specular", 0, " %", 100),
    "roughness": Quantity("roughness", "materials.mean_roughness", "materials.null_mean_roughness", 3),
    "relit": Quantity("relit set score, mean, dB", "relit_set.mean_psnr_db", "relit_set.null_mean_psnr_db", 1),
    "relit worst": Quantity("relit set score, worst pair, dB", "relit_set.worst_psnr_db", None, 1),
}


WITHIN = ("k_d", "k_s", "roughness", "log radiance of lights")


class Set(msgspec.Struct, frozen=True):
    """A set and its results.  metrics: those of metrics.json;  results: the folder, build/<name>."""

    name: str
    metrics: dict
    results: Path

    def value(self, quantity: Quantity) -> float:
        """Of the results."""
        return self._at(quantity.path)

    def null(self, quantity: Quantity) -> float | None:
        """What stands in for an answer, where the quantity has such."""
        return None if quantity.null is None else self._at(quantity.null)

    def _at(self, path: str) -> float:
        found = value_at(self.metrics, path)
        if found is None:
            raise InputError(
                "there is no such number",
                file=self.results / "evaluate/metrics.json",
                key=path,
                cure="correct benchmarks/eames_like.py",
            )
        return found


def made(seed: int, lights: Path | None = None) -> Path:
    """The folder of the set of that seed, made where it is missing or of other sources."""
    folder = (
        PLACE / sources_hash("factorlib.generate.eames") / ("captured" if lights else "made") / f"eames-like-{seed}"
    )
    if not (folder / "dataset.yaml").exists():
        captured = ["--lights", str(lights)] if lights else []
        subprocess.run(
            [sys.executable, "-m", "factorlib.generate", "eames", "--seed", str(seed), "--out", str(folder), *captured],
            cwd=ROOT,
            check=True,
        )
    return folder


def drawn(maps: Sequence[Path], seed: int) -> tuple[list[Path], list[Path]]:
    """The maps that light the set of that seed, and all others.  InputError where no two are left for a prior."""
    if len(maps) < MAPS + 2:
        raise InputError(
            f"{len(maps)} maps",
            key="--lights",
            cure=f"{MAPS} light a set and the prior needs two more: name folders with {MAPS + 2}",
        )
    chosen = set(np.random.default_rng(seed).permutation(len(maps))[:MAPS].tolist())
    return [m for k, m in enumerate(maps) if k in chosen], [m for k, m in enumerate(maps) if k not in chosen]


def folder_of(maps: Sequence[Path], folder: Path) -> Path:
    """A folder with links to these maps alone; they keep their order."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for number, path in enumerate(maps):
        (folder / f"{number}_{path.name}").symlink_to(path.resolve())
    return folder


def project_with_prior(maps: Sequence[Path], folder: Path) -> Path:
    """A copy of the project whose prior on lights is fitted to these maps.  Its results and its store, in build/, stay from run to run."""
    for name in COPIED:
        whole, copy = ROOT / name, folder / name
        if whole.is_dir():
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(whole, copy, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(whole, copy)
    write_json(folder / PRIOR, prior_of(maps, scored=False))
    return folder


def evaluated(name: str, dataset: Path, root: Path = ROOT) -> Set:
    """What the pipeline below `root` finds on a data set; name: of the set in the table."""
    settings = {"DATASET": str(dataset), "FACTORLIB_STORE": str(ROOT / "build/store"), "PYTHONPATH": str(root)}
    environment = {name: value for name, value in os.environ.items() if name not in ("SET", "FORCE")} | settings
    (ROOT / "build/store").mkdir(parents=True, exist_ok=True)
    if subprocess.run(
        [sys.executable, "-m", "factorlib", "evaluate"], cwd=root, env=environment, check=False
    ).returncode:
        raise SystemExit(1)  # it has said why
    results = root / "build" / dataset.name
    return Set(name, msgspec.to_builtins(read_metrics(results / "evaluate/metrics.json")), results)


def captured(seed: int, folders: Sequence[Path]) -> Set:
    """The set of that seed in captured lights, solved under a prior that knows none of them."""
    here = PLACE / f"captured-{seed}"
    maps, others = drawn(maps_in(folders), seed)
    print(f"set {seed} is lit by {', '.join(m.name for m in maps)}", flush=True)
    return evaluated(
        f"{seed}, captured", made(seed, folder_of(maps, here / "maps")), project_with_prior(others, here / "project")
    )


def as_table(sets: Sequence[Set], unchosen: Sequence[Set]) -> str:
    """A column for each set, and mean and standard deviation over those that no setting was chosen on; in brackets what the null scores."""
    shares = {one.name: within(one) for one in sets}
    spread = len(unchosen) > 1
    rows = [
        [q.meaning, *(_cell(q, one) for one in sets), *([_mean(q, unchosen)] if spread else [])]
        for q in QUANTITIES.values()
    ]
    for part in WITHIN:
        pooled = [_share(np.concatenate([shares[one.name][part] for one in unchosen]))] if spread else []
        rows.append([f"{part} within one standard error", *(_share(shares[one.name][part]) for one in sets), *pooled])
    return table(
        [
            "",
            *(one.name for one in sets),
            *(["mean ± spread of those that no setting was chosen on"] if spread else []),
        ],
        rows,
    )


def _cell(quantity: Quantity, one: Set) -> str:
    null = one.null(quantity)
    return quantity.shown(one.value(quantity)) + (f" ({quantity.shown(null)})" if null is not None else "")


def _mean(quantity: Quantity, sets: Sequence[Set]) -> str:
    values, nulls = [one.value(quantity) for one in sets], [one.null(quantity) for one in sets]
    null = f" ({quantity.shown(float(np.mean(nulls)))})" if quantity.null else ""
    return f"{quantity.shown(float(np.mean(values)))} ± {quantity.shown(float(np.std(values, ddof=1)))}{null}"


def within(one: Set) -> dict[str, np.ndarray]:
    """|estimate − truth| over the standard error: of materials, by part, and of the lights' log radiances."""
    return dict(
        zip(
            WITHIN, [*material_deviations(one.results, None).values(), light_deviations(one.results, None)], strict=True
        )
    )


def _share(deviations: np.ndarray) -> str:
    return f"{100 * float(np.mean(deviations < 1)):.0f} %"


def paragraph(eames: Set, others: Sequence[Set]) -> str:
    """What README.md says of data/eames, and of the sets that no setting was chosen on."""

    def of(name: str) -> str:
        """Of data/eames."""
        return QUANTITIES[name].shown(eames.value(QUANTITIES[name]))

    def null(name: str) -> str:
        """Of its null."""
        return QUANTITIES[name].shown(eames.null(QUANTITIES[name]))

    def over(name: str) -> str:
        """Mean over the other sets, and their range where there are several."""
        values = [one.value(QUANTITIES[name]) for one in others]
        if len(values) == 1:
            return QUANTITIES[name].shown(values[0])
        mean, low, high = (
            QUANTITIES[name].shown(v).removesuffix(QUANTITIES[name].unit)
            for v in (np.mean(values), min(values), max(values))
        )
        return f"{mean} ({low} to {high}){QUANTITIES[name].unit}"

    grey = exact(float(np.mean([one.null(QUANTITIES["balls"]) for one in others])), 3)
    return (
        "On `data/eames` (`python -m benchmarks.eames_like`, one run), with poses searched, a warped mesh, shadows and interreflections, it is far\n"
        "from that. Surfaces light each other ([docs/light-prior.md](docs/light-prior.md) says how such sets are measured). In parts of the truth's\n"
        f"RMS, a Lambertian sphere in the recovered lights is wrong by {of('lambertian')}, a glossy one by {of('glossy')} and a mirror by {of('mirror')} (a constant light: {null('lambertian')},\n"
        f"{null('glossy')} and {null('mirror')}); balls of the recovered materials in them score {of('balls')} dB tone-mapped (one factor a channel and ball;\n"
        f"the grey ball {null('balls')} dB), in the true light {of('true light')} dB. Roughness is wrong by {of('roughness')} on average (a grey guess:\n"
        f"{null('roughness')}), specular by {of('specular')} ({null('specular')}), diffuse by {of('diffuse')}. Settings were chosen on this set.\n"
        f"On {'a set' if len(others) == 1 else f'{len(others)} sets'} made alike that no setting was chosen on, roughness is wrong by {over('roughness')} on average, specular by {over('specular')},\n"
        f"diffuse by {over('diffuse')}; a glossy sphere in the recovered lights by {over('glossy')}, and balls score {over('balls')} dB (the grey\n"
        f"ball {grey} dB). Every material in every light of a set, as balls, scores {over('relit')} dB."
    )


def main(
    seeds: Annotated[list[int] | None, typer.Option(help="of the made sets; more by --seeds again", min=1)] = None,
    lights: Annotated[
        list[Path] | None, typer.Option(help="folder of captured lat-long maps; more by --lights again")
    ] = None,
    docs: Annotated[bool, typer.Option("--docs", help="write docs/light-prior.md and README.md")] = False,
) -> None:
    """Make the sets, run the pipeline on each, and print the table."""
    numbers = list(dict.fromkeys(seeds or SEEDS))
    eames, others = evaluated("data/eames", ROOT / "data/eames"), [evaluated(str(seed), made(seed)) for seed in numbers]
    lit = [captured(seed, lights) for seed in CAPTURED_SEEDS] if lights else []
    tables = {"sets": as_table([eames, *others, *lit], [*others, *lit])}
    text = paragraph(eames, [*others, *lit])
    print("\n\n".join([*tables.values(), text]))
    if docs:
        refresh(ROOT / "docs/light-prior.md", tables)
        refresh(ROOT / "README.md", {"eames": text})


if __name__ == "__main__":
    try:
        typer.run(main)
    except InputError as error:
        sys.exit(f"error: {error}")
