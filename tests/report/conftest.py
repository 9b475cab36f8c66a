"""One result and its page, for all tests of the page and of its viewer; nobody changes them."""

import pytest

from tests.report.test_page import LINKED, run


@pytest.fixture(scope="session")
def report_page(tmp_path_factory):
    """Its folder, the inputs of `report`, and the page."""
    folder = tmp_path_factory.mktemp("page")
    return folder, *run(folder, seen=LINKED, held_out=("dusk",))
