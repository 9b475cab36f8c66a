"""Share of results within one standard error of the truth.

`python -m studies.measured.standard_errors build/eames [build/…] [--other FOLDER]` prints a table in seconds.

For each folder of results, which `make evaluate` made of a data set with a truth: the share of k_d, k_s, roughnesses
and of the light maps' log radiances, in `CELLS` cells and after the factor per channel that is free, that lie within
one standard error of the truth. Of a normal distribution it is 68 %.  With `--other FOLDER`, the results of another run
of the same data set, such as one with another `solve.seed`, stand in for the truth: both runs see the same photographs,
so that less than one standard error should lie between them.
"""

from argparse import ArgumentParser
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float

from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images.exr import read_rgb_exr
from factorlib.results.materials import read_materials, select_materials
from factorlib.results.metrics import read_metrics
from studies.measured.light_prior import cell_means
from studies.measured.tools import markdown_table

CELLS = 500  # of equal area, 9° apart
PARTS = ("diffuse", "specular", "roughness")


def material_deviations(build: Path, other: Path | None = None) -> dict[str, Float[np.ndarray, " n"]]:
    """Return |estimate − truth| over the standard error by part, of all materials, after the free factor per channel.

    other: results that stand in for the truth, of a data set of one connected component.  InputError if there is no
           truth
    """
    solved = read_materials(build / "export/materials.json").materials
    if other:
        path = other / "export/materials.json"
        true = dict(zip(solved, select_materials(read_materials(path), list(solved), path), strict=True))
        sums = (np.sum([[m.diffuse, m.specular] for m in table.values()], axis=(0, 1)) for table in (true, solved))
        factors = dict.fromkeys(true, np.divide(*sums))
    else:
        file = build / "evaluate/metrics.json"
        if (compared := read_metrics(file).materials) is None:
            raise InputError("its data set has no truth", file=file, cure="name another run by --other")
        true = {name: errors.truth for name, errors in compared.materials.items()}
        factors = {n: np.array(compared.factor[str(errors.component)]) for n, errors in compared.materials.items()}
    deviations: dict[str, list] = {part: [] for part in PARTS}
    for name, part in product(true, PARTS):
        materials = (solved[name], true[name], solved[name].stderr)
        value, expected, stderr = (np.atleast_1d(np.array(getattr(m, part), float)) for m in materials)
        factor = 1.0 if part == "roughness" else factors[name]
        deviations[part].append(np.abs(factor * value - expected) / np.maximum(factor * stderr, 1e-12))
    return {part: np.concatenate(values) for part, values in deviations.items()}


def light_deviations(build: Path, other: Path | None = None) -> Float[np.ndarray, " n"]:
    """Return |Δ log radiance| over its standard error, of all lights, cells and channels, less channels' medians."""
    truth = (other / "export/illumination") if other else (build / "evaluate/illumination")
    folders = (build / "export/illumination", truth, build / "export/coverage")
    cells = fibonacci_sphere(CELLS)
    deviations = []
    for path in sorted(truth.glob("*.exr")):
        light, true, stderr = (cell_means(read_rgb_exr(folder / path.name), cells) for folder in folders)
        difference = np.log(light / np.maximum(true, 1e-6 * true.mean()))
        stderr = stderr * light.mean(0) / light  # coverage is relative to the light's mean radiance
        deviations.append((np.abs(difference - np.median(difference, axis=0)) / stderr).reshape(-1))
    return np.concatenate(deviations)


def main(builds: Sequence[Path], other: Path | None = None) -> None:
    """Print the shares within one standard error, and the median deviation in standard errors."""
    rows = []
    for build in builds:
        try:
            deviations = [*material_deviations(build, other).values(), light_deviations(build, other)]
        except InputError as error:
            raise SystemExit(f"{error}\nrun `make evaluate` first, and name folders of one data set") from None
        rows.append([str(build), *(f"{100 * np.mean(d < 1):.0f} % ({np.median(d):.2f})" for d in deviations)])
    print(markdown_table(["within one standard error (median deviation)", "k_d", "k_s", "roughness", "light"], rows))


if __name__ == "__main__":
    parser = ArgumentParser(description=main.__doc__)
    parser.add_argument("builds", type=Path, nargs="+", help="folders of results, such as build/eames")
    parser.add_argument("--other", type=Path, help="another run of the same data set, instead of the truth")
    main(**vars(parser.parse_args()))
