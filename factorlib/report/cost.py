"""What each stage cost, from the run log: the only part of the page that differs from run to run.

A line of the log is {"event": "done", "stage", "photo", "seconds", "cpu_seconds", "memory_mb", "threads", "machine", …}
for a step, or {"event": "warning", "stage", "photo", "text"}.
"""

from __future__ import annotations

import msgspec


class StageCost(msgspec.Struct, frozen=True):
    """seconds: wall time summed over the stage's steps;  longest: of its longest step;  memory_mb: largest peak of any."""

    stage: str
    steps: int
    seconds: float
    longest: float
    cpu_seconds: float | None
    memory_mb: float | None


class Cost(msgspec.Struct, frozen=True):
    """machines: the different ones that steps ran on, in words;  warnings: in the order of the stages, each once."""

    stages: list[StageCost]
    total: float
    total_cpu: float
    machines: list[str]
    warnings: list[tuple[str, str]]


def cost_of(events: list[dict], order: list[str]) -> Cost:
    """Of the last time each step ran; stages in the order given."""
    last = {(e["stage"], e.get("photo")): e for e in events if e.get("event") == "done" and "seconds" in e}
    by_stage = {s: [e for (stage, _), e in last.items() if stage == s] for s in order}
    rows = [_stage_cost(s, found) for s, found in by_stage.items() if found]
    machines = sorted({_machine(e) for e in last.values() if e.get("machine")})
    said = {(e.get("stage") or "", e["text"]) for e in events if e.get("event") == "warning" and e.get("text")}
    ranked = sorted(said, key=lambda w: (order.index(w[0]) if w[0] in order else len(order), w[1]))
    return Cost(rows, sum(r.seconds for r in rows), sum(r.cpu_seconds or 0 for r in rows), machines, ranked)


def _stage_cost(stage: str, events: list[dict]) -> StageCost:
    seconds, cpu, memory = ([float(e[k]) for e in events if e.get(k) is not None] for k in ("seconds", "cpu_seconds", "memory_mb"))
    return StageCost(stage, len(events), sum(seconds), max(seconds), sum(cpu) if cpu else None, max(memory) if memory else None)


def _machine(event: dict) -> str:
    m = event["machine"]
    words = [
        m.get("system"),
        m.get("processor"),
        f"{m['cores']} cores" if m.get("cores") else None,
        f"Python {m['python']}" if m.get("python") else None,
    ]
    return ", ".join(w for w in words if w)
