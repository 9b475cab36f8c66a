"""Whether standard errors say how wrong results are: `python -m benchmarks.standard_errors build/eames [build/…]`.

For each folder of results, which `make evaluate` made of a data set with a truth: the share of k_d, k_s, roughnesses and of the light
maps' log radiances, in `CELLS` cells and after the factor per channel that is free, that lie within one standard error of the truth.
Of a normal distribution it is 68 %.  With `--other FOLDER`, the results of another run of the same data set, such as one with another
`solve.seed`, stand in for the truth: both runs see the same photographs, so that less than one standard error should lie between them.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images.exr import read_rgb_exr
from factorlib.light.prior_fit import cell_means
from factorlib.results.materials import Reflectance, Solved, in_order, read_materials
from factorlib.results.metrics import read_metrics

CELLS = 500  # of equal area, 9° apart
PARTS = ("diffuse", "specular", "roughness")
Deviations = dict[str, Float[np.ndarray, " n"]]


def material_deviations(build: Path, other: Path | None) -> Deviations:
    """|estimate − truth| over the standard error, of all materials, after the factor per channel that is free."""
    table = read_materials(build / "export/materials.json").materials
    if other:
        path = other / "export/materials.json"
        true = dict(zip(table, in_order(read_materials(path), list(table), path), strict=True))
        factor = sums_of(true.values()) / sums_of([table[n] for n in true])  # of data sets of one connected component
        factors = dict.fromkeys(true, factor)
    else:
        compared = read_metrics(build / "evaluate/metrics.json").materials
        if compared is None:
            raise SystemExit(f"{build}: its data set has no truth; name another run by --other")
        true = {n: one.truth for n, one in compared.materials.items()}
        factors = {n: np.array(compared.factor[str(one.component)]) for n, one in compared.materials.items()}
    return {part: np.concatenate([_off(table[n], true[n], part, factors[n]) for n in true]) for part in PARTS}


def sums_of(materials: Iterable[Reflectance]) -> Float[np.ndarray, "3"]:
    """Of k_d + k_s, by channel."""
    return np.sum([[one.diffuse, one.specular] for one in materials], axis=(0, 1))


def _off(found: Solved, true: Reflectance, part: str, factor: Float[np.ndarray, "3"]) -> Float[np.ndarray, " n"]:
    value, expected, error = (np.atleast_1d(np.array(getattr(one, part), float)) for one in (found, true, found.stderr))
    by = 1.0 if part == "roughness" else factor
    return np.abs(by * value - expected) / np.maximum(by * error, 1e-12)


def light_deviations(build: Path, other: Path | None) -> Float[np.ndarray, " n"]:
    """|Δ log radiance| over its standard error, of all lights, cells and channels, each channel's median taken out."""
    against, off = (other / "export/illumination") if other else (build / "evaluate/illumination"), []
    folders, cells = (build / "export/illumination", against, build / "export/coverage"), fibonacci_sphere(CELLS)
    for path in sorted(against.glob("*.exr")):
        found, true, error = (cell_means(read_rgb_exr(folder / path.name), cells) for folder in folders)
        deviation = error * found.mean(0) / found  # coverage is relative to the light's mean radiance
        difference = np.log(found / np.maximum(true, 1e-6 * true.mean()))
        off.append((np.abs(difference - np.median(difference, axis=0)) / deviation).reshape(-1))
    return np.concatenate(off)


def main(
    builds: Annotated[list[Path], typer.Argument(help="folders of results, such as build/eames")],
    other: Annotated[
        Path | None, typer.Option(help="folder of another run of the same data set, instead of the truth")
    ] = None,
) -> None:
    """Print the shares within one standard error, and the median deviation in standard errors."""
    print(
        f"{'within one standard error (median deviation)':46} {'k_d':>12} {'k_s':>12} {'roughness':>12} {'light':>12}"
    )
    for build in builds:
        try:
            deviations = [*material_deviations(build, other).values(), light_deviations(build, other)]
        except InputError as error:
            raise SystemExit(f"{error}\nrun `make evaluate` first, and name folders of one data set") from None
        print(
            f"{build!s:46} "
            + " ".join(f"{100 * np.mean(d < 1):5.0f} % ({np.median(d):.2f})".rjust(12) for d in deviations)
        )


if __name__ == "__main__":
    typer.run(main)
