"""Command line of the generator: python -m factorlib.generate synthetic|eames.

It writes the data sets in the repository, or others of the same protocol.
"""

from pathlib import Path
from shutil import rmtree
from types import ModuleType
from typing import Annotated

import msgspec
import typer
from rich.progress import Progress

from factorlib.errors import InputError
from factorlib.images.light_map import maps_in
from factorlib.wholefile import disk_error, sync_tree

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__)
Seed = Annotated[
    int, typer.Option(min=0, help="0 is the set the project carries; others have other materials, views and lights.")
]
EXACT = typer.Option("--exact", help="Give the photographed mesh, its poses and focal lengths.")
PAINTED = typer.Option("--painted", help="Paint wood and two shells: grain, a print, a patina; with true albedo.")
Out = Annotated[Path | None, typer.Option(help="Folder to write; default data/<set>. It is replaced.")]
Lights = Annotated[Path | None, typer.Option(help="Folder of lat-long .hdr or .exr maps to light the set with.")]


@app.command()
def synthetic(seed: Seed = 0, out: Out = None, lights: Lights = None) -> None:
    """Generate three materials in three lights on exact shapes, with direct light only."""
    from factorlib.generate import synthetic as set_

    _write(set_, set_.SyntheticOptions(), out or Path("data/synthetic"), seed, lights)


@app.command()
def eames(
    seed: Seed = 0,
    out: Out = None,
    lights: Lights = None,
    exact: Annotated[bool, EXACT] = False,
    painted: Annotated[bool, PAINTED] = False,
) -> None:
    """Generate six photos of moulded side chairs, path-traced with all bounces, on an approximate mesh."""
    from factorlib.generate import eames as set_

    if (exact or painted) and out is None:
        fault = "data/eames is the set without --exact and --painted: name another folder"
        raise typer.BadParameter(fault, param_hint="--out")
    _write(set_, set_.ChairSetOptions(exact=exact, painted=painted), out or Path("data/eames"), seed, lights)


def _write(set_: ModuleType, parameters: msgspec.Struct, out: Path, seed: int, lights: Path | None) -> None:
    """Generate into a folder beside `out`, then rename it to `out`."""
    fresh = out.with_name(out.name + ".new")
    try:
        maps = maps_in([lights]) if lights else []
        if out.exists() and any(out.iterdir()) and not (out / "dataset.yaml").is_file():
            raise InputError(
                "this folder is neither empty nor a data set",
                file=out,
                cure="name an empty folder, or a data set to replace",
            )
        rmtree(fresh, ignore_errors=True)
        with Progress() as bar:
            task = bar.add_task(f"{out}", total=1)

            def report(done: float, total: float, text: str) -> None:
                """Update the progress bar."""
                bar.update(task, completed=done, total=total, description=text)

            set_.generate(fresh, seed, maps, parameters, report)
        sync_tree(fresh)
    except (InputError, OSError) as error:
        known = error if isinstance(error, InputError) else disk_error(error, fresh)
        if known is None:
            raise
        typer.echo(f"error: {known}", err=True)
        raise typer.Exit(2) from None
    rmtree(out, ignore_errors=True)
    fresh.rename(out)
    typer.echo(f"{out}: {sum(path.stat().st_size for path in out.rglob('*') if path.is_file()) / 1e6:.1f} MB")


if __name__ == "__main__":
    app()
