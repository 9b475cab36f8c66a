"""Tests compute the bits that the runner's workers do, whatever `-n` is; and the toy of the runner's tests.

The libraries read these variables when they are loaded, so no plugin of pytest may load one before: see `addopts` in pyproject.toml.
"""

import pytest
from hypothesis import HealthCheck, settings

from tests.runner import toy

settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")  # a busy machine fails no test


def pytest_collection_modifyitems(items):
    """Begin with the run of the pipeline, which takes longest, so that no worker waits for it at the end."""
    items.sort(key=lambda item: "small_run" not in item.name)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """The toy, everything made; nobody changes it."""
    project = toy.make_project(tmp_path_factory.mktemp("toy") / "root")
    assert toy.make(project) == 0
    return project


@pytest.fixture
def project(made_once, tmp_path):
    """The toy, everything current, in a checkout of its own."""
    return toy.copy(made_once, tmp_path / "a root with spaces")


@pytest.fixture
def fresh(tmp_path):
    """The toy, nothing made yet."""
    return toy.make_project(tmp_path / "root")
