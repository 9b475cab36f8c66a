"""What each stage cost, from the run log: the only part of the page that differs from run to run."""

from __future__ import annotations

import msgspec


class StageCost(msgspec.Struct, frozen=True):
    """seconds: summed over the stage's steps;  longest: its longest step;  steps: how many ran."""

    stage: str
    steps: int
    seconds: float
    longest: float
    memory_mb: float | None


class Cost(msgspec.Struct, frozen=True):
    stages: list[StageCost]
    total: float
    warnings: list[str]


def cost_of(events: list[dict], order: list[str]) -> Cost:
    """Of the last time each step ran; stages in the order given."""
    last = {(e["stage"], e.get("photo")): e for e in events if e.get("event") == "done" and "seconds" in e}
    stages = [s for s in order if any(stage == s for stage, _ in last)]
    rows = [_stage_cost(s, [e for (stage, _), e in last.items() if stage == s]) for s in stages]
    return Cost(rows, sum(r.seconds for r in rows), sorted({e["text"] for e in events if e.get("event") == "warning" and "text" in e}))


def _stage_cost(stage: str, events: list[dict]) -> StageCost:
    memory = [e["memory_mb"] for e in events if e.get("memory_mb") is not None]
    seconds = [float(e["seconds"]) for e in events]
    return StageCost(stage, len(events), sum(seconds), max(seconds), max(memory) if memory else None)
