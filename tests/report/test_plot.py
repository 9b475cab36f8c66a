"""Plots are well-formed SVG, leave out what cannot be drawn, and keep their points inside."""

import math
import re
import xml.etree.ElementTree as ET

import pytest

from factorlib.report.plot import HEIGHT, WIDTH, line_plot, ticks


@pytest.mark.parametrize("values", [[1.0], [2.0, 2.0, 2.0], [1e-6, 1.0, 1e5], [1.0, math.nan, 3.0], [0.0, 5.0]])
@pytest.mark.parametrize("log_y", [True, False])
def test_any_history_gives_a_plot_inside_its_frame(values, log_y):
    svg = line_plot({"a & b": (range(len(values)), values)}, "step", "loss <1>", log_y=log_y, rules=[0])
    ET.fromstring(svg)
    for points in re.findall(r'points="([^"]*)"', svg):
        for x, y in (map(float, p.split(",")) for p in points.split()):
            assert 0 <= x <= WIDTH and 0 <= y <= HEIGHT


def test_nothing_to_draw_gives_nothing():
    assert line_plot({"a": ([0], [math.nan])}, "x", "y") == ""
    assert line_plot({}, "x", "y") == ""


def test_named_places_stand_in_for_numbers():
    svg = line_plot({"a": ([0, 1], [1.0, 2.0])}, "x", "y", names=["few", "many & more"])
    ET.fromstring(svg)
    assert ">few</text>" in svg and ">many &amp; more</text>" in svg and ">0.2</text>" not in svg


def test_larger_values_stand_higher():
    svg = line_plot({"a": ([0, 1], [1.0, 2.0])}, "x", "y")
    (x0, y0), (x1, y1) = (tuple(map(float, p.split(","))) for p in re.search(r'points="([^"]*)"', svg)[1].split())
    assert x1 > x0 and y1 < y0


@pytest.mark.parametrize("low, high", [(0, 1), (-3, 7), (0.001, 0.0042), (5, 5), (1e5, 3e6)])
def test_ticks_are_few_and_inside(low, high):
    found = ticks(low, high)
    assert len(found) <= 6 and all(low - 1e-9 <= t <= high + 1e-9 for t in found)
