"""Numbers, tables, marked parts of pages, times and processes, shared by measurements and studies."""

import os
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from factorlib.errors import InputError
from factorlib.results.metrics import read_metrics
from factorlib.wholefile import write_text

ROOT = Path(__file__).resolve().parents[2]
Tables = dict[str, list[list[str]]]  # title -> rows of cells, the head first


def exact(value: float, digits: int = 2) -> str:
    """Format the value with that many significant digits, and a power of ten where it is tiny or huge.

    >>> exact(0.00123), exact(0.000012), exact(0.0), exact(12.3), exact(48000.0)
    ('0.0012', '1.2·10⁻⁵', '0', '12', '4.8·10⁴')
    """
    if value == 0:
        return "0"
    value = float(f"{value:.{digits}g}")
    if 1e-3 <= abs(value) < 1e4:
        return f"{value:.10f}".rstrip("0").rstrip(".")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"


def exacts(values: Iterable[float]) -> str:
    """Format several numbers for one cell of a table."""
    return ", ".join(exact(float(value)) for value in values)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table in Markdown, its first column to the left.

    >>> print(table(["case", "error"], [["all", "1 %"]]))
    | case | error |
    |---|---:|
    | all | 1 % |
    """
    lines = ["| " + " | ".join(cells) + " |" for cells in (head, *rows)]
    return "\n".join([lines[0], "|---|" + "---:|" * (len(head) - 1), *lines[1:]])


def value_at(metrics: Any, path: str) -> float | None:
    """Return the number at a dotted path into metrics.json; None where there is nothing.

    >>> value_at({"a": {"b": [1.5]}}, "a.b.0"), value_at({"a": None}, "a.b")
    (1.5, None)
    """
    for key in path.split("."):
        try:
            metrics = metrics[int(key)] if isinstance(metrics, list) else metrics[key]
        except (LookupError, TypeError, ValueError):
            return None
    return metrics


def refresh(path: Path, parts: dict[str, str]) -> None:
    """Write each part into the file, between `<!-- begin name -->` and `<!-- end name -->`.

    Raises InputError where these marks are missing.
    """
    text = path.read_text(encoding="utf-8")
    for name, inner in parts.items():
        begin = f"<!-- begin {name} -->\n"
        end = f"<!-- end {name} -->"
        if begin not in text or end not in text:
            raise InputError(f"no place for the table '{name}'", file=path, cure=f"add {begin.strip()} and {end}")
        text = text.partition(begin)[0] + begin + inner + "\n" + end + text.partition(end)[2]
    write_text(path, text)


def needed(name: str, what: str) -> list[str]:
    """Return the words of the environment variable of that name; what: they stand for.

    Raises InputError where there are none.
    """
    if not (words := os.environ.get(name, "").split()):
        raise InputError(f"no {what} are named", key=name, cure=f'add {name}="… …"')
    return words


def evaluated(dataset: Path | str, root: Path = ROOT, **variables: str) -> dict[str, Any]:
    """Return a data set's metrics, as `make evaluate` of the project below `root` makes them.

    variables: handed to make (SET, …)
    """
    environment = {name: value for name, value in os.environ.items() if name not in ("SET", "FORCE", "STAGE")}
    environment |= {"DATASET": str(dataset), "PYTHONPATH": str(root), **variables}
    command = [sys.executable, "-m", "factorlib", "evaluate"]
    if subprocess.run(command, cwd=root, env=environment, check=False).returncode:
        raise SystemExit(1)  # it has said why
    return msgspec.to_builtins(read_metrics(root / "build" / Path(dataset).name / "evaluate/metrics.json"))


class Taken(NamedTuple):
    """Seconds since the start: of the wall clock, and of the processor for all threads of the process."""

    wall: float
    processor: float


class Clock:
    """Clock that runs from its making.

    Other work on the machine lengthens the wall time, and hardly the processor time.
    """

    def __init__(self):
        self._wall = time.perf_counter()
        self._processor = time.process_time()

    def taken(self) -> Taken:
        """Return the time until now."""
        return Taken(round(time.perf_counter() - self._wall, 3), round(time.process_time() - self._processor, 3))
