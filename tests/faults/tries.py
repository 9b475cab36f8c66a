"""Lines for the tables of faults (`make results ONLY=faults`): what a test tried and what was lost by it."""

import json
import os
from pathlib import Path

from factorlib.wholefile import append_text


def note(table: str, name: str, tries: int = 1, lost: int = 0, **more: object) -> None:
    """Add a line to the file that FAULTS_LOG names; without it, nothing is written."""
    if path := os.environ.get("FAULTS_LOG"):
        append_text(Path(path), json.dumps({"table": table, "name": name, "tries": tries, "lost": lost, **more}) + "\n")
