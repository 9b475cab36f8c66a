"""Accuracy against processor time on data/eames: `make results ONLY=speed`, which draws docs/speed.svg, too.

Every variant is run by the whole pipeline; the time is that of the stage `solve`.  The last one is the default, so that
build/eames shows it afterwards.
"""

import math
from collections.abc import Collection

import msgspec

from factorlib.results.metrics import Metrics
from factorlib.wholefile import write_text
from studies.measured.tools import ROOT, Tables, evaluate_dataset, processor_seconds

FIGURE = ROOT / "docs" / "speed.svg"
VARIANTS = {  # label -> SET
    "the paper's solver": "solve.solver=paper",
    "draft: 100 cells, 300 observations, no splitting": "solve.preset=draft",
    "150 cells, no splitting": "solve.cells=150 solve.splittings=0",
    "fast: 150 cells": "solve.preset=fast",
    "no splitting": "solve.splittings=0",
    "300 observations": "solve.observations=300",
    "4000 observations": "solve.observations=4000",
    "default: 400 cells, 1000 observations, 3 splittings": "",
}
HEAD = ["solve", "processor seconds of `solve`", "relit set score, dB", "worst pair, dB", "error of roughness"]
WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 720, 340, 60, 50, 20, 40  # pixels of the figure, and of its margins


def measure(label: str, settings: str) -> tuple[list[str], float, float]:
    """Return the row of a variant, its processor seconds and its relit set score."""
    metrics = msgspec.convert(evaluate_dataset("eames", SET=settings), Metrics)
    assert metrics.relit_set and metrics.materials  # data/eames has a truth
    score, seconds = metrics.relit_set, processor_seconds("eames", settings.split())["solve"]
    numbers = [f"{seconds:.0f}", f"{score.mean_psnr_db:.1f}", f"{score.worst_psnr_db:.1f}"]
    return [label, *numbers, f"{metrics.materials.mean_roughness:.3f}"], seconds, score.mean_psnr_db


def draw(points: list[tuple[float, float]], marked: Collection[int]) -> str:
    """Return an SVG of scores over processor seconds, on a logarithmic axis; points are numbered from 1."""
    seconds, scores = zip(*points, strict=True)
    low, high = math.log2(min(seconds)), math.log2(max(seconds))
    floor, ceiling = math.floor(min(scores)), math.ceil(max(scores))

    def x(second: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (math.log2(second) - low) / (high - low)

    def y(score: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * (score - floor) / (ceiling - floor)

    parts = [f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>']
    for score in range(floor, ceiling + 1, 2):
        parts.append(f'<path d="M{LEFT - 12} {y(score):.0f}H{WIDTH - RIGHT + 12}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 24}" y="{y(score) + 4:.0f}">{score}</text>')
    for power in range(math.ceil(low), math.floor(high) + 1):
        parts.append(f'<text x="{x(2**power):.0f}" y="{HEIGHT - BOTTOM + 26}">{2**power}</text>')
    parts.append(f'<text x="{WIDTH / 2}" y="{HEIGHT - 6}">processor seconds of the solve</text>')
    parts.append(f'<text transform="translate(14 {HEIGHT / 2}) rotate(-90)">relit set score, dB</text>')
    for number, (second, score) in enumerate(points, 1):
        colour = "#b22" if number in marked else "#357"
        parts.append(f'<circle cx="{x(second):.0f}" cy="{y(score):.0f}" r="9" fill="{colour}"/>')
        parts.append(f'<text x="{x(second):.0f}" y="{y(score) + 4:.0f}" fill="white">{number}</text>')
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" text-anchor="middle"'
    return "\n".join([f'{head} font-family="sans-serif" font-size="12">', *parts, "</svg>", ""])


def rows() -> Tables:
    """Return the rows of all variants, and draw the figure, the presets marked."""
    measured = [measure(f"{number}. {label}", VARIANTS[label]) for number, label in enumerate(VARIANTS, 1)]
    presets = [n for n, settings in enumerate(VARIANTS.values(), 1) if "preset" in settings or not settings]
    write_text(FIGURE, draw([(seconds, score) for _, seconds, score in measured], presets))
    return {"data/eames": [HEAD, *(row for row, _, _ in measured)]}
