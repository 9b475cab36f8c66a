"""What each part of the model is worth on a data set: `make bench-parts DATASETS="eames ../photos/mine"`.

Needs the data set's `urm` and `train` (`make urm train DATASET=…`), takes what `solve` would take, and measures on mirror cells
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
from benchmarks.solve.workers import threaded
from factorlib.dataset.read import read_dataset
from factorlib.errors import InputError
from factorlib.jsonfile import json_text
from factorlib.reflection import reflection_operator
from factorlib.solve.bundle import Joint, candidates, solve
from factorlib.solve.descent import Descent, Solution, descend
from factorlib.solve.held_out import held_out_loss
from factorlib.solve.insertion import blurred, pruned
from factorlib.solve.normal_equations import Loss, predicted_radiance
from factorlib.solve.options import Bundle
from factorlib.solve.problem import Block, Noise, blocks_of_observations, mirror_cells, of_rows, usable
from factorlib.solve.rounds import Start, from_nothing, with_new_lobes
from factorlib.solve.start import starting_light
from factorlib.solve.unknowns import Light, Materials
from factorlib.solve.warm import with_exposures
from factorlib.stage import serial_map
from factorlib.urm.merge import merge
from factorlib.urm.observations import concatenate, read_observations

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs" / "solve.md"
CELL, SHARE, MERGE_DEGREES = 0.1, 0.15, 2.0
DEFAULT = Bundle(tolerance=1e-3)
VARIANTS: dict[str, dict] = {
    "as it is": {},
    "no tone curves": {"tone": "off"},
    "no self-shadowing": {"self_shadowing": "off"},
    "every material specular": {"specular": "on"},
    "no material specular": {"matte": True},
    "no tint prior": {"loss": Loss(prior=0.0)},
    "tint prior .1, the paper's": {"loss": Loss(prior=0.1)},
}


class Split(msgspec.Struct, frozen=True):
    """A light's observations that a solve may see, and those that it is asked for."""

    seen: Block
    asked: Block


def splits_of(dataset: str) -> tuple[list[str], list[Split]]:
    """Names of the materials, and every light's observations."""
    folder = ROOT / "data" / dataset if "/" not in dataset else Path(dataset)
    spec, built = read_dataset(folder).spec, ROOT / "build" / folder.resolve().name
    rotations = {p.name: np.array(p.world_from_camera) for p in spec.photos if p.world_from_camera is not None}
    if not (files := sorted((built / "urm").glob("*.parquet"))):
        raise InputError("there are no observations yet", file=built / "urm", cure=f"run: make urm train DATASET={dataset}")
    parts = [merge(usable(read_observations(path)), MERGE_DEGREES) for path in files]
    blocks = blocks_of_observations(concatenate(parts), Noise(), world_from_camera=rotations)
    return list(spec.materials), [_split(block) for block in blocks]


def _split(block: Block) -> Split:
    names, cell = np.unique(mirror_cells(block.normal, block.view, CELL), return_inverse=True)
    asked = (np.random.default_rng(17).random(len(names)) < SHARE)[cell.reshape(-1)]
    asked &= np.isin(block.material, block.material[~asked])
    return Split(of_rows(block, ~asked), of_rows(block, asked))


def solved(blocks: Sequence[Block], materials: int, operator, how: dict) -> Joint:
    how = dict(how)
    all_matte = np.full(materials, how.pop("matte", False))
    start = Start(from_nothing(materials).point, all_matte, all_matte)
    return solve(blocks, materials, operator, msgspec.structs.replace(DEFAULT, **how), threaded, lambda event: None, start=start)


def shown(joint: Joint, block: Block) -> Block:
    """With what the solve took of visibility."""
    return candidates([block], "on" if joint.self_shadowing else "off").popitem()[1][0]


def decibels(of: Block, radiance: np.ndarray, whole: Block) -> float:
    """PSNR of observations that are not clipped."""
    error = np.where(of.clipped, 0.0, radiance - of.radiance)
    return -10 * float(np.log10(max(np.mean(error**2), 1e-12) / np.quantile(whole.radiance, 0.999) ** 2))


def unseen(splits: Sequence[Split], joint: Joint, operator) -> list[float]:
    found = zip(splits, joint.solution.lights, strict=True)
    return [decibels(s.asked, predicted_radiance(shown(joint, s.asked), li, joint.solution.materials, operator), s.seen) for s, li in found]


