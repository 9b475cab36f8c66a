"""What each part of the model, with lights of few lobes, is worth on a data set: `make bench-parts DATASETS="eames ../photos/mine"`.

Needs the data set's `urm` and `train` (`make urm train DATASET=…`), takes what `solve` with few lobes would take, and measures on mirror cells
(a tenth of the sphere's width) that no solve has seen, about 15 % of the observations:

unseen     PSNR of them, 10 log₁₀(peak² / mean squared error), peak the 99.9th percentile of the light's radiances; mean and worst light
left out   the same where a light's materials come from the other lights alone, and only the light itself is fitted; beside materials
           from all photos, from this light alone, and a flat colour for each material and photo.  Photos that share one
           light are left out one by one, and only their exposure is fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import torch
import typer
from tqdm import tqdm

from benchmarks.markdown import refresh, table
from benchmarks.splits import DEFAULT, Split, decibels, flat, predicted, shown, solved, splits_of, unseen
from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.observed import Rotations, usable
from factorlib.model.point import Point
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.reflection.operator import Operator
from factorlib.solve.few_lobes.descent import Descent, descend
from factorlib.solve.few_lobes.rounds import with_new_lobes
from factorlib.solve.few_lobes.unknowns import blurred, pruned, starting_light
from factorlib.solve.history import Solution
from factorlib.urm.observations import Observations, read_observations

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs" / "solve.md"
VARIANTS: dict[str, dict] = {
    "as it is": {},
    "no self-shadowing": {"shadows": False},
    "every material specular": {"specular": "on"},
    "no material specular": {"specular": "off"},
    "no tint prior": {"prior": 0.0},
    "tint prior .1, the paper's": {"prior": 0.1},
    "no interreflection": {"bounces": False},
    "normals all as sure": {"seen": "sure"},
    "squares, not pseudo-Huber": {"robust_scale": 1e6},
    "clipped values as they are": {"seen": "unclipped"},
    "no clipped values": {"seen": "dropped"},
}


def observations_of(dataset: str) -> tuple[list[str], list[Observations], Rotations]:
    """Names of the materials, what each photo shows, and how cameras stand where lights are fixed to the world."""
    folder = ROOT / "data" / dataset if "/" not in dataset else Path(dataset)
    spec, built = read_dataset(folder).spec, ROOT / "build" / folder.resolve().name
    rotations = {p.name: np.array(p.world_from_camera) for p in spec.photos if p.world_from_camera is not None}
    if not (files := sorted((built / "urm").glob("*.parquet"))):
        raise InputError(
            "there are no observations yet", file=built / "urm", cure=f"run: make urm train DATASET={dataset}"
        )
    return list(spec.materials), [usable(read_observations(path)) for path in files], rotations


def light_of(block: Block, materials: Materials, operator: Operator) -> Light:
    """The light of one block, its materials fixed: rounds of insertion and descent while held-out observations gain."""
    problem = JointProblem([block], operator)
    options, light, best, least = DEFAULT, starting_light(block, materials), None, np.inf
    every = np.ones(7 * len(materials), bool)
    for number in range(options.rounds):
        at = with_new_lobes(problem, Point(materials, [light]), options, number)
        at = descend(problem, at, Descent(options.iterations, options.tolerance), fixed=every)
        light = blurred(pruned(at.point.lights[0]), materials.sharpest)
        held_out = problem.held_out_loss(Point(materials, [light]))
        if held_out > (1 - options.least_gain) * least:
            break
        best, least = light, held_out
    return best or light


def left_out(
    splits: Sequence[Split], whole: Solution, materials: int, operator: Operator, report: Callable[[], None]
) -> dict[str, dict[str, float]]:
    """Decibels of each light or photo on the observations it is asked for, by where its materials come from."""
    found = {}
    for k, split in enumerate(splits):
        if len(split.seen.photos) > 1:
            found |= _photos_left_out(splits, k, whole, materials, operator, report)
            continue
        others = [s.seen for i, s in enumerate(splits) if i != k]
        if not others or not np.isin(split.seen.material, np.concatenate([b.material for b in others])).all():
            continue
        sources = {
            "others": solved(others, materials, operator, {}),
            "all": whole,
            "itself": solved([split.seen], materials, operator, {}),
        }
        report()
        row = {}
        for name, source in sources.items():
            of, asked = shown(whole, split.seen, operator), shown(whole, split.asked, operator)
            materials_ = source.point.materials
            light = light_of(of, materials_, operator)
            row[name] = decibels(asked, Illumination(asked, light, materials_, operator).radiance(), split.seen)
        found[split.seen.name] = row | {"flat": flat(split)}
    return found


def _photos_left_out(
    splits: Sequence[Split], k: int, whole: Solution, materials: int, operator: Operator, report: Callable[[], None]
) -> dict:
    """Of photos that share a light: all of each, in the light and of the materials that the others tell."""
    found = {}
    for f, photo in enumerate(splits[k].seen.photos):
        of = [s.seen if i != k else s.seen.take(s.seen.photo != f) for i, s in enumerate(splits)]
        others = solved(of, materials, operator, {})
        report()
        row = {}
        for name, answer in (("others", others), ("all", whole)):
            exposure = np.where(np.arange(len(splits[k].seen.photos)) == f, np.nan, answer.point.lights[k].log_exposure)
            known = msgspec.structs.replace(answer.point.lights[k], log_exposure=exposure)
            own = Illumination(shown(answer, splits[k].seen, operator), known, answer.point.materials, operator)
            light = with_exposures(own)
            asked = splits[k].asked.take(splits[k].asked.photo == f)
            row[name] = decibels(asked, predicted(answer, asked, light, operator), splits[k].seen)
        own = Split(splits[k].seen.take(splits[k].seen.photo == f), asked)
        found[photo] = row | {"flat": flat(own)}
    return found


def with_exposures(illumination: Illumination) -> Light:
    """Its light with the exposures that were not known (NaN), and the first photo's moved into the weights."""
    light, block = illumination.light, illumination.block
    guess = msgspec.structs.replace(light, log_exposure=np.where(np.isnan(light.log_exposure), 0.0, light.log_exposure))
    for k in np.flatnonzero(np.isnan(light.log_exposure)):
        of_photo = msgspec.structs.replace(illumination, block=block.take(block.photo == k), light=guess)
        shown, expected = (np.median(radiance, axis=0) for radiance in (of_photo.block.radiance, of_photo.radiance()))
        guess.log_exposure[k] = np.log(np.maximum(shown, 1e-6) / np.maximum(expected, 1e-6)).mean()
    first = guess.log_exposure[0]
    return msgspec.structs.replace(light, weight=light.weight * np.exp(first), log_exposure=guess.log_exposure - first)


