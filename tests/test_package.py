"""A Python package like any other: what it imports is declared, the lock follows from that, a wheel of it works by itself."""

import ast
import os
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from factorlib.setup import lock_text

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OURS = {"factorlib", "stages", "tests", "studies"}
PACKED = ["factorlib", "stages", "recipes", "pipeline.yaml", "pyproject.toml", "README.md", "LICENSE"]


# What runs on a cluster alone: loaded where one is asked for, and then the extra `dask` is there or missed by name.
EXTRAS = {  # of modules that import what an extra alone installs
    ROOT / "factorlib" / f"{module}.py": extra
    for module, extra in (
        ("runner/worker", "dask"),
        ("onboarding/matte", "masks"),
    )
}


@pytest.mark.parametrize("folder", ["factorlib", "stages"])
def test_every_import_is_a_dependency_that_is_declared(folder):
    of = {module: {canonicalize_name(name) for name in result} for module, result in packages_distributions().items()}
    for file in sorted((ROOT / folder).rglob("*.py")):
        extra = PROJECT["optional-dependencies"][EXTRAS[file]] if file in EXTRAS else ["packaging"]
        declared = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"] + extra}
        result = set()
        for node in ast.walk(ast.parse(file.read_text())):
            result |= {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
            result |= {node.module} if isinstance(node, ast.ImportFrom) and node.module and not node.level else set()
        modules = {name.split(".")[0] for name in result} - OURS - sys.stdlib_module_names
        missing = {each for each in modules if not ({canonicalize_name(each)} | of.get(each, set())) & declared}
        assert not missing, file


def test_the_lock_is_what_pyproject_asks_for():
    assert (ROOT / "requirements.lock").read_text() == lock_text(), "make lock"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A wheel of the package, without what it needs, installed into a folder."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    source = folder / "source"
    files = subprocess.run(["git", "ls-files", "--", *PACKED], cwd=ROOT, check=True, capture_output=True)
    for name in files.stdout.decode().splitlines():
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(folder), str(source)], check=True)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel)], check=True)
    return folder / "site"


def run(site, *words, cwd):
    environment = {**os.environ, "PYTHONPATH": str(site), "FACTORLIB_ROOT": ""}
    return subprocess.run([sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True)


def test_an_installed_wheel_has_its_operator(installed, tmp_path):
    code = "import factorlib; from factorlib.reflection import reflection_operator; print(factorlib.__file__, reflection_operator('network'))"
    process = run(installed, "-c", code, cwd=tmp_path)
    assert process.returncode == 0 and process.stdout.startswith(str(installed)), process.stderr


def test_an_installed_command_in_a_checkout_takes_its_pipeline(installed):
    process = run(installed, str(installed / "bin" / "factorlib"), "params", cwd=ROOT / "data")
    assert process.returncode == 0 and "solve" in process.stdout
