"""A table of a page says of which sources it is, and is named when they are others."""

import pytest

from benchmarks import markdown
from benchmarks.markdown import refresh, table
from benchmarks.stale import ROOT, stale, unmarked

PAGE = "Text.\n\n<!-- begin speed -->\n<!-- end speed -->\n"
SPEED = {"speed": table(["case", "s"], [["one", "2"]])}


@pytest.fixture
def page(tmp_path):
    """A page whose table the module `measures.speed` has written, which imports `library`."""
    (tmp_path / "measures").mkdir()
    (tmp_path / "measures/__init__.py").write_text("")
    (tmp_path / "measures/speed.py").write_text("import library\n\nCASES = 1\n")
    (tmp_path / "library.py").write_text("STEPS = 3\n")
    page = tmp_path / "speed.md"
    page.write_text(PAGE)
    refresh(page, SPEED, "measures.speed", tmp_path)
    return page


def test_a_fresh_table_is_of_these_sources(page):
    assert "| one | 2 |\n<!-- written by measures.speed for sources " in page.read_text()
    assert not list(stale([page], page.parent))


@pytest.mark.parametrize("file", ["library.py", "measures/speed.py"])
def test_other_sources_make_it_stale_and_comments_do_not(page, file):
    source = page.parent / file
    source.write_text(source.read_text() + "# a remark\n")
    assert not list(stale([page], page.parent))
    source.write_text(source.read_text() + "MORE = 4\n")
    (line,) = stale([page], page.parent)
    assert line.startswith("speed.md: speed: of sources ") and "python -m measures.speed --docs" in line
    refresh(page, SPEED, "measures.speed", page.parent)
    assert not list(stale([page], page.parent))


def test_a_module_that_no_number_depends_on_makes_stale_only_what_names_it(page, monkeypatch):
    monkeypatch.setattr(markdown, "WITHOUT_NUMBERS", {"library"})
    refresh(page, SPEED, "measures.speed", page.parent)
    (page.parent / "library.py").write_text("STEPS = 4\n")
    assert not list(stale([page], page.parent))
    refresh(page, SPEED, "measures.speed", page.parent, modules=["measures.speed", "library"])
    (page.parent / "library.py").write_text("STEPS = 5\n")
    assert len(list(stale([page], page.parent))) == 1


def test_a_table_without_stamp_or_without_its_command_is_named(page):
    (page.parent / "measures/speed.py").unlink()
    assert "written by measures.speed, of which" in next(stale([page], page.parent))
    page.write_text(PAGE)
    assert list(stale([page], page.parent)) == ["speed.md: speed: does not say of which sources it is"]


def test_a_typed_number_is_named_whatever_the_sources(page):
    page.write_text("<!-- begin speed -->\n2 s\n<!-- typed from make all -->\n<!-- end speed -->\n")
    (line,) = stale([page], page.parent)
    assert line == "speed.md: speed: typed by hand from: make all; of which sources, nothing says"


def test_quantities_between_no_marks_are_found_and_no_others(page):
    page.write_text(
        "Right to .5 % and 31 dB.\n\n<!-- begin speed -->\n12 s\n<!-- end speed -->\n`x 5 %`, 192 × 128 pixels, 3 photos, 4.2.\n"
        "```\nsolve 3 s\n```\nthen 2.5° wrong\n"
    )
    assert list(unmarked(page, page.parent)) == ["speed.md:1: .5 %, 31 dB", "speed.md:10: 2.5°"]


def test_every_quantity_of_the_readme_names_its_command():
    assert not list(unmarked(ROOT / "README.md"))