def measured(dataset: str, photos: bool) -> dict:
    names, seen_by_photos, rotations = observations_of(dataset)
    splits = splits_of(seen_by_photos, rotations)
    operator = reflection_operator("network")
    seen, count = [split.seen for split in splits], len(names)

    def of(how: dict) -> list[Block]:
        """What a variant may see."""
        return [split.seen for split in splits_of(seen_by_photos, rotations, how["seen"])] if "seen" in how else seen

    leaving = sum(1 if len(b.photos) == 1 else len(b.photos) for b in seen) if photos else 0
    result: dict = {"parts": {"flat": _summary([flat(split) for split in splits])}}
    with tqdm(total=len(VARIANTS) + leaving, desc=dataset) as bar:
        whole = None
        for name, how in VARIANTS.items():
            solution = (
                whole
                if whole is not None and how and not _differs(how, whole)
                else solved(of(how), count, operator, how)
            )
            lobes = [len(light) for light in solution.point.lights]
            result["parts"][name] = _summary(unseen(splits, solution, operator)) | {"lobes": [min(lobes), max(lobes)]}
            if not how:
                whole, found = solution, solution.point.materials
                result["materials"] = {
                    n: {
                        "diffuse": found.diffuse[m].round(3).tolist(),
                        "specular": found.specular[m].round(3).tolist(),
                        "roughness": round(float(found.roughness[m]), 3),
                    }
                    for m, n in enumerate(names)
                }
                result["self_shadowing"] = solution.shadows.kept
            bar.update()
        result["left_out"] = left_out(splits, whole, count, operator, bar.update) if photos else {}
    return result


def _differs(how: dict, whole: Solution) -> bool:
    """Whether the solve as it is has what a variant goes without."""
    has = {"specular": whole.lambertian.any(), "shadows": whole.shadows.kept, "bounces": whole.interreflection.kept}
    return all(has.get(part, True) for part in how)


def _summary(decibels_: Sequence[float]) -> dict:
    return {"mean": round(float(np.mean(decibels_)), 2), "worst": round(float(np.min(decibels_)), 2)}


def as_tables(results: dict[str, dict]) -> dict[str, str]:
    sets = list(results)
    parts = [[name, *[_cell(results[s]["parts"][name]) for s in sets]] for name in ("flat", *VARIANTS)]
    rows = [
        [f"{s}: {light}", *(f"{row[name]:.1f}" if name in row else "" for name in ("others", "all", "itself", "flat"))]
        for s in sets
        for light, row in results[s]["left_out"].items()
    ]
    return {
        "parts": table(["model", *sets], parts),
        "left out": table(["left out", "materials of the others", "of all", "of itself", "flat colours"], rows),
    }


def _cell(found: dict) -> str:
    lobes = f", {found['lobes'][0]}–{found['lobes'][1]}" if "lobes" in found else ""
    return f"{found['mean']:.1f} / {found['worst']:.1f}{lobes}"


def main(
    datasets: Annotated[list[str], typer.Argument(help="names in data/, or paths to folders", envvar="DATASETS")],
    photos: Annotated[bool, typer.Option(help="also leave out one photo after the other")] = True,
    docs: Annotated[bool, typer.Option(help="also refresh the tables in docs/solve.md")] = False,
) -> None:
    torch.set_num_threads(1)
    out = ROOT / "build" / "bench" / "parts"
    out.mkdir(parents=True, exist_ok=True)
    for dataset in datasets:
        (out / f"{Path(dataset).name}.json").write_text(json_text(measured(dataset, photos)))
    results = {path.stem: msgspec.json.decode(path.read_bytes()) for path in sorted(out.glob("*.json"))}
    tables = as_tables(results)
    print("\n\n".join(tables.values()))
    if docs:
        refresh(DOCS, tables)


if __name__ == "__main__":
    typer.run(main)
