"""What tests of faults share: this project with results of its own, and another user, without root's rights."""

import os
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.faults.battered import real_project

NOBODY = 65534


@pytest.fixture(scope="module")
def linked(tmp_path_factory):
    """This project with a build/ of its own."""
    return real_project(tmp_path_factory.mktemp("project"))


@pytest.fixture
def open_folder():
    """An empty folder that every user may enter, as pytest's own is not."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def as_other_user():
    """A context in which files are opened with the rights of a user who owns none; only root can become one."""
    if os.geteuid() != 0:
        pytest.skip("only root can become another user")

    @contextmanager
    def other():
        os.seteuid(NOBODY)
        try:
            yield
        finally:
            os.seteuid(0)

    with other():
        may_read = os.access(__file__, os.R_OK, effective_ids=True)
    if not may_read:
        pytest.skip(
            "another user may not read this checkout: its folder, or one above it, is closed to others (chmod o+rx)"
        )
    return other
