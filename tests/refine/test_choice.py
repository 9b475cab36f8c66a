"""Which candidate is believed: the laws of the decision, whatever the numbers come from."""

from __future__ import annotations

import numpy as np
import pytest

from factorlib.align.state import State
from factorlib.refine.choice import Judged, Standards, choice_of, gain_of

STATE = State(np.eye(3), 0.0, 0.0, 0.0, 0.0)
STANDARDS = Standards(least_gain=0.03, most_lost=0.01, rival=0.05)


def one(name, gain, stderr=0.001, score=0.95):
    """In two cells, of which the pose found has a loss of a half in each: the gain over it, and its standard error."""
    return Judged(name, STATE, score, 1 - gain, (1 - gain) / 2 + np.array([1, -1]) * stderr / 2)


FOUND = one("found", 0.0, 0.0)


@pytest.mark.parametrize(
    "others, chosen, ruled_out",
    [
        ([one("moved", -0.2)], "found", None),
        ([one("moved", 0.02)], "found", None),  # less than the least gain
        ([one("moved", 0.2, stderr=0.15)], "found", None),  # not sure
        ([one("moved", 0.2, score=0.93)], "found", None),  # runs away from the silhouette
        ([one("moved", 0.2)], "moved", None),
        ([one("moved", 0.2, stderr=0.15, score=0.98)], "moved", None),  # silhouette and shading agree
        ([one("moved", -0.01, score=0.99)], "found", None),  # held-out pixels must agree
        ([one("moved", 0.1), one("runner_up", 0.3, score=0.92)], "runner_up", None),
        ([one("moved", 0.3), one("runner_up", 0.1)], "moved", True),
        ([one("moved", 0.0), one("runner_up", -0.3)], "found", True),
        ([one("moved", 0.0), one("runner_up", -0.3, stderr=0.2)], "found", False),  # still open
        ([one("moved", 0.0), one("runner_up", 0.01)], "found", False),
    ],
)
def test_a_pose_gives_way_only_to_one_that_is_surely_better(others, chosen, ruled_out):
    settled = choice_of([FOUND, *others], STANDARDS)
    assert settled.chosen == chosen and settled.ruled_out is ruled_out


def test_a_gain_is_as_sure_as_its_cells_agree_in_both_directions():
    before = np.full(20, 20.0)
    assert gain_of(before, 0.7 * before) == pytest.approx((0.3, 0.0), abs=1e-12)
    after = 20 * np.random.default_rng(0).uniform(0.2, 1.2, 20)
    assert gain_of(before, after) == pytest.approx((1 - after.mean() / 20, after.std(ddof=1) / np.sqrt(20) / 20))
    (gain, stderr), (loss, loss_stderr) = gain_of(before, after), gain_of(after, before)
    assert gain / stderr == pytest.approx(-loss / loss_stderr)
    one_cell = np.where(np.arange(20) == 3, 50.0, 1.0)
    gain, stderr = gain_of(one_cell, np.ones(20))
    assert 0.5 < gain < 2 * stderr, "one cell settles nothing"
