"""What tests of faults share: another user, without root's rights, and a folder that he may enter."""

import os
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

NOBODY = 65534


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

    return other
