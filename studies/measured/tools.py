"""Numbers, tables, marked sections of pages and runs of the pipeline, shared by measurements and studies."""

import os
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import msgspec

from factorlib.__main__ import project
from factorlib.errors import InputError
from factorlib.results.metrics import read_metrics
from factorlib.runner.dataset_state import Request, read_state
from factorlib.wholefile import write_text

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("factorlib", "stages", "studies", "data", "pipeline.yaml")  # what numbers depend on
Tables = dict[str, list[list[str]]]  # title -> rows of cells, the head first


def machine() -> str:
    """Return the version, commit, date and kind of machine of this run."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    commit, changed = (
        subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout.strip()
        for words in (["rev-parse", "--short=8", "HEAD"], ["status", "--porcelain", *SOURCES])
    )
    commit = (commit or "unknown") + (" with changes" if changed else "")
    facts = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    model = next((line.partition(":")[2].strip() for line in facts.splitlines() if line.startswith("model name")), "?")
    return f"Version {version}, commit {commit}, {date.today()}, {os.cpu_count()} × {model}"


def format_number(value: float, digits: int = 2) -> str:
    """Format a value with `digits` significant digits, and a power of ten if it is tiny or huge.

    >>> format_number(0.00123), format_number(0.000012), format_number(0.0), format_number(12.3), format_number(48000.0)
    ('0.0012', '1.2·10⁻⁵', '0', '12', '4.8·10⁴')
    """
    if value == 0:
        return "0"
    value = float(f"{value:.{digits}g}")
    if 1e-3 <= abs(value) < 1e4:
        return f"{value:.10f}".rstrip("0").rstrip(".")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"


def format_numbers(values: Iterable[float]) -> str:
    """Format several numbers for one cell of a table."""
    return ", ".join(format_number(float(value)) for value in values)


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table in Markdown, its first column to the left.

    >>> print(markdown_table(["case", "error"], [["all", "1 %"]]))
    | case | error |
    |---|---:|
    | all | 1 % |
    """
    lines = ["| " + " | ".join(cells) + " |" for cells in (head, *rows)]
    return "\n".join([lines[0], "|---|" + "---:|" * (len(head) - 1), *lines[1:]])


def value_at(metrics: Any, path: str) -> float | None:
    """Return the number at a dotted path into metrics.json; None if there is none.

    >>> value_at({"a": {"b": [1.5]}}, "a.b.0"), value_at({"a": None}, "a.b")
    (1.5, None)
    """
    for key in path.split("."):
        try:
            metrics = metrics[int(key)] if isinstance(metrics, list) else metrics[key]
        except (LookupError, TypeError, ValueError):
            return None
    return metrics


def replace_sections(path: Path, parts: dict[str, str]) -> None:
    """Write each part into the file, between `<!-- begin name -->` and `<!-- end name -->`.

    Raises InputError if these marks are missing.
    """
    text = path.read_text(encoding="utf-8")
    for name, inner in parts.items():
        begin = f"<!-- begin {name} -->\n"
        end = f"<!-- end {name} -->"
        if begin not in text or end not in text:
            raise InputError(f"no place for the table '{name}'", file=path, cure=f"add {begin.strip()} and {end}")
        text = text.partition(begin)[0] + begin + inner + "\n" + end + text.partition(end)[2]
    write_text(path, text)


def environment_words(name: str, meaning: str) -> list[str]:
    """Return the words in an environment variable; `meaning` says what they name, in the plural, for the error.

    Raises InputError if there are none.
    """
    if not (words := os.environ.get(name, "").split()):
        raise InputError(f"no {meaning} are named", key=name, cure=f'add {name}="… …"')
    return words


def run_verb(verb: str, dataset: Path | str, root: Path = ROOT, **variables: str) -> None:
    """Run a verb of the project below `root`, as make does; variables: handed to make (SET, …)."""
    environment = {name: value for name, value in os.environ.items() if name not in ("SET", "FORCE", "STAGE")}
    environment |= {"DATASET": str(dataset), "PYTHONPATH": str(root), **variables}
    command = [sys.executable, "-m", "factorlib", verb]
    if subprocess.run(command, cwd=root, env=environment, check=False).returncode:
        raise SystemExit(1)  # its own message is on the screen


def evaluate_dataset(dataset: Path | str, root: Path = ROOT, **variables: str) -> dict[str, Any]:
    """Return a data set's metrics, as `make evaluate` of the project below `root` makes them."""
    run_verb("evaluate", dataset, root, **variables)
    return msgspec.to_builtins(read_metrics(root / "build" / Path(dataset).name / "evaluate/metrics.json"))


def processor_seconds(
    dataset: Path | str, settings: Sequence[str] = (), held_out: Sequence[str] = ()
) -> dict[str, float]:
    """Return the processor seconds of each stage that `evaluate_dataset` needs, as its stored results took."""
    state = read_state(project(), Request(str(dataset), ["evaluate"], settings, held_out=held_out), look=True)
    seconds: dict[str, float] = {}
    for planned in state.plan():
        cost = state.store.entry(planned.key).cost
        seconds[planned.step.stage] = seconds.get(planned.step.stage, 0.0) + cost["cpu_seconds"]
    return seconds
