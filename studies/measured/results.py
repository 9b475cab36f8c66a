"""Measured tables of docs/results.md: `make results`, or `make results ONLY="operator align"` for some sections.

A section is the function `rows()` of one module of `studies.measured`, which gives its tables.  On top of it stand the
version, the commit, the date and the kind of machine that it was measured on.  A section that needs what is not here
(LIGHTS, REAL: see its module) is left as it was, and named at the end.  All of it takes many hours.  It also makes
docs/gallery.md and the outputs of docs/result.ipynb.
"""

import os
import sys
import time
from importlib import import_module

import torch

from factorlib.errors import InputError, did_you_mean
from studies.measured.tools import ROOT, Tables, machine, markdown_table, replace_sections

PAGE = ROOT / "docs" / "results.md"
SECTIONS = {  # module -> title
    "reference": "data/synthetic",
    "eames_like": "data/eames, and sets made alike",
    "speed": "Speed against error",
    "painted": "Painted sets",
    "operator": "Reflection operators",
    "align": "Poses",
    "real_poses": "Poses of real photographs",
    "real_sets": "Re-synthesis of real photographs",
}
PAGES = ("gallery", "notebook")  # modules whose `write()` makes a page of its own


def section(name: str, tables: Tables, measured: str) -> str:
    """Return the Markdown of a section."""
    parts = [f"**{title}**\n\n{markdown_table(rows[0], rows[1:])}" for title, rows in tables.items()]
    return "\n\n".join([f"## {SECTIONS[name]}", f"*{measured}; `make results ONLY={name}`*", *parts])


def main() -> int:
    """Measure the sections that ONLY names, or all, and write each as soon as it is measured.

    Returns 1 if a section could not be measured and is unchanged.
    """
    known = [*PAGES, *SECTIONS]
    names = os.environ.get("ONLY", "").split() or known
    for name in names:
        if name not in known:
            raise InputError(f"there is no section '{name}'", key="ONLY", cure=did_you_mean(name, known))
    torch.set_num_threads(1)
    failed = {}
    for name in names:
        start = time.perf_counter()
        module = import_module(f"studies.measured.{name}")
        try:
            if name in PAGES:
                print(module.write(), flush=True)
                continue
            tables = module.rows()
        except (InputError, SystemExit) as error:
            failed[name] = error
            continue
        replace_sections(PAGE, {name: section(name, tables, f"{machine()}, {time.perf_counter() - start:.0f} s")})
        print(f"{PAGE}: {SECTIONS[name]}", flush=True)
    for name, error in failed.items():
        print(f"'{SECTIONS.get(name, name)}' is left as it was: {error}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"error: {error}")
