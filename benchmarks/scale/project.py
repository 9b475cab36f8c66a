"""The pipeline as it is, with a store of its own in build/bench/scale: what is measured is made anew, and no user's result is touched.

`python -m benchmarks.scale.project FOLDER BUILD [setting …]` runs the stages up to `solve` on the data set in FOLDER.
"""

from __future__ import annotations

import sys
from pathlib import Path

from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY, Project, photo_sets


class Measured(Project, frozen=True):
    """The checkout, its results elsewhere."""

    results: Path = Path()

    @property
    def build(self) -> Path:
        """The folder of all results."""
        return self.results


def main(folder: str, build: str, *settings: str) -> int:
    """Run; the exit code."""
    project = Measured(LIBRARY, photo_sets(), results=Path(build))
    return verbs.make(project, verbs.Wish(folder, ["solve"], list(settings)))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
