"""Numbers set by hand in a package, with what each is: `python -m studies.constants [factorlib/inference]`.

A number is a literal other than those of arithmetic (`ARITHMETIC`): one of a constant of a module counts under its
name with the comment above or beside it; one inside a function or a class counts by its line.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

from studies.measured.tools import ROOT, markdown_table

ARITHMETIC = (-1, 0, 1, 2, 3, 4, 0.5, 0.25)  # indices, powers, halves and channels


def numbers_of(node: ast.AST) -> list[float]:
    """Return the literals of a syntax tree that are not arithmetic."""
    literals = (each.value for each in ast.walk(node) if isinstance(each, ast.Constant))
    return [v for v in literals if isinstance(v, int | float) and not isinstance(v, bool) and v not in ARITHMETIC]


def comment_of(lines: list[str], node: ast.stmt) -> str:
    """Return the comment on a statement's last line, or that above it."""
    beside = lines[(node.end_lineno or node.lineno) - 1].partition("  # ")[2]
    above: list[str] = []
    for line in reversed(lines[: node.lineno - 1]):
        if not line.startswith("#"):
            break
        above.insert(0, line.removeprefix("#").strip())
    return beside or " ".join(above)


def rows_of(path: Path) -> Iterator[list[str]]:
    """Yield place, count and meaning of a module's numbers, by statement."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    for node in ast.parse(text).body:
        named = isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
        statements = [node] if named else [each for each in ast.walk(node) if isinstance(each, ast.stmt)]
        for statement in statements:
            inner = (each for each in ast.iter_child_nodes(statement) if not isinstance(each, ast.stmt))
            parts = [statement] if named else inner
            numbers = [number for part in parts for number in numbers_of(part)]
            if numbers:
                source = lines[statement.lineno - 1].strip()
                meaning = comment_of(lines, statement) if named else source
                name = source.split(" ")[0] if named else ""
                yield [f"{path.stem}:{statement.lineno}", name, ", ".join(f"{n:g}" for n in numbers), meaning]


def main() -> None:
    """Print the table of a package, and the number of its numbers."""
    package = ROOT / (sys.argv[1] if len(sys.argv) > 1 else "factorlib/inference")
    rows = [row for path in sorted(package.rglob("*.py")) for row in rows_of(path)]
    print(markdown_table(["place", "name", "numbers", "what it is"], rows))
    print(f"{sum(len(row[2].split(', ')) for row in rows)} numbers, {sum(bool(row[1]) for row in rows)} with a name")


if __name__ == "__main__":
    main()
