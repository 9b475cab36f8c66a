"""What tests of exported files share."""

import pytest

from factorlib.stage import silent
from stages import export
from tests.export import made_export
from tests.stages.made import ran


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """Inputs of `export`, and the folder of what it wrote; nobody changes them."""
    folder = tmp_path_factory.mktemp("export")
    inputs = made_export.make(folder)
    return inputs, ran(export, inputs, folder / "export", silent, height=256)
