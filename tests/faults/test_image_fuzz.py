"""Images spoiled at random are read or refused by an InputError, and crash nobody; each kind in a process of its own.

`make test` spoils the same few each time; the long test goes on for FUZZ_SECONDS (600), shared by the kinds, with other seeds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from faults.image_fuzz import KINDS
from faults.tries import note

from factorlib.runner.project import LIBRARY

LONG = float(os.environ.get("FUZZ_SECONDS", "600"))
FEW, MANY = 25, 400


def spoiled(folder, kind, seed, count):
    """What came of so many files; a process that was killed by a signal counts as one other."""
    command = [sys.executable, Path(__file__).with_name("image_fuzz.py"), folder, kind, str(seed), str(count)]
    environment = {**os.environ, "PYTHONPATH": str(LIBRARY)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", timeout=900, check=False)
    if done.returncode:
        return {"tries": 1, "accepted": 0, "refused": 0, "other": [f"seed {seed}: exit code {done.returncode}: {done.stderr[-500:]}"]}
    return json.loads(done.stdout.splitlines()[-1])


def check(kind, came):
    other = [words for each in came for words in each["other"]]
    totals = {name: sum(each[name] for each in came) for name in ("tries", "accepted", "refused")}
    note("fuzz", kind, other=len(other), **totals)
    assert not other and totals["accepted"] and totals["refused"]


@pytest.mark.parametrize("kind", [kind if kind in ("photo.jpg", "photo.exr", "mask.png") else pytest.param(kind, marks=pytest.mark.long) for kind in KINDS])
def test_a_spoiled_image_is_read_or_refused(tmp_path, kind):
    check(kind, [spoiled(tmp_path, kind, 1, FEW)])


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_thousands_of_spoiled_images_are_read_or_refused(tmp_path, kind):
    end, seed, came = time.monotonic() + LONG / len(KINDS), int(time.time()), []
    while time.monotonic() < end:
        seed += 1
        came.append(spoiled(tmp_path, kind, seed, MANY))
    check(kind, came)
