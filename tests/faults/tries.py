"""What a test of faults tried and what was lost by it, for the tables that `make results ONLY=faults` makes of it.

Where FAULTS_LOG names a file, each test adds lines to it, JSON objects; otherwise nothing is written.
"""

import json
import os
from pathlib import Path

from factorlib.wholefile import append_text


def note(table: str, name: str, tries: int = 1, lost: int = 0, **more: object) -> None:
    """One line of a table: what was tried, how often, and how many of the tries lost something."""
    if path := os.environ.get("FAULTS_LOG"):
        append_text(Path(path), json.dumps({"table": table, "name": name, "tries": tries, "lost": lost, **more}) + "\n")
