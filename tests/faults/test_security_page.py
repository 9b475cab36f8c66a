"""docs/security.md names a test for each of its promises, and each test that it names is there."""

import re
from pathlib import Path

from factorlib.runner.project import LIBRARY

PAGE = (LIBRARY / "docs" / "security.md").read_text(encoding="utf-8")
NAMED = re.compile(r"`(?:(?:tests/(?:\w+/)*)?(test_\w+\.py))?(?:::(test_\w+))?`")


def files_called(name):
    return [path.read_text(encoding="utf-8") for path in (LIBRARY / "tests").rglob(name)]


def named():
    """Modules of tests with the functions in them that the page names; a function alone is of the module named before."""
    module = None
    for found in NAMED.finditer(PAGE):
        module = found[1] or module
        if found[1] or found[2]:
            yield module, found[2]


def test_every_test_that_the_page_names_is_there():
    pairs = list(named())
    assert len(pairs) > 40
    for module, function in pairs:
        texts = files_called(module)
        assert texts and (function is None or any(f"def {function}(" in text for text in texts)), f"{module}::{function}"


def test_every_line_of_a_table_names_a_test():
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and not line.startswith("| what is tried")]
    assert len(rows) > 20 and all(NAMED.search(line.rpartition(" | ")[2]) and "test_" in line for line in rows)


def test_the_modules_that_are_named_by_their_path_lie_there():
    for path in re.findall(r"`(tests/[\w/]+\.py)", PAGE):
        assert Path(LIBRARY / path).is_file(), path
