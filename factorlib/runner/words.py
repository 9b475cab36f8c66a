"""A plan in words: what each verb prints of it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING

from msgspec import structs

from factorlib.runner.params import Parameter
from factorlib.runner.pipeline import Pipeline
from factorlib.runner.plan import Planned, Step
from factorlib.runner.survey import Survey

if TYPE_CHECKING:
    from factorlib.runner.gc import Unneeded

SHOWN = 8  # reasons of one step that are written out
NAMED = 20  # steps that have failed


def say(seen: Survey, text: str) -> None:
    """Print a line that begins with the dataset's name."""
    print(f"{seen.data.folder.name}: {text}")


def plan_lines(planned: list[Planned]) -> list[str]:
    """What would run, one line for steps of a stage that share their reasons."""
    lines = []
    for group in _alike([p for p in planned if p.status != "current"]):
        lines.append(
            f"{group[0].step.stage:<10} {group[0].status:<7} {_items(group):<24} {_short(group[0].reasons)}".rstrip()
        )
    current = sum(p.status == "current" for p in planned)
    return lines + [
        f"{current} of {len(planned)} steps are current" if lines else f"all {len(planned)} steps are current"
    ]


def why_lines(planned: list[Planned]) -> list[str]:
    """Every reason of every step that is not current."""
    lines = []
    for group in _alike([p for p in planned if p.status != "current"]):
        lines.append(f"{group[0].step.stage} {_items(group)}".rstrip() + f": {group[0].status}")
        lines += [f"    {reason}" for reason in group[0].reasons]
    return lines or ["everything is current: sources, parameters, files and versions are those of the last results"]


def status_lines(
    planned: list[Planned], running: Callable[[Planned], bool], warnings: Callable[[Planned], list[str]]
) -> list[str]:
    """One line a stage: how many of its steps are current, running, to run, maybe; what the current ones warned of."""
    lines = []
    for stage in dict.fromkeys(p.step.stage for p in planned):
        steps = [p for p in planned if p.step.stage == stage]
        states = ["running" if p.key and p.status != "current" and running(p) else p.status for p in steps]
        counts = ", ".join(f"{states.count(s)} {s}" for s in ("current", "running", "to run", "maybe") if s in states)
        lines.append(f"{stage:<10} {counts}")
    said = dict.fromkeys(f"warning: {p.step}: {text}" for p in planned if p.status == "current" for text in warnings(p))
    return lines + list(said)


def graph_lines(pipeline: Pipeline) -> list[str]:
    """Each stage under what it takes, in the order they run."""
    lines = []
    for name in pipeline.order():
        stage = pipeline.stages[name]
        taken = ", ".join(stage.inputs) or "(parameters only)"
        asked = "   (only when asked for)" if stage.optional else ""
        lines.append(f"{name:<10} {f'per {stage.over}' if stage.over else 'whole set':<10} <- {taken}{asked}")
    return lines


def parameter_lines(stage: str, found: list[Parameter]) -> list[str]:
    """A stage's parameters, each with its default, what it may be and what it means."""
    if not found:
        return [f"{stage} has no parameters"]
    lines = []
    for one in found:
        lines += [
            f"{stage}.{one.name} = {one.default}    ({one.allowed})",
            *textwrap.wrap(one.text, 100, initial_indent="    ", subsequent_indent="    "),
        ]
    return lines


def mermaid_lines(pipeline: Pipeline) -> list[str]:
    """The graph of stages in Mermaid's language; stages over photos or recipes have double frames."""
    edges = [f"  {above} --> {name}" for name in pipeline.order() for above in pipeline.stages[name].upstream]
    nodes = [f"  {name}[[{name}]]" if pipeline.stages[name].over else f"  {name}[{name}]" for name in pipeline.order()]
    return ["graph TD", *nodes, *edges]


def log_lines(logged: list[tuple[Planned, list[dict], str | None]]) -> list[str]:
    """What each step cost, what it was made with where that is not as for the step above, and what it warned of.

    logged: steps with the events of their results' logs, and the file that says by which defect one failed
    """
    lines, last = [], ""
    for planned, events, failed in logged:
        lines.append(f"{planned.step!s:<26} {_cost(planned, events)}".rstrip())
        if planned.status == "current" and (made_with := _made_with(planned.record or {}, events)) != last:
            for part in textwrap.wrap(made_with, 110, initial_indent="    ", subsequent_indent="    "):
                lines.append(part.replace("\N{NO-BREAK SPACE}", " "))
            last = made_with
        lines += [f"    warning: {event['text']}" for event in events if event["event"] == "warning"]
        lines += [f"    it failed by a defect of the program: {failed}"] if failed else []
    return lines


