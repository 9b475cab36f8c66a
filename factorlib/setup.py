"""Set-up of the environment: .venv with the pinned packages, and the few system libraries they need.

The Makefile runs it as a script, on a Python without packages, so only the standard library may be imported here;
`lock_text` alone imports a package.

    python3 -I factorlib/setup.py        (TORCH_INDEX=<url> for another PyTorch, e.g. with CUDA)
    .venv/bin/python -I factorlib/setup.py extras        (EXTRAS="dask blender": extras of pyproject.toml, into .venv)
    .venv/bin/python -I factorlib/setup.py lock          (requirements.lock: the requirements of pyproject.toml, and
                                                         theirs, pinned to the versions in .venv)

To update a package: `.venv/bin/python -m pip install -U <name>`, `make test`, `make lock`.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import time
import tomllib
import urllib.request
import venv
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "requirements.lock"
VENV = ROOT / ".venv"
READY = VENV / "ready"
PYTHON = VENV / "bin" / "python"
TORCH = "torch==2.13.0"
TORCH_CPU = "https://download.pytorch.org/whl/cpu"  # PyPI's own wheels for Linux require gigabytes of CUDA.
BEAT = 3.0  # seconds between two progress messages
LOADED = (
    "torch, scipy.optimize, mitsuba, pytest",
    "factorlib.geometry.open3d, OpenImageIO, pycolmap, pyarrow.parquet, trimesh, jinja2, rich.progress",
)
# extras installed without dependencies: .venv has what they need, and bpy would require an older NumPy
ALONE = ("blender", "interchange")
# system libraries of Open3D, and the Debian packages that contain them
NEEDED = {"libGL.so.1": "libgl1", "libX11.so.6": "libx11-6", "libudev.so.1": "libudev1", "libgomp.so.1": "libgomp1"}
FASTER = {"libLLVM.so.19.1": "libllvm19"}  # Mitsuba renders three times faster with it.


def main() -> None:
    """Make .venv for requirements.lock and this Python, unless it exists; a failure ends the program with a cure."""
    state = LOCK.read_bytes() + sys.version.encode() + os.environ.get("TORCH_INDEX", "").encode()
    digest = hashlib.sha256(state).hexdigest()
    if not READY.exists() or READY.read_text() != digest:
        started = time.monotonic()
        make_venv()
        with ThreadPoolExecutor(1) as beside:
            system = beside.submit(check_system)
            install_packages()
        system.result()
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # Only loaded modules are compiled; pip would compile all.
        commands = [[str(PYTHON), "-c", f"import {names}"] for names in LOADED]
        if not run(commands, "loading the packages for the first time"):
            sys.exit("set-up: the packages are installed, but one does not load (reason above)")
        READY.write_text(digest)
        say(f"the environment is ready, after {time.monotonic() - started:.0f} s")
    READY.touch()


def install_extras() -> None:
    """Install EXTRAS of pyproject.toml.

    Those in ALONE are installed without dependencies.  The others change no locked package.
    """
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    names = os.environ.get("EXTRAS", "").replace(",", " ").split()
    if unknown := [name for name in names if name not in known]:
        sys.exit(f"set-up: there is no extra {unknown[0]!r} in pyproject.toml; there are {', '.join(known)}")
    for options, alone in ((["--no-deps"], True), (["-c", str(LOCK)], False)):
        if packages := [package for name in names if (name in ALONE) == alone for package in known[name]]:
            exit_unless(run([with_pip([*options, *packages])], f"installing {', '.join(packages)}"))


def say(text: str) -> None:
    """Print a line with the prefix of set-up."""
    print(f"set-up: {text}", flush=True)


def exit_unless(success: bool) -> None:
    """End the program if an installation failed; the installer has printed the reason."""
    if not success:
        sys.exit("set-up: the packages could not be installed (reason above); correct that and run make again")


def make_venv() -> None:
    """Create .venv with pip, or replace one of another Python version; an unsupported Python ends the program."""
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if version not in ("3.11", "3.12"):
        cure = "name one: make PYTHON=python3.11 …"
        sys.exit(f"set-up: this is Python {platform.python_version()}; the pinned packages need 3.11 or 3.12: {cure}")
    if find_spec("ensurepip") is None:  # Debian has it in a separate package.
        sys.exit(f"set-up: this Python has no venv; install it: sudo apt-get install python{version}-venv")
    READY.unlink(missing_ok=True)
    if not PYTHON.exists() or not (VENV / "lib" / f"python{version}").is_dir():
        say(f"making .venv with Python {platform.python_version()}")
        shutil.rmtree(VENV, ignore_errors=True)
        venv.create(VENV, with_pip=True, symlinks=True)


def install_packages() -> None:
    """Install all packages of the lock without resolving dependencies, by uv or else by pip.

    A PyTorch from another index than that of CPU wheels may need more (CUDA), which is installed afterwards.
    """
    index = os.environ.get("TORCH_INDEX") or (TORCH_CPU if answers(f"{TORCH_CPU}/torch/") else None)
    torch = [TORCH, *(["--index-url", index] if index else [])]
    locked = ["--no-deps", "-r", str(LOCK)]
    pinned = ["--no-deps", *torch]
    say(words := f"installing about 400 MB of packages; PyTorch from {index or 'the default package index'}")
    uv = shutil.which("uv") or (run([with_pip(["--no-deps", "uv"])], "installing uv") and str(VENV / "bin" / "uv"))
    with_uv = [str(uv), "pip", "install", "-q", "--python", str(PYTHON)]
    # Without an index, pip installs PyTorch, because it knows the user's own wheels.
    by_uv = [[*with_uv, *locked], [*with_uv, *pinned] if index else with_pip(pinned)]
    if not uv or not run(by_uv, words):
        exit_unless(run([with_pip(locked), with_pip(pinned)], words))
    if index != TORCH_CPU:
        exit_unless(run([with_pip(["-c", str(LOCK), *torch])], "installing what PyTorch needs"))
    # The path is relative, so that the checkout can be moved.  `import factorlib` then works from anywhere.
    site_packages().joinpath("factorlib.pth").write_text("../../../..\n")


def with_pip(words: list[str]) -> list[str]:
    """Return pip's install command, which prints only errors and compiles nothing."""
    return [str(PYTHON), "-m", "pip", "install", "--no-compile", "-qq", "--disable-pip-version-check", *words]


