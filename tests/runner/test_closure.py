"""What of the source counts: everything that is run, however far it is imported from; no remark."""

from pathlib import Path

import pytest

from factorlib.errors import InputError
from factorlib.runner.closure import Sources, source_of
from factorlib.runner.filehash import FileHashes
from tests.runner import toy


def digest(text):
    return source_of(text, "m", False).digest


@pytest.mark.parametrize(
    "other", ['def f(x):\n    "What it does."\n    return x + 1\n', "# why\ndef f(x):  # here\n\n    return (x+1)\n"]
)
def test_comments_docstrings_and_layout_do_not_count(other):
    assert digest("def f(x):\n    return x + 1\n") == digest(other)


@pytest.mark.parametrize(
    "other",
    ["def f(x):\n    return x + 2\n", "def f(y):\n    return y + 1\n", 'def f(x):\n    return x + 1\nY = "a string"\n'],
)
def test_anything_else_counts(other):
    assert digest("def f(x):\n    return x + 1\n") != digest(other)


def test_every_form_of_import_is_followed(tmp_path):
    files = {
        "stages/s.py": "import p.a\ndef main():\n    from p import b\n",
        "p/__init__.py": "", "p/a.py": "from .sub.c import d\n", "p/b.py": "import numpy as np, os\n",
        "p/sub/__init__.py": "from . import e\n", "p/sub/c.py": "from ..b import *\nd = 1\n", "p/sub/e.py": "", "p/unused.py": "", "p/w.safetensors": "1",
        "p/sub/templates/page.html": "2", "p/other/x.css": "3", "p/other/__init__.py": "",
    }  # fmt: skip
    for name, text in files.items():
        toy.write(tmp_path / name, text)
    closure = Sources([tmp_path], FileHashes(None)).closure("stages", "s", Path("pipeline.yaml"))
    assert set(closure.modules) == {"p", "p.a", "p.b", "p.sub", "p.sub.c", "p.sub.e", "stages.s"}
    assert set(closure.data) == {"p:w.safetensors", "p.sub:templates/page.html"}
    assert closure.external == ["numpy"]


def test_a_stage_without_a_module_is_refused(tmp_path):
    project = toy.make_project(tmp_path)
    toy.write(tmp_path / "pipeline.yaml", toy.PIPELINE.replace("upper:", "uper:").replace("[upper]", "[uper]"))
    with pytest.raises(InputError, match="uper") as caught:
        toy.state(project)
    assert "did you mean 'upper'" in caught.value.cure


def test_what_is_remembered_of_a_file_ends_with_any_change(tmp_path):
    file = tmp_path / "f"
    file.write_text("one")
    import os

    os.utime(file, ns=(1, 1))
    hashes = FileHashes(tmp_path / "cache.json")
    first = hashes.content(file)
    file.write_text("two")
    os.utime(file, ns=(1, 1))  # same size, same time
    assert hashes.content(file) != first
