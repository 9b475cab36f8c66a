"""Where a run is shown: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from typing import TextIO

from factorlib.runner.display import Display


def display_for(stream: TextIO | None = None) -> Display:
    """What fits the stream (default: standard error); bars, and what draws them, are loaded for a terminal only."""
    stream = stream or sys.stderr
    if stream.isatty():
        from factorlib.runner.bars import Bars

        return Bars()
    return Display(stream)
