"""Command line of the studies: `python -m studies [study …] [--quick]`; all studies without a name.

Make passes STUDY, QUICK and FORCE on.
With --docs the tables of docs/studies.md are written anew afterwards.
"""

import os
import sys
from argparse import ArgumentParser
from collections.abc import Sequence

from factorlib.__main__ import raise_on_signals, switched_on
from factorlib.errors import InputError, did_you_mean
from factorlib.wholefile import disk_error
from studies.catalogue import STUDIES
from studies.run import make, studies
from studies.study import FULL, QUICK


def main(names: Sequence[str], quick: bool, one: bool, docs: bool) -> int:
    """Run the steps of studies that are not current, or all with FORCE=1; SET="executor=tcp://…" names the executor."""
    named = list(names) or (os.environ.get("STUDY", "").split() if one else [])
    if one and not named:
        raise InputError("no study is named", key="STUDY", cure="add STUDY=<name>; " + did_you_mean("", STUDIES))
    scale = QUICK if switched_on("QUICK", quick) else FULL
    for name in named:
        studies(scale).dataset_folder(name)
    code = make(scale, named or list(STUDIES), switched_on("FORCE", False), [os.environ.get("SET", "")])
    if docs and code == 0 and not scale.quick:
        from studies.run.tables import refresh_docs

        refresh_docs(named or list(STUDIES))
    return code


if __name__ == "__main__":
    parser = ArgumentParser("python -m studies", description=main.__doc__)
    parser.add_argument("names", nargs="*", help="studies; all without it; else STUDY")
    parser.add_argument("--quick", action="store_true", help="one seed, smallest sets; as QUICK=1")
    parser.add_argument("--one", action="store_true", help="a study must be named")
    parser.add_argument("--docs", action="store_true", help="also write the tables of docs/studies.md, of full studies")
    try:
        with raise_on_signals():
            sys.exit(main(**vars(parser.parse_args())))
    except InputError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        if (known := disk_error(error, studies().build)) is None:
            raise
        sys.exit(f"error: {known}")
