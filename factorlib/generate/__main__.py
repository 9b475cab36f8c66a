"""Command line of the generator: python -m factorlib.generate synthetic|eames.

It writes the data sets in the repository, or others of the same protocol.
"""

from collections.abc import Callable
from inspect import Signature, signature
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
DISTANT = typer.Option("--distant", help="Light the chairs by the light's map alone, infinitely far away.")
ROUGH = typer.Option(
    "--rough",
    metavar="TRIANGLES,WARP",
    help="Give a worse mesh: triangles a part, and a bend as a share of its extent.",
)
DIRECT = typer.Option("--direct", help="No bounces: only what shines by itself lights the chairs.")
PAINTED = typer.Option("--painted", help="Paint wood and two shells: grain, a print, a patina; with true albedo.")
Out = Annotated[Path | None, typer.Option(help="Folder to write; default data/<set>. It is replaced.")]
Lights = Annotated[Path | None, typer.Option(help="Folder of lat-long .hdr or .exr maps to light the set with.")]


def writes_set(options: Callable[..., tuple[ModuleType, msgspec.Struct]]) -> Callable[..., None]:
    """Return the command that writes a set, with --seed, --out and --lights beside its own options.

    `options` takes the options of one command and returns the module of its set and the set's options.  The command
    demands --out if one of them is given, because data/<set> has none.
    """

    def command(seed: Seed = 0, out: Out = None, lights: Lights = None, **values: bool | str | None) -> None:
        """Write the set."""
        if any(values.values()) and out is None:
            *most, last = (f"--{name}" for name in values)
            raise typer.BadParameter(
                f"data/{options.__name__} is the set without {', '.join(most)} and {last}: name another folder",
                param_hint="--out",
            )
        _write(*options(**values), out or Path("data", options.__name__), seed, lights)

    shared = [each for each in signature(command).parameters.values() if each.kind is not each.VAR_KEYWORD]
    command.__signature__ = Signature([*shared, *signature(options).parameters.values()])  # type: ignore[attr-defined]
    command.__name__ = options.__name__
    command.__doc__ = options.__doc__
    return command


@app.command()
@writes_set
def synthetic() -> tuple[ModuleType, msgspec.Struct]:
    """Generate three materials in three lights on exact shapes, with direct light only."""
    from factorlib.generate import synthetic as set_

    return set_, set_.SyntheticOptions()


@app.command()
@writes_set
def eames(
    exact: Annotated[bool, EXACT] = False,
    distant: Annotated[bool, DISTANT] = False,
    direct: Annotated[bool, DIRECT] = False,
    rough: Annotated[str | None, ROUGH] = None,
    painted: Annotated[bool, PAINTED] = False,
) -> tuple[ModuleType, msgspec.Struct]:
    """Generate six photos of moulded side chairs, path-traced with all bounces, on an approximate mesh."""
    from factorlib.generate import eames as set_

    return set_, set_.ChairSetOptions(
        exact=exact, distant=distant, direct=direct, rough=_rough(rough, exact), painted=painted
    )


def _rough(words: str | None, exact: bool) -> tuple[int, float] | None:
    """Parse TRIANGLES,WARP."""
    if words is None:
        return None
    try:
        triangles, warp = words.split(",")
        numbers = int(triangles), float(warp)
    except ValueError:
        numbers = 0, 0.0
    if exact or not (numbers[0] >= 20 and 0 <= numbers[1] <= 0.2):
        expected = "without --exact, 20 triangles or more and 0 to .2, as in --rough 500,.02"
        raise typer.BadParameter(expected, param_hint=f"--rough {words}")
    return numbers


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