def _cost(planned: Planned, events: list[dict]) -> str:
    done = next((event for event in reversed(events) if event["event"] == "done"), None)
    if planned.status != "current":
        return f"{planned.status}: {_short(planned.reasons)}"
    if done is None:
        return "its log is not there"
    if done.get("shared"):
        return "from the shared store, without its log"
    cores = f"{done['threads']} thread{'s' * (done['threads'] > 1)} on {done['cores']} core{'s' * (done['cores'] > 1)}"
    cost = f"{done['seconds']:8.1f} s {done['cpu_seconds']:8.1f} s processor {done['memory_mb']:7.0f} MB peak"
    return f"{cost}   {cores}   {done['started'][:16].replace('T', ' ')} UTC"


def _made_with(record: dict, events: list[dict]) -> str:
    """Python, the machine's kind and the packages whose versions count; no break between a name and its version."""
    machine = next((event["machine"] for event in reversed(events) if "machine" in event), {})
    packages = [
        f"{name.removeprefix('package:')} {version}"
        for name, version in sorted(record.items())
        if name.startswith("package:")
    ]
    kind = [f"{machine['system']} {machine['processor']}"] if machine else []
    parts = [f"Python {machine.get('python', record.get('python', ''))}", *kind, *packages]
    return ", ".join(part.replace(" ", "\N{NO-BREAK SPACE}") for part in parts)


def _alike(planned: list[Planned]) -> list[list[Planned]]:
    """Steps of a stage with the same status and reasons, the photo's own name aside."""
    groups: dict[tuple, list[Planned]] = {}
    for p in planned:
        reasons = [_of_any_photo(reason, p.step) for reason in p.reasons]
        groups.setdefault((p.step.stage, p.status, tuple(reasons)), []).append(structs.replace(p, reasons=reasons))
    return list(groups.values())


def _of_any_photo(reason: str, step: Step) -> str:
    """`masks/kitchen` is `masks` to the step of the kitchen, `photos.kitchen.image` is `photos.*.image`.

    >>> _of_any_photo("if masks/kitchen, train comes out different", Step("align", "kitchen"))
    'if masks, train comes out different'
    """
    if step.photo is None:
        return reason
    if reason.startswith(("if ", "result of ")):
        return reason.replace(f"/{step.photo}", "")
    return reason.replace(f" photos.{step.photo}.", " photos.*.", 1) if reason.startswith("dataset.yaml:") else reason


def _items(group: list[Planned]) -> str:
    names = [p.step.of for p in group if p.step.of]
    return ", ".join(names) if len(names) <= 3 else f"{len(names)} {'recipes' if group[0].step.recipe else 'photos'}"


def _short(reasons: list[str]) -> str:
    more = f"; {len(reasons) - SHOWN} more" if len(reasons) > SHOWN else ""
    return "; ".join(reasons[:SHOWN]) + more


def count(steps: list[Step]) -> str:
    """
    >>> count([Step("train")])
    '1 step'
    """
    return "1 step" if len(steps) == 1 else f"{len(steps)} steps"


def listed(steps: list[Step]) -> str:
    """The steps by name, at most NAMED of them.

    >>> listed([Step("train"), Step("urm", "a")])
    'train, urm/a'
    """
    more = [f"{len(steps) - NAMED} more"] if len(steps) > NAMED else []
    return ", ".join([*map(str, steps[:NAMED]), *more])


def unneeded_lines(found: list[Unneeded], now: float) -> list[str]:
    """A line a stage: how many results nothing names, what they take, and how old they are."""
    ages = [(_age(now - group.oldest), _age(now - group.newest)) for group in found]
    return [
        f"{group.stage:<10} {group.results:>5} {'result ' if group.results == 1 else 'results'} {group.bytes / 1e6:>9.1f} MB   "
        + (f"{newest} old" if oldest == newest else f"{newest} to {oldest} old")
        for group, (oldest, newest) in zip(found, ages, strict=True)
    ]


def _age(seconds: float) -> str:
    """
    >>> _age(30), _age(7200), _age(200000)
    ('less than an hour', '2 h', '2 days')
    """
    hours = int(max(0.0, seconds) // 3600)
    return "less than an hour" if hours == 0 else f"{hours} h" if hours < 48 else f"{hours // 24} days"
