"""Derivation of requirements.lock: the requirements of pyproject.toml, and theirs, pinned to the versions in .venv.

`make lock` writes it.  To update a package: `.venv/bin/python -m pip install -U <name>`, `make test`, `make lock`.
"""

from __future__ import annotations

import tomllib
from importlib.metadata import distribution, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from factorlib.wholefile import write_text

ROOT = Path(__file__).resolve().parent.parent
HEAD = """\
# Every package of .venv, pinned; installed without looking for more (torch apart, see factorlib/setup.py).
# Derived from pyproject.toml by `make lock`. Of what Open3D asks for, only what its compiled module needs is here \
(factorlib/geometry/open3d.py).
"""
# Requirements of a package that the parts in use do not need.
LEFT_OUT = {
    "open3d-cpu": {
        *(
            "addict",
            "configargparse",
            "dash",
            "flask",
            "ipywidgets",
            "matplotlib",
            "nbformat",
            "pandas",
            "pyquaternion",
        ),
        *("scikit-learn", "werkzeug"),
    },
}


def lock_text() -> str:
    """Return the text of requirements.lock.

    Raises:
        PackageNotFoundError: A required package is not installed.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    waiting = [(Requirement(text), "") for text in project["dependencies"] + project["optional-dependencies"]["dev"]]
    lines: dict[str, str] = {}
    while waiting:
        requirement, extra = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in lines or (requirement.marker and not requirement.marker.evaluate({"extra": extra})):
            continue
        lines[name] = f"{distribution(name).metadata['Name']}=={distribution(name).version}\n"
        needed = [Requirement(text) for text in requires(name) or []]
        needed = [each for each in needed if canonicalize_name(each.name) not in LEFT_OUT.get(name, ())]
        waiting += [(each, extra) for each in needed for extra in ("", *requirement.extras)]
    del lines["torch"]  # installed separately, from its own index
    return HEAD + "".join(sorted(lines.values(), key=str.lower))


if __name__ == "__main__":
    write_text(ROOT / "requirements.lock", lock_text())
    print("requirements.lock is written")
