"""Which tables of docs/ were measured on other sources than those that are here.

`python -m benchmarks.stale` (or `make bench-stale`) reads the stamps that `benchmarks.markdown.refresh` leaves, and measures nothing.
A stale table need not be wrong: its sources changed in some way that is no comment, and nobody has measured again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from benchmarks.markdown import ROOT, sources_hash
from factorlib.errors import InputError

TABLE = re.compile(r"<!-- begin (?P<name>.+?) -->\n(?P<inner>.*?)<!-- end (?P=name) -->", re.DOTALL)
STAMP = re.compile(r"<!-- written by (\S+) for sources ([0-9a-f]{8})(?: of (.+?))? -->")


def stale(pages: list[Path], root: Path = ROOT) -> Iterator[str]:
    """A line for each table of the pages that is not of the sources below `root`, or does not say of which it is."""
    hash_of = cache(lambda commands: sources_hash(*commands.split(), root=root))
    for page in pages:
        for found in TABLE.finditer(page.read_text(encoding="utf-8")):
            if reason := _reason(STAMP.search(found["inner"]), hash_of):
                yield f"{page.name}: {found['name']}: {reason}"


def _reason(stamp: re.Match | None, hash_of: cache) -> str | None:
    if stamp is None:
        return "does not say of which sources it is"
    command, then, modules = stamp.groups()
    try:
        now = hash_of(modules or command)
    except InputError as error:
        return f"written by {command}, of which {error.found}"
    return None if now == then else f"of sources {then}, now {now}; written by python -m {command} --docs"


def main() -> None:
    lines = list(stale(sorted((ROOT / "docs").glob("*.md"))))
    print("\n".join(lines) or "every table is of these sources")


if __name__ == "__main__":
    main()
