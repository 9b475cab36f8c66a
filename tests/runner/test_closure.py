"""What of the source counts: everything that is run, however far it is imported from, no remark; and what it says of parameters."""

import ast
import importlib
import importlib.metadata
from pathlib import Path

import pytest

from factorlib.runner import verbs
from factorlib.runner.closure import Sources, source_of
from factorlib.runner.project import LIBRARY, Project, photo_sets, read_pipeline
from factorlib.runner.store import FileHashes
from tests.runner import toy

FUNCTION = "def f(x):\n    return x + 1\n"


@pytest.mark.parametrize(
    "text, counts",
    [
        ('def f(x):\n    "What it does."\n    return x + 1\n', False),
        ("# why\ndef f(x):  # here\n\n    return (x+1)\n", False),
        ("def f(x):\n    return x + 2\n", True),
        ("def f(y):\n    return y + 1\n", True),
        (FUNCTION + 'Y = "a string"\n', True),
        (FUNCTION + '"A string that stands alone."\n', False),
    ],
)
def test_comments_docstrings_and_layout_do_not_count_and_anything_else_does(text, counts):
    assert (source_of(text, "m", False).digest != source_of(FUNCTION, "m", False).digest) == counts


def test_every_form_of_import_is_followed(tmp_path):
    files = {
        "stages/s.py": "import p.a\ndef main():\n    from p import b\n",
        "p/__init__.py": "", "p/a.py": "from .sub.c import d\n", "p/b.py": "import numpy as np, os\n",
        "p/sub/__init__.py": "from . import e\n", "p/sub/c.py": "from ..b import *\nd = 1\n", "p/sub/e.py": "", "p/unused.py": "", "p/w.safetensors": "1",
        "p/.a.py.swp": "", "p/a.py~": "", "p/__pycache__/a.cpython-311.pyc": "", "p/kernel.c": "",
        "p/sub/templates/page.html": "2", "p/other/x.css": "3", "p/other/__init__.py": "",
    }  # fmt: skip
    for name, text in files.items():
        toy.write(tmp_path / name, text)
    closure = Sources([tmp_path], FileHashes(None)).closure("stages", "s", Path("pipeline.yaml"))
    modules = {name.removeprefix("source:") for name in closure.record if name.startswith("source:")}
    assert modules == {"p", "p.a", "p.b", "p.sub", "p.sub.c", "p.sub.e", "stages.s"}
    data = {name.removeprefix("data:") for name in closure.record if name.startswith("data:")}
    assert data == {"p:kernel.c", "p:w.safetensors", "p.sub:templates/page.html"}
    packages = {name: version for name, version in closure.record.items() if name.startswith("package:")}
    assert packages == {"package:numpy": importlib.metadata.version("numpy")}


def test_a_package_that_lies_beside_an_installed_library_is_none_of_the_project(tmp_path):
    toy.write(tmp_path / "root/stages/s.py", "import numpy, factorlib.a\n")
    for name in ("factorlib/__init__.py", "factorlib/a.py", "numpy/__init__.py"):
        toy.write(tmp_path / "site-packages" / name, "")
    roots = [tmp_path / "root", tmp_path / "site-packages"]
    record = Sources(roots, FileHashes(None)).closure("stages", "s", Path("pipeline.yaml")).record
    sources = {name for name in record if name.startswith(("source:", "package:"))}
    assert sources == {"source:stages.s", "source:factorlib", "source:factorlib.a", "package:numpy"}


@pytest.mark.parametrize("stage", read_pipeline(LIBRARY / "pipeline.yaml", photo_sets().slices).order())
def test_every_parameter_of_a_stage_says_what_it_means(stage, capsys):
    """`make params` prints the fields as the source states them, each with its meaning."""
    assert verbs.show_params(Project(LIBRARY, photo_sets()), [stage]) == 0
    text = capsys.readouterr().out.partition("\n")[2].partition(f"{stage}.preset=")[0]
    for struct in ast.parse(text).body:
        for field, following in zip(struct.body, struct.body[1:]):
            if isinstance(field, ast.AnnAssign) and f"class {ast.unparse(field.annotation)}(" not in text:
                assert following.value.value.rstrip().endswith("."), ast.unparse(field)


def test_a_file_that_just_changed_is_not_cached(tmp_path):
    """A second write within the clock's step would be missed."""
    file, hashes = tmp_path / "a", FileHashes(tmp_path / "cache")
    file.write_text("one")
    hashes.content(file)
    hashes.save()
    assert not (tmp_path / "cache").exists()
