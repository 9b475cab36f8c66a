"""What docs/studies.md has of a full study is not replaced by a quick one."""

import pytest

from studies.core.table import Conclusion
from studies.tables import against_the_paper, is_full

QUICK = "quick: one seed, smallest sets: no conclusion"


def page(label):
    head = f"what is varied ({label})" if label else "what is varied"
    answers = "| [Prior on lights](#prior-on-lights) | It falls. | agrees |\n"
    return f"<!-- begin conclusions -->\n{answers}<!-- end conclusions -->\n<!-- begin prior -->\n| {head} | error |\n<!-- end prior -->\n"


def found(label):
    return {"prior": Conclusion("prior", "x", "?", "p", "v", "quick" if label else "full", label, (0,), (), [], [])}


@pytest.mark.parametrize("on_page, here, stays", [("", QUICK, True), ("", "", False), (QUICK, QUICK, False)])
def test_a_row_stays_until_there_is_a_study_as_large(on_page, here, stays):
    (row,) = [
        line for line in against_the_paper(found(here), page(on_page)).splitlines() if line.startswith("| [Prior on")
    ]
    assert is_full(page(on_page), "prior") == (not on_page)
    assert (row.rpartition(" | ")[2].startswith("agrees")) == stays, row


@pytest.mark.parametrize("on_page", ["", QUICK])
def test_a_row_of_a_study_that_was_not_run_here_stays(on_page):
    assert "| agrees |" in against_the_paper({}, page(on_page))
    assert "| agrees |" not in against_the_paper({}, "")


def test_a_study_that_the_page_does_not_have_is_not_full():
    assert not is_full("", "prior") and not is_full("<!-- begin prior -->\n(not run)\n<!-- end prior -->", "prior")
