"""Errors of an answer on all pixels of a set, whatever they were reduced to for solving.

Re-synthesis  PSNR of each pair, 10 log₁₀(peak² / mean squared error), peak the 99.9th percentile of its picture; nothing
              is scaled.  `corrected` is without the noise that the picture itself is known to have (`Pair.noise_db`),
              which no answer can explain.  The answers of all solvers are rendered by one judge, the operator `network`;
              `own` is by the operator that solved, on every 37th pixel.
Materials     after one factor a channel, `factorlib.evaluate.materials`: relative errors of k_d and k_s, a true albedo
              below .01 counting as .01, and absolute ones of roughness.
Null          a grey material for every material, by the same rules.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from jaxtyping import Float

from benchmarks.solve.sets import SphereSet
from factorlib.evaluate.materials import compare_materials
from factorlib.model.blocks import Block
from factorlib.model.illumination import Illumination
from factorlib.model.lights import Light
from factorlib.model.materials import Materials
from factorlib.model.noise import Noise
from factorlib.model.observed import blocks_of_observations
from factorlib.results.materials import Reflectance

EVERY = 37  # pixels, for operators too slow for all
Pictures = Mapping[tuple[str, str], Float[np.ndarray, "n 3"]]


class Answer(msgspec.Struct, frozen=True):
    """Materials and lights, in units in which the pictures were: what every solver's result is made into."""

    materials: Materials
    lights: dict[str, Light]


def answer_of(blocks: list[Block], materials: Materials, lights: list[Light]) -> Answer:
    """Weights times each block's unit."""
    scaled = {b.name: Light(li.axis, li.log_sharpness, li.weight * b.unit, li.log_exposure) for b, li in zip(blocks, lights, strict=True)}
    return Answer(materials, scaled)


def pictures_of(answer: Answer, spheres: SphereSet, operator, every: int = 1, only: frozenset | None = None) -> Pictures:
    """Radiance at every `every`-th counted pixel of each pair, or of the pairs `only`."""
    names, found = list(spheres.materials), {}
    for block in _all_pixels(spheres):
        for m, name in enumerate(names):
            if only is not None and (name, block.name) not in only:
                continue
            own = block.take(np.flatnonzero(block.material == m)[::every])
            found[name, block.name] = Illumination(own, answer.lights[block.name], answer.materials, operator).radiance()
    return found


def _all_pixels(spheres: SphereSet) -> list[Block]:
    return blocks_of_observations(spheres.observations(), Noise(), held_out=0.0)


def picture_scores(found: Pictures, spheres: SphereSet, every: int = 1) -> dict:
    """{"psnr": {"mean", "worst"}, "corrected": {…}, "pairs": {"material light": dB}}."""
    raw, corrected = {}, {}
    for (m, i), picture in found.items():
        pair = spheres.pairs[m, i]
        error = float(np.mean((picture - pair.counted[::every]) ** 2)) / pair.peak**2
        raw[f"{m} {i}"] = decibels(error)
        corrected[f"{m} {i}"] = decibels(error - 10 ** (-pair.noise_db / 10))
    return {"psnr": _summary(raw), "corrected": _summary(corrected), "pairs": raw}


def decibels(error: float) -> float:
    """PSNR of a mean squared error relative to the peak's square, at most 80 dB."""
    return -10 * float(np.log10(max(error, 1e-8)))


def material_scores(found: Materials, spheres: SphereSet) -> dict:
    """Mean and worst errors, and of each material: k_d and k_s (largest channel, relative) and roughness."""
    names = list(spheres.materials)
    truths = {n: Reflectance(m.diffuse, m.specular, m.roughness) for n, m in spheres.materials.items()}
    estimates = {
        n: Reflectance(tuple(found.diffuse[k].tolist()), tuple(found.specular[k].tolist()), float(found.roughness[k])) for k, n in enumerate(names)
    }
    errors = compare_materials(estimates, truths, dict.fromkeys(names, 0))
    kinds = ("diffuse", "specular", "roughness")
    summary = {kind: {w: getattr(errors, f"{w}_{kind}") for w in ("mean", "worst", "null_mean")} for kind in kinds}
    each = {
        n: {"diffuse": _largest(c.error.diffuse), "specular": _largest(c.error.specular), "roughness": c.error.roughness}
        for n, c in errors.materials.items()
    }
    return summary | {"each": each}


def _largest(errors) -> float:
    """The error of largest magnitude, with its sign."""
    return float(max(errors, key=abs))


def _summary(values: Mapping[str, float]) -> dict[str, float | str]:
    worst = min(values, key=values.get)
    return {"mean": float(np.mean(list(values.values()))), "worst": values[worst], "worst_pair": worst}
