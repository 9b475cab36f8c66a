"""The graph of stages as an SVG: a column for each layer, so that every arrow leads to the right.

Layers are the lengths of the longest ways from a stage without inputs.  Arrows over several layers pass through a place in each, one for
all of the same stage, and the places of a layer are put into the order of the means of what they are linked with (Sugiyama, Tagawa and
Toda 1981), which keeps crossings few.  Arrows that another way already implies are thin.
"""

from __future__ import annotations

from html import escape

import msgspec

from factorlib.runner.pipeline import DATASET, Pipeline

WIDTH, HEIGHT, ACROSS, DOWN, MARGIN = 134.0, 58.0, 62.0, 20.0, 24.0  # of a stage, between two, around all; pixels
THIN = 14.0  # height of the place of an arrow that passes
SWEEPS = 12
FILL = {"current": "#e3f1e6", "running": "#dfeafa", "to run": "#fbe9d2", "maybe": "#f6f2dc", "": "#f3f4f6"}
STYLE = """text { font: 12px system-ui, 'DejaVu Sans', sans-serif; fill: #1b1d21; } .soft { fill: #5b6068; font-size: 10px; }
.name { font-weight: 600; font-size: 13px; } path { fill: none; stroke: #5b6068; stroke-width: 1.4; } path.implied { stroke: #c3c8cf; stroke-width: 1; }
rect.stage { stroke: #9aa1ab; } rect.many { stroke: #9aa1ab; fill: #ffffff; } rect.optional { stroke-dasharray: 4 3; }"""

Place = tuple[str, int]  # a stage in its layer, or `stage>` where its arrows pass a layer


class State(msgspec.Struct, frozen=True):
    """What is said of a stage: how many steps it has (None where that is not known), and how many of them are how far."""

    steps: int | None = None
    counts: dict[str, int] = {}


def drawing(pipeline: Pipeline, states: dict[str, State] | None = None) -> str:
    """The SVG; `states`: of a data set, by stage."""
    layers = layers_of(pipeline)
    columns, ways = _places(pipeline, layers)
    _untangle(columns, ways)
    where = _positions(columns)
    needed = _not_implied(pipeline)
    arrows = [_arrow(way, where, way[0][0], (way[0][0], way[-1][0]) in needed) for way in sorted(ways, key=lambda w: (w[0][0], w[-1][0]) in needed)]
    boxes = [part for name in pipeline.order() for part in _stage(name, pipeline, where[name, layers[name]], (states or {}).get(name, State()))]
    width = MARGIN * 2 + len(columns) * (WIDTH + ACROSS) - ACROSS
    height = max(y for _, y in where.values()) + HEIGHT / 2 + MARGIN
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}">'
    tip = '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto"><path d="M0,0.5 L7,4 L0,7.5"/></marker></defs>'
    return "\n".join([head, f"<style>{STYLE}</style>", tip, '<rect width="100%" height="100%" fill="#ffffff"/>', *arrows, *boxes, "</svg>"]) + "\n"


def layers_of(pipeline: Pipeline) -> dict[str, int]:
    """The layer of each stage: one to the right of the rightmost that it takes."""
    found: dict[str, int] = {}
    for name in pipeline.order():
        found[name] = max((found[above] + 1 for above in pipeline.stages[name].upstream), default=0)
    return found


def _places(pipeline: Pipeline, layers: dict[str, int]) -> tuple[list[list[Place]], list[list[Place]]]:
    """What stands in each layer, and each arrow as the places that it leads through."""
    columns: list[list[Place]] = [[] for _ in range(max(layers.values()) + 1)]
    ways = []
    for name, layer in layers.items():
        columns[layer].append((name, layer))
    for name in pipeline.order():
        for above in pipeline.stages[name].upstream:
            between = [(f"{above}>", layer) for layer in range(layers[above] + 1, layers[name])]
            for place in between:
                if place not in columns[place[1]]:
                    columns[place[1]].append(place)
            ways.append([(above, layers[above]), *between, (name, layers[name])])
    return columns, ways