def run(commands: list[list[str]], words: str) -> bool:
    """Run the commands in parallel with progress messages, and return True if all succeed.

    `words` describes them.  Errors are printed as they occur.
    """
    running = [subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) for command in commands]
    started = reported = time.monotonic()
    while any(process.poll() is None for process in running):
        time.sleep(0.1)
        if (now := time.monotonic()) - reported >= BEAT:
            reported = now
            count = sum(1 for _ in site_packages().glob("*.dist-info"))
            say(f"{words}: {now - started:.0f} s, {count} packages are installed")
    return not any(process.returncode for process in running)


def site_packages() -> Path:
    """Return the folder in which .venv keeps packages."""
    return next(VENV.glob("lib/python*/site-packages"))


def answers(url: str) -> bool:
    """Return True if a HEAD request to `url` succeeds within five seconds."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=5) as reply:
            return reply.status == 200
    except (OSError, ValueError):
        return False


def check_system() -> None:
    """Install missing system libraries if permitted (root, apt); otherwise print the command that does.

    A missing library of NEEDED ends the program.  One of FASTER is only recommended.
    """
    apt = shutil.which("apt-get")
    for libraries, gain in ((NEEDED, ""), (FASTER, "renders are three times faster with it")):
        missing = [name for name in libraries if not loads(name)]
        packages = " ".join(libraries[name] for name in missing)
        if missing and os.geteuid() == 0 and apt:
            say(f"installing {packages}{f': {gain}' if gain else ''}")
            quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
            for words in ("update", f"install -y --no-install-recommends {packages}"):
                apt_get = ["apt-get", "-qq", *words.split()]
                subprocess.run(apt_get, env=quiet, check=False, stdout=subprocess.DEVNULL)
            missing = [name for name in missing if not loads(name)]
        command = f"sudo apt-get update && sudo apt-get install -y {packages}   (elsewhere: packages with these files)"
        if missing and gain:
            say(f"{', '.join(missing)} is missing, and {gain}; to install it:\n  {command}")
        elif missing:
            sys.exit(f"set-up: the system libraries {', '.join(missing)} are missing; install them:\n  {command}")


def loads(library: str) -> bool:
    """Return True if the dynamic linker finds and loads a shared library; always True except on Linux."""
    try:
        return sys.platform != "linux" or bool(ctypes.CDLL(library))
    except OSError:
        return False


# ── requirements.lock ────────────────────────────────────────────────────────────────────────────────────────────────

HEAD = """\
# Every package of .venv, pinned; installed without looking for more (torch apart, see factorlib/setup.py).
# Derived from pyproject.toml by `make lock`. Of what Open3D asks for, only what its compiled module needs is here \
(factorlib/geometry/open3d.py).
"""
# Requirements of a package that the parts in use do not need.
NOT_NEEDED = {
    "open3d-cpu": {
        *("addict", "configargparse", "dash", "flask", "ipywidgets", "matplotlib"),
        *("nbformat", "pandas", "pyquaternion", "scikit-learn", "werkzeug"),
    },
}


def lock_text() -> str:
    """Return the text of requirements.lock.

    Raises:
        PackageNotFoundError: A required package is not installed.
    """
    from importlib.metadata import distribution, requires

    from packaging.requirements import Requirement  # installed by set-up
    from packaging.utils import canonicalize_name

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
        needed = [each for each in needed if canonicalize_name(each.name) not in NOT_NEEDED.get(name, ())]
        waiting += [(each, extra) for each in needed for extra in ("", *requirement.extras)]
    del lines["torch"]  # installed separately, from its own index
    return HEAD + "".join(sorted(lines.values(), key=str.lower))


if __name__ == "__main__":
    if sys.argv[1:] == ["extras"]:
        install_extras()
    elif sys.argv[1:] == ["lock"]:
        LOCK.write_text(lock_text())
        print("requirements.lock is written")
    else:
        main()
