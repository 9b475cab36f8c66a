"""Planning is linear in the number of photos, by the work that is done, not by a clock."""

import os
import sys
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from factorlib.dataset.schema import Dataset, DatasetFile
from factorlib.dataset.slices import dataset_slice
from factorlib.runner.pipeline import read_pipeline
from factorlib.runner.plan import Listing, Spec, plan
from factorlib.runner.project import LIBRARY, photo_sets


def work(function):
    """How many bytecodes a call executes."""
    count = 0

    def trace(frame, event, _):
        nonlocal count
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        count += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        function()
    finally:
        sys.settrace(before)
    return count


class Everything(dict):
    """A store that holds a result of every key, another for each."""

    def get(self, key, default=None):
        return f"output of {key}"


def planning(photos, outputs):
    spec = Spec(read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices), [f"p{k}" for k in range(photos)])
    own = {step: {"stage": step.stage, "photo": step.photo} for step in spec.steps()}
    return lambda: plan(spec, own, Listing(outputs, {str(step): own[step] for step in own}))


def slicing(photos, _):
    entry = {"image": "i.png", "masks": "m.png", "objects": [{"name": "o", "mesh": "m"}]}
    file = {"format": 1, "materials": ["a"], "meshes": {"m": {"file": "m.obj"}}}
    file["photos"] = [{"name": f"p{k}", **entry} for k in range(photos)]
    dataset, names = Dataset(Path(), msgspec.convert(file, DatasetFile)), ("photo", "objects", "light")
    return lambda: [dataset_slice(dataset, name, photo.name) for photo in dataset.spec.photos for name in names]


@pytest.mark.parametrize("made, outputs", [(planning, {}), (planning, Everything()), (slicing, None)])
def test_a_plan_and_the_slices_of_all_photos_are_linear(made, outputs):
    works = [work(made(photos, outputs)) for photos in (20, 40, 80)]
    assert works[2] - works[1] < 2.1 * (works[1] - works[0])


@contextmanager
def own_modules(*packages):
    """Whatever of these packages is imported within is forgotten, and what was there before is there again."""
    of_these = lambda: {name: module for name, module in sys.modules.items() if name.split(".")[0] in packages}  # noqa: E731
    before, path, environment = of_these(), list(sys.path), dict(os.environ)
    for name in before:
        del sys.modules[name]
    try:
        yield
    finally:
        for name in of_these():
            del sys.modules[name]
        sys.modules.update(before)
        sys.path[:] = path
        os.environ.clear()
        os.environ.update(environment)