def _untangle(columns: list[list[Place]], ways: list[list[Place]]) -> None:
    """Order every column by the means of its neighbours' ranks, to the right and back."""
    linked: dict[Place, list[Place]] = {}
    for way in ways:
        for one, other in zip(way, way[1:], strict=False):
            linked.setdefault(one, []).append(other)
            linked.setdefault(other, []).append(one)
    for sweep in range(SWEEPS):
        side = -1 if sweep % 2 == 0 else 1
        for column in columns if side < 0 else reversed(columns):
            ranks = {place: (k + 0.5) / len(other) for other in columns for k, place in enumerate(other)}
            means = {place: _mean([ranks[n] for n in linked.get(place, ()) if n[1] == place[1] + side], ranks[place]) for place in column}
            column.sort(key=means.__getitem__)


def _mean(values: list[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise


def _positions(columns: list[list[Place]]) -> dict[Place, tuple[float, float]]:
    """The middle of each place; columns are centred on the tallest."""
    heights = [sum(_height(place) + DOWN for place in column) - DOWN for column in columns]
    where = {}
    for number, column in enumerate(columns):
        top = MARGIN + (max(heights) - heights[number]) / 2
        for place in column:
            where[place] = MARGIN + number * (WIDTH + ACROSS) + WIDTH / 2, top + _height(place) / 2
            top += _height(place) + DOWN
    return where


def _height(place: Place) -> float:
    return THIN if ">" in place[0] else HEIGHT


def _not_implied(pipeline: Pipeline) -> set[tuple[str, str]]:
    """The arrows without which the order of stages would be another."""
    above: dict[str, set[str]] = {}
    for name in pipeline.order():
        direct = pipeline.stages[name].upstream
        above[name] = set(direct).union(*(above[one] for one in direct))
    return {(one, name) for name, stage in pipeline.stages.items() for one in stage.upstream if not any(one in above[other] for other in stage.upstream)}


def _arrow(way: list[Place], where: dict[Place, tuple[float, float]], name: str, needed: bool) -> str:
    """From the right edge of one stage to the left edge of another, level where it passes a layer."""
    points = [where[place] for place in way]
    (x, y), *_ = points
    words = [f"M{x + WIDTH / 2:.1f},{y:.1f}"]
    for (x0, y0), (x1, y1) in zip(points, points[1:], strict=False):
        start, end = x0 + WIDTH / 2, x1 - WIDTH / 2
        words.append(f"L{start:.1f},{y0:.1f} C{(start + end) / 2:.1f},{y0:.1f} {(start + end) / 2:.1f},{y1:.1f} {end:.1f},{y1:.1f}")
    css = "" if needed else ' class="implied"'
    return f'<path{css} d="{" ".join(words)}"{" marker-end=" + chr(34) + "url(#tip)" + chr(34) if needed else ""}/>'


def _stage(name: str, pipeline: Pipeline, middle: tuple[float, float], state: State) -> list[str]:
    """A box; a second one behind it where the stage has a step for each photo or recipe."""
    stage, (x, y) = pipeline.stages[name], middle
    left, top = x - WIDTH / 2, y - HEIGHT / 2
    kinds = "stage optional" if stage.optional else "stage"
    worst = next((status for status in ("running", "to run", "maybe", "current") if state.counts.get(status)), "")
    box = f'width="{WIDTH:g}" height="{HEIGHT:g}" rx="6"'
    behind = [f'<rect class="many" x="{left + 4:.1f}" y="{top + 4:.1f}" {box}/>'] if stage.over else []
    count = "" if state.steps is None or not stage.over else f"{state.steps} {stage.over}{'s' * (state.steps != 1)}"
    over = count or (f"per {stage.over}" if stage.over else "whole set")
    slices = ", ".join(stage.slices)
    said = ", ".join(f"{number} {status}" for status, number in state.counts.items()) or (f"{DATASET}{slices}" if slices else "")
    said = said if len(said) <= 22 else said[:21] + "…"
    taken = ", ".join(stage.inputs) or "parameters only"
    return [
        *behind,
        f"<g><title>{escape(name)} takes {escape(taken)}</title>",
        f'<rect class="{kinds}" x="{left:.1f}" y="{top:.1f}" {box} fill="{FILL[worst]}"/>',
        f'<text class="name" x="{x:.1f}" y="{top + 19:.1f}" text-anchor="middle">{escape(name)}</text>',
        f'<text x="{x:.1f}" y="{top + 35:.1f}" text-anchor="middle">{escape(over)}</text>',
        f'<text class="soft" x="{x:.1f}" y="{top + 50:.1f}" text-anchor="middle">{escape(said)}</text></g>',
    ]