def flat(split: Split) -> float:
    """Of each material's mean colour in each photo."""
    guess = np.zeros_like(split.asked.radiance)
    for m, f in {*zip(split.asked.material.tolist(), split.asked.photo.tolist(), strict=True)}:
        of, like = ((b.material == m) & (b.photo == f) for b in (split.asked, split.seen))
        guess[of] = split.seen.radiance[like if like.any() else split.seen.material == m].mean(0)
    return decibels(split.asked, guess, split.seen)


def light_of(block: Block, materials: Materials, operator) -> Light:
    """The light of one block, its materials held: rounds of insertion and descent while held-out observations gain."""
    bundle, light, best, least = DEFAULT, starting_light(block, materials), None, np.inf
    every = np.ones(7 * len(materials), bool)
    for number in range(bundle.rounds):
        at = with_new_lobes([block], Solution(materials, [light], []), operator, bundle.loss, bundle, number, serial_map)
        at = descend([block], at, operator, bundle.loss, Descent(bundle.iterations, bundle.tolerance), serial_map, held=every)
        light = blurred(pruned(at.lights[0]), materials.sharpest)
        held_out = held_out_loss([block], materials, [light], operator, bundle.loss)
        if held_out > (1 - bundle.least_gain) * least:
            break
        best, least = light, held_out
    return best or light


def left_out(splits: Sequence[Split], whole: Joint, materials: int, operator, report: Callable[[], None]) -> dict[str, dict[str, float]]:
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
        for name, joint in sources.items():
            of, asked = shown(whole, split.seen), shown(whole, split.asked)
            light = light_of(of, joint.solution.materials, operator)
            row[name] = decibels(asked, predicted_radiance(asked, light, joint.solution.materials, operator), split.seen)
        found[split.seen.name] = row | {"flat": flat(split)}
    return found


def _photos_left_out(splits: Sequence[Split], k: int, whole: Joint, materials: int, operator, report: Callable[[], None]) -> dict:
    """Of photos that share a light: all of each, in the light and of the materials that the others tell."""
    found = {}
    for f, photo in enumerate(splits[k].seen.photos):
        of = [s.seen if i != k else of_rows(s.seen, s.seen.photo != f) for i, s in enumerate(splits)]
        joint = solved(of, materials, operator, {})
        report()
        row = {}
        for name, answer in (("others", joint), ("all", whole)):
            exposure = np.where(np.arange(len(splits[k].seen.photos)) == f, np.nan, answer.solution.lights[k].log_exposure)
            known = msgspec.structs.replace(answer.solution.lights[k], log_exposure=exposure)
            light = with_exposures(known, shown(answer, splits[k].seen), answer.solution.materials, operator)
            asked = of_rows(splits[k].asked, splits[k].asked.photo == f)
            row[name] = decibels(asked, predicted_radiance(shown(answer, asked), light, answer.solution.materials, operator), splits[k].seen)
        own = Split(of_rows(splits[k].seen, splits[k].seen.photo == f), asked)
        found[photo] = row | {"flat": flat(own)}
    return found


def measured(dataset: str, photos: bool) -> dict:
    names, splits = splits_of(dataset)
    operator = reflection_operator("network")
    seen, count = [split.seen for split in splits], len(names)
    leaving = sum(1 if len(b.photos) == 1 else len(b.photos) for b in seen) if photos else 0
    result: dict = {"parts": {"flat": _summary([flat(split) for split in splits])}}
    with tqdm(total=len(VARIANTS) + leaving, desc=dataset) as bar:
        for name, how in VARIANTS.items():
            joint = whole if how and not _differs(how, whole) else solved(seen, count, operator, how)
            lobes = [len(light) for light in joint.solution.lights]
            result["parts"][name] = _summary(unseen(splits, joint, operator)) | {"lobes": [min(lobes), max(lobes)]}
            if not how:
                whole, found = joint, joint.solution.materials
                result["materials"] = {
                    n: {
                        "diffuse": found.diffuse[m].round(3).tolist(),
                        "specular": found.specular[m].round(3).tolist(),
                        "roughness": round(float(found.roughness[m]), 3),
                    }
                    for m, n in enumerate(names)
                }
                result["tone"] = {b.name: np.exp(light.log_tone).round(3).tolist() for b, light in zip(seen, joint.solution.lights, strict=True)}
                result["self_shadowing"] = joint.self_shadowing
            bar.update()
        result["left_out"] = left_out(splits, whole, count, operator, bar.update) if photos else {}
    return result


def _differs(how: dict, whole: Joint) -> bool:
    """Whether the solve as it is has what a variant goes without."""
    has = {"tone": any(told.kept for told in whole.tone), "self_shadowing": whole.self_shadowing, "specular": whole.matte.any()}
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
