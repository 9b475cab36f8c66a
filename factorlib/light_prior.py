"""python -m factorlib.light_prior FOLDER…: the prior on natural light, fitted to the lat-long maps (.hdr, .exr) in some folders.

Prints the table, and how well such a prior foresees a map that it was not fitted to, beside two nulls.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
from jaxtyping import Float
from rich.progress import Progress

from factorlib.errors import InputError
from factorlib.geometry.sphere import fibonacci_sphere
from factorlib.images.light_map import maps_in, read_light_map
from factorlib.jsonfile import json_text, write_json
from factorlib.light.prior import LightPrior, Source
from factorlib.light.prior_fit import cell_means, fitted, leave_one_out, log_cells, rounded
from factorlib.reading import read_bytes

CELLS = 400  # of equal area, some 10° apart


def means_of(path: Path, cells: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """`cell_means` of a map in a file; InputError where it is too coarse."""
    try:
        return cell_means(read_light_map(path), cells)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(str(error), file=path, cure="a map of 64 rows or more will do") from None


def prior_of(
    paths: Sequence[Path], count: int | None = None, bar: Progress | None = None, scored: bool = True
) -> LightPrior:
    """The prior of the maps in some files; with two or more, where `scored`, also its leave-one-out scores, which take most of the time."""
    cells, bar = fibonacci_sphere(count or CELLS), bar or Progress(disable=True)
    means = np.stack([means_of(path, cells) for path in bar.track(paths, description="reading")])
    logs, task = log_cells(means), bar.add_task("leaving one out", total=len(paths))
    scores = None
    if scored and len(paths) > 1:
        scores = leave_one_out(logs, cells, lambda done, total: bar.update(task, completed=done))
    sources = tuple(Source(path.name, hashlib.sha256(read_bytes(path, "a light map")).hexdigest()) for path in paths)
    return rounded(msgspec.structs.replace(fitted(logs, cells), made_from=sources, leave_one_out=scores))


def summary(prior: LightPrior) -> str:
    """The scores in words."""
    scores = prior.leave_one_out
    if scores is None:
        return "one map: its prior cannot be checked on another"
    return (
        f"log likelihood of a map that was left out, mean over {len(prior.made_from)} (nats, {round(129600 / np.pi / prior.cell_deg**2)} cells):\n"
        f"  this prior {scores.prior:.1f}\n  white noise of the same variance {scores.white_noise:.1f}\n  without the profile {scores.no_profile:.1f}"
    )


def main(
    folders: Annotated[
        list[Path],
        typer.Argument(help="Folders of lat-long maps; folders within them count by themselves.", metavar="FOLDER…"),
    ],
    out: Annotated[
        Path | None, typer.Option(help="File to write the table to; without it the table is printed.")
    ] = None,
) -> None:
    """Fit the prior on natural light to the lat-long maps (.hdr, .exr) in some folders."""
    try:
        with Progress() as bar:
            prior = prior_of(maps_in(folders), bar=bar)
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from None
    if out is None:
        typer.echo(json_text(prior))
    else:
        write_json(out, prior)
    typer.echo(summary(prior))


if __name__ == "__main__":
    typer.run(main)
