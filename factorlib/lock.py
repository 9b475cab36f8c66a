"""requirements.lock, derived: what pyproject.toml asks for, and what that needs, at the versions that .venv has (`make lock`).

To move a package: `.venv/bin/python -m pip install -U <name>`, `make test`, `make lock`.
"""

from __future__ import annotations

import sys
import tomllib
from importlib.metadata import distribution, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from factorlib.wholefile import write_text

ROOT = Path(__file__).resolve().parent.parent
HEAD = """\
# Every package of .venv, pinned; installed without looking for more (torch apart, see factorlib/setup.py).
# Derived from pyproject.toml by `make lock`. Of what Open3D asks for, only what its import needs is here, not its notebook widgets.
"""
# What a package asks for and its import, or what is used of it, does not need.
LEFT_OUT = {
    "open3d-cpu": {"flask", "nbformat", "configargparse", "ipywidgets", "matplotlib", "pyquaternion"},
    "python-dateutil": {"tzdata"},  # the system has its own
    "dash": {"flask", "requests", "retrying", "nest-asyncio", "importlib-metadata", "comm"},
}
APART = {"torch"}  # installed before the others, from an index of its own


def pinned(project: dict) -> list[str]:
    """Lines `name==version` of the project's closure, by name; `project`: that table of pyproject.toml.

    Raises PackageNotFoundError for a package that is needed and not installed.
    """
    asked = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    found: dict[str, str] = {}
    waiting = [(Requirement(text), "") for text in asked]
    while waiting:
        requirement, extra = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in found or (requirement.marker and not requirement.marker.evaluate({"extra": extra})):
            continue
        installed = distribution(name)
        found[name] = f"{installed.metadata['Name']}=={installed.version}"
        needed = [Requirement(text) for text in requires(name) or []]
        kept = [each for each in needed if canonicalize_name(each.name) not in LEFT_OUT.get(name, set())]
        waiting += [(each, extra) for each in kept for extra in ("", *requirement.extras)]
    return sorted((line for name, line in found.items() if name not in APART), key=str.lower)


def lock_text() -> str:
    """What requirements.lock should say."""
    return HEAD + "".join(
        f"{line}\n" for line in pinned(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"])
    )


if __name__ == "__main__":
    write_text(ROOT / "requirements.lock", lock_text())
    sys.stdout.write("requirements.lock is written\n")
