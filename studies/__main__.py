"""Command line of the studies: `python -m studies [study …] [--quick]`; all studies without a name.

Make passes STUDY, QUICK and FORCE on.
With --docs the tables of docs/studies.md are written anew afterwards.
"""

import os
import sys
from typing import Annotated

import typer

from factorlib.__main__ import raise_on_signals, switched_on
from factorlib.errors import InputError, did_you_mean
from factorlib.wholefile import disk_error
from studies.catalogue import STUDIES
from studies.run import make, studies
from studies.study import FULL, QUICK


def study_command(
    names: Annotated[list[str] | None, typer.Argument(help="studies; all without it; else STUDY")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="one seed, smallest sets; as QUICK=1")] = False,
    one: Annotated[bool, typer.Option("--one", help="a study must be named")] = False,
    docs: Annotated[
        bool, typer.Option("--docs", help="also write the tables of docs/studies.md anew, of full studies")
    ] = False,
) -> None:
    """Run the steps of studies that are not current, or all with FORCE=1; SET="executor=tcp://…" names the executor."""
    named = names or (os.environ.get("STUDY", "").split() if one else [])
    if one and not named:
        raise InputError("no study is named", key="STUDY", cure="add STUDY=<name>; " + did_you_mean("", STUDIES))
    scale = QUICK if switched_on("QUICK", quick) else FULL
    for name in named:
        studies(scale).dataset_folder(name)
    code = make(scale, named or list(STUDIES), switched_on("FORCE", False), [os.environ.get("SET", "")])
    if docs and code == 0 and not scale.quick:
        from studies.run.tables import refresh_docs

        refresh_docs(named or list(STUDIES))
    raise typer.Exit(code)


if __name__ == "__main__":
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(study_command)
    try:
        with raise_on_signals():
            app(prog_name="python -m studies")
    except InputError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        if (known := disk_error(error, studies().build)) is None:
            raise
        sys.exit(f"error: {known}")
