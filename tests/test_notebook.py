"""The Python that README.md and docs/ show runs, on a small result whose names stand in place of those of data/eames."""

import ast
import json
import re

import pytest

from factorlib.runner.project import LIBRARY
from tests.export import made_export

SMALL = {"build/eames": "build/set", "kitchen": "side", "garden": "front", "terrace": "front", "yellow_chair": "chair"}
SMALL |= {"kitchn": "sid", "width=320": "width=32"}
NOTEBOOK = json.loads((LIBRARY / "docs" / "result.ipynb").read_text())


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("root")
    made_export.make_result(root)
    (root / "docs").mkdir()
    return root


def cells(kind):
    return ["".join(cell["source"]) for cell in NOTEBOOK["cells"] if cell["cell_type"] == kind]


def examples(page):
    blocks = re.findall(r"```python\n(.*?)```", (LIBRARY / page).read_text(), re.DOTALL)
    return [block for block in blocks if "load_result" in block]


def run(code, names):
    """As a notebook does: the HTML of the last line's value, where it is an expression that has some."""
    for name, small in SMALL.items():
        code = code.replace(name, small)
    tree = ast.parse(code)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    value = None if last is None else eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    return value._repr_html_() if hasattr(value, "_repr_html_") else None


def test_the_notebook_runs_in_its_own_folder_and_shows_its_tables_and_pictures(root, monkeypatch, capsys):
    monkeypatch.chdir(root / "docs")
    names = {}
    shown = [html for code in cells("code") if (html := run(code, names))]
    assert [html[:4] for html in shown] == [
        "<p>.",
        "<img",
        "<img",
        "<img",
        "<img",
        "<img",
    ] and "0.350 ± 0.100" in shown[0]
    said = capsys.readouterr().out
    assert "roughness 0.350 ± 0.100" in said
    assert [word in said for word in ("did you mean 'red'", "did you mean 'side'", "did you mean 'chair'")] == [
        True
    ] * 3
    assert sorted(path.name for path in (root / "docs").iterdir()) == ["chair.exr", "chair.png", "side.exr", "side.hdr"]


@pytest.mark.parametrize("page", ["README.md", "docs/recipes.md"])
def test_the_examples_of_the_pages_run(root, page, tmp_path, monkeypatch):
    (tmp_path / "build").symlink_to(root / "build")
    monkeypatch.chdir(tmp_path)
    (code,) = examples(page)
    run(code, {})
