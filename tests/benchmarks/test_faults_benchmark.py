"""Tables of what tests of faults tried: sums by name, and nothing for what was not tried."""

import json

from benchmarks.faults import TESTS, tables, tried
from benchmarks.markdown import ROOT


def test_lines_of_one_name_are_added_up(tmp_path):
    lines = [
        {"table": "faults", "name": "a kill", "tries": 3, "lost": 1},
        {"table": "faults", "name": "a kill", "tries": 4, "lost": 0},
        {"table": "hits", "name": "mid-write", "tries": 2, "stages": {"upper": 2, "total": 0}},
        {"table": "hits", "name": "mid-write", "tries": 3, "stages": {"upper": 1, "total": 2}},
        {"table": "fuzz", "name": "photo.jpg", "tries": 1000, "accepted": 400, "refused": 600, "other": 0},
    ]
    (tmp_path / "log").write_text("\n".join(map(json.dumps, lines)))
    found = tables(tried(tmp_path / "log"))
    assert list(found) == ["faults", "hits", "fuzz"]
    assert (
        "| a kill | 7 | 1 |" in found["faults"]
        and "| upper | 3 |" in found["hits"]
        and "| total | 2 |" in found["hits"]
    )
    assert "| photo.jpg | 1,000 | 400 | 600 | 0 |" in found["fuzz"] and "| all | 1,000 |" in found["fuzz"]


def test_the_tests_that_are_counted_are_there():
    assert all((ROOT / file).is_file() for files in TESTS.values() for file in files)
