"""Tables for documentation, and how they get there: between `<!-- begin name -->` and `<!-- end name -->`."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from factorlib.errors import InputError
from factorlib.runner.closure import Sources
from factorlib.runner.filehash import FileHashes

ROOT = Path(__file__).resolve().parents[1]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, its first column to the left.

    >>> print(table(["case", "error"], [["all", "1 %"]]))
    | case | error |
    |---|---:|
    | all | 1 % |
    """
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(
        "|" + "|".join(cells) + "|" if k == 1 else "| " + " | ".join(cells) + " |" for k, cells in enumerate(lines)
    )


def replaced(text: str, name: str, inner: str, file: Path | None = None) -> str:
    """`text` with `inner` between the marks of `name`."""
    pattern = re.compile(rf"(<!-- begin {re.escape(name)} -->\n).*?(<!-- end {re.escape(name)} -->)", re.DOTALL)
    if not pattern.search(text):
        raise InputError(
            f"no place for the table '{name}'", file=file, cure=f"add <!-- begin {name} --> and <!-- end {name} -->"
        )
    return pattern.sub(lambda found: f"{found[1]}{inner}\n{found[2]}", text)


def refresh(path: Path, parts: dict[str, str]) -> None:
    """Write each part between its marks in the file."""
    text = path.read_text(encoding="utf-8")
    for name, inner in parts.items():
        text = replaced(text, name, inner, path)
    path.write_text(text, encoding="utf-8")


def sources_hash(*commands: str, root: Path = ROOT) -> str:
    """Eight digits of a hash of all modules of the project, and their data, that `python -m command` imports, of all commands.

    Comments and docstrings do not count, as for the keys of steps.  Raises InputError where there is no such module.
    """
    sources, found = Sources([root], FileHashes(None)), {}
    for command in commands:
        file = sources.find(command)
        module = f"{command}.__main__" if file is not None and file.name == "__init__.py" else command
        package, _, name = module.rpartition(".")
        closure = sources.closure(package, name, root / "pipeline.yaml")
        found |= closure.modules | closure.data
    return hashlib.sha256(repr(sorted(found.items())).encode()).hexdigest()[:8]
