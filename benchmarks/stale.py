"""Which tables and numbers of README.md and docs/ were measured on other sources than those that are here.

`python -m benchmarks.stale` (or `make bench-stale`) reads the stamps that `benchmarks.markdown.refresh` leaves, and measures nothing.
A stale table need not be wrong: its sources changed in some way that is no comment, and nobody has measured again.

Numbers that a person typed stand between the same marks, with `<!-- typed from COMMAND -->` in place of a stamp: nothing knows of which
sources they are, and this is said of them every time.  `--unmarked` lists lines with a measured quantity (a number with dB, %, °, s or ×)
that stand between no marks: README.md has none (tested), docs/ has some.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.markdown import ROOT, sources_hash
from factorlib.errors import InputError

TABLE = re.compile(r"<!-- begin (?P<name>.+?) -->\n(?P<inner>.*?)<!-- end (?P=name) -->", re.DOTALL)
TYPED = re.compile(r"<!-- typed from (.+?) -->")
QUANTITY = re.compile(r"(?<![\w.])\.?\d[\d.,]*\s?(?:dB|%|°|s|×(?! ?\d))(?!\w)")
CODE = re.compile(r"^```.*?^```|`[^`\n]+`", re.DOTALL | re.MULTILINE)
OTHERWISE = {"benchmarks.reference": 'make bench-reference REASON="…"'}  # how a table is written whose command has no --docs
STAMP = re.compile(r"<!-- written by (\S+) for sources ([0-9a-f]{8})(?: of (.+?))? -->")


def stale(pages: list[Path], root: Path = ROOT) -> Iterator[str]:
    """A line for each table of the pages that is not of the sources below `root`, or does not say of which it is."""
    hash_of = cache(lambda commands: sources_hash(*commands.split(), root=root))
    for page in pages:
        for found in TABLE.finditer(page.read_text(encoding="utf-8")):
            typed = TYPED.search(found["inner"])
            reason = f"typed by hand from: {typed[1]}; of which sources, nothing says" if typed else _reason(STAMP.search(found["inner"]), hash_of)
            if reason:
                yield f"{shown(page, root)}: {found['name']}: {reason}"


def shown(page: Path, root: Path) -> str:
    """Its path from the root."""
    return page.relative_to(root).as_posix()


def _reason(stamp: re.Match | None, hash_of: cache) -> str | None:
    if stamp is None:
        return "does not say of which sources it is"
    command, then, modules = stamp.groups()
    try:
        now = hash_of(modules or command)
    except InputError as error:
        return f"written by {command}, of which {error.found}"
    return None if now == then else f"of sources {then}, now {now}; written by {OTHERWISE.get(command, f'python -m {command} --docs')}"


def unmarked(page: Path, root: Path = ROOT) -> Iterator[str]:
    """A line for each line of the page with a measured quantity that stands between no marks and in no code."""

    def blank(found: re.Match) -> str:
        """As many lines."""
        return "\n" * found[0].count("\n")

    text = CODE.sub(blank, TABLE.sub(blank, page.read_text(encoding="utf-8")))
    for number, line in enumerate(text.splitlines(), 1):
        if found := QUANTITY.findall(line):
            yield f"{shown(page, root)}:{number}: {', '.join(found)}"


def main(
    unmarked_: Annotated[bool, typer.Option("--unmarked", help="also lines with numbers that name no command")] = False,
) -> None:
    """Print a line for each."""
    pages = [ROOT / "README.md", ROOT / "data" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    print("\n".join(stale(pages)) or "every table is of these sources")
    if unmarked_:
        print("\n".join(line for page in pages for line in unmarked(page)))


if __name__ == "__main__":
    typer.run(main)
