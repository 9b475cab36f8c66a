"""The layers of the code: what must start quickly loads no science."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


READ = "from factorlib.dataset.read_dataset import read_dataset; from factorlib.dataset.slices import SLICES, dataset_slice"
SCIENCE = {"numpy", "torch", "scipy", "OpenImageIO", "PIL"}


@pytest.mark.parametrize("code, heavy", [
    ("import factorlib", {*SCIENCE, "mitsuba"}),
    ("import factorlib.__main__; from factorlib.runner.project import photo_sets; photo_sets(); from factorlib.runner import dataset_state",
     {*SCIENCE, "rich", "filelock", "typer", "pydantic"}),
    (f"{READ}; d = read_dataset('data/eames'); [dataset_slice(d, s) for s in SLICES]", SCIENCE),
    ("from factorlib.reflection import reflection_operator; reflection_operator('paper_network')", {"mitsuba"}),
])  # fmt: skip
def test_what_must_start_quickly_loads_nothing_heavy(code, heavy):
    code = f"import sys; {code}; sys.exit(', '.join({heavy!r} & set(sys.modules)) or 0)"
    process = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
