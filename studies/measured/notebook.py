"""Outputs of docs/result.ipynb, run on data/eames: `make results ONLY=notebook`.

It takes `make setup EXTRAS=notebook`.
"""

from pathlib import Path

from factorlib.errors import InputError
from factorlib.wholefile import write_text
from studies.measured.tools import ROOT, evaluate_dataset

PAGE = ROOT / "docs" / "result.ipynb"


def write() -> Path:
    """Run all cells in docs/ and write the notebook with what they show, without times and versions; returns its path.

    Raises InputError if what runs notebooks is not installed, and CellExecutionError if a cell fails.
    """
    try:
        import nbformat
        from nbclient import NotebookClient
    except ImportError as error:
        raise InputError("what runs notebooks is not installed", cure="make setup EXTRAS=notebook") from error
    evaluate_dataset("eames", ROOT)
    notebook = nbformat.read(PAGE, 4)
    resources = {"metadata": {"path": str(PAGE.parent)}}
    NotebookClient(notebook, kernel_name="python3", record_timing=False, timeout=None, resources=resources).execute()
    notebook.metadata.language_info = {"name": "python"}
    write_text(PAGE, nbformat.writes(notebook) + "\n")
    return PAGE
