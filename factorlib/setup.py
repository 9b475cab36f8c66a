"""Set-up of the environment: .venv with the pinned packages, and the few system libraries they need.

The Makefile runs it as a script, on a Python without packages, so only the standard library may be imported here;
`lock_text` alone imports a package.  uv installs what the lock names, from the indexes that pip is configured for, and
pip where uv is not available.

    python3 -I factorlib/setup.py        (TORCH_INDEX=<url> for another PyTorch, e.g. with CUDA)
    .venv/bin/python -I factorlib/setup.py extras        (EXTRAS="dask blender": extras of pyproject.toml, into .venv)
    .venv/bin/python -I factorlib/setup.py lock          (requirements.lock: the requirements of pyproject.toml, and
                                                         theirs, pinned to the versions in .venv)

To update a package: `.venv/bin/python -m pip install -U <name>`, `make test`, `make lock`.
"""

from __future__ import annotations

import ast
import ctypes
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tomllib
import urllib.request
import venv
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "requirements.lock"
VENV = ROOT / ".venv"
READY = VENV / "ready"
PYTHON = VENV / "bin" / "python"
UV = VENV / "bin" / "uv"
UV_PIN = "uv==0.13.9"
TORCH = "torch==2.13.0"
TORCH_CPU = "https://download.pytorch.org/whl/cpu"  # PyPI's own wheels for Linux require gigabytes of CUDA.
# imported once, in two processes at a time, so that their modules are compiled
LOADED = (
    "torch, xatlas",
    "scipy.optimize, mitsuba, OpenImageIO, pycolmap, pyarrow.parquet, trimesh, factorlib.geometry.open3d",
)
# extras installed without dependencies: .venv has what they need; bpy would require an older NumPy, rembg OpenCV
ALONE = ("blender", "interchange", "masks")
# system libraries of Open3D and, for renders that are three times faster, of Mitsuba; and their Debian packages
NEEDED = {"libGL.so.1": "libgl1", "libX11.so.6": "libx11-6", "libudev.so.1": "libudev1", "libgomp.so.1": "libgomp1"}
FASTER = {"libLLVM.so.19.1": "libllvm19"}
# options of pip's configuration, and the variables by which uv is told the same
UV_VARIABLES = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "constraint": "UV_CONSTRAINT",
    "trusted-host": "UV_INSECURE_HOST",
    "cert": "SSL_CERT_FILE",
    "client-cert": "SSL_CLIENT_CERT",
    "proxy": "ALL_PROXY",
}


def main() -> None:
    """Make .venv for requirements.lock and this Python, unless it exists; a failure ends the program with a cure."""
    state = LOCK.read_bytes() + sys.version.encode() + os.environ.get("TORCH_INDEX", "").encode()
    digest = hashlib.sha256(state).hexdigest()
    if not READY.exists() or READY.read_text() != digest:
        make_venv()
        check_system()
        install_packages()
        print("set-up: loading the packages for the first time", flush=True)
        processes = [subprocess.Popen([PYTHON, "-c", f"import {modules}"], cwd=ROOT) for modules in LOADED]
        if {process.wait() for process in processes} != {0}:
            sys.exit("set-up: the packages are installed, but one does not load (reason above)")
        READY.write_text(digest)
    READY.touch()


def install_extras() -> None:
    """Install the extras of pyproject.toml that the environment variable EXTRAS names.

    Those in ALONE are installed without dependencies.  The others change no locked package.
    """
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for name in os.environ.get("EXTRAS", "").replace(",", " ").split():
        if name not in known:
            sys.exit(f"set-up: there is no extra {name!r} in pyproject.toml; there are {', '.join(known)}")
        install(*(["--no-deps"] if name in ALONE else ["-c", str(LOCK)]), *known[name])


def make_venv() -> None:
    """Create .venv with pip, or replace one of another Python version; an unsupported Python ends the program."""
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if version not in ("3.11", "3.12"):
        cure = "name one: make PYTHON=python3.11 …"
        sys.exit(f"set-up: this is Python {platform.python_version()}; the pinned packages need 3.11 or 3.12: {cure}")
    if find_spec("ensurepip") is None:  # Debian has it in a separate package.
        sys.exit(f"set-up: this Python has no venv; install it: sudo apt-get install python{version}-venv")
    READY.unlink(missing_ok=True)
    is_same_version = (VENV / "lib" / f"python{version}").is_dir()
    venv.create(VENV, clear=not is_same_version, with_pip=True, symlinks=True)


def install_packages() -> None:
    """Install all packages of the lock, which names every one of them, and PyTorch from its index of CPU wheels.

    A PyTorch from another index may need more packages (CUDA), which are installed, too.
    """
    index = os.environ.get("TORCH_INDEX") or (TORCH_CPU if answers(f"{TORCH_CPU}/torch/") else None)
    if subprocess.run([PYTHON, "-m", "pip", "install", "-q", "--retries=1", "--only-binary=uv", UV_PIN]).returncode:
        print(f"set-up: there is no {UV_PIN} here; pip installs the packages, in more time", flush=True)
    install("--no-deps", "-r", str(LOCK))
    install(*(["--no-deps"] if index == TORCH_CPU else ["-c", str(LOCK)]), TORCH, index=index)
    # The path is relative, so that the checkout can be moved.  `import factorlib` then works from anywhere.
    next(VENV.glob("lib/python*/site-packages")).joinpath("factorlib.pth").write_text("../../../..\n")


def install(*words: str, index: str | None = None) -> None:
    """Install by uv, or by pip where uv is missing or fails; a failure of both ends the program.

    Neither compiles what it installs.  `index` takes the place of the configured index.
    """
    print(f"set-up: installing {' '.join(words)}{f' from {index}' if index else ''}", flush=True)
    environment = uv_environment() | ({"UV_DEFAULT_INDEX": index, "PIP_INDEX_URL": index} if index else {})
    by_uv = [str(UV), "pip", "install", "-q", "--python", str(PYTHON), *words]
    by_pip = [str(PYTHON), "-m", "pip", "install", "-q", "--no-compile", *words]
    if all(
        subprocess.run(command, env=environment).returncode for command in (by_uv, by_pip) if Path(command[0]).exists()
    ):
        sys.exit("set-up: the packages could not be installed (reason above); correct that and run make again")


def uv_environment() -> dict[str, str]:
    """Return the environment of uv, with the settings of pip's configuration, which it does not read.

    The best version of all indexes is taken, as pip does.  Variables of uv that are set have precedence.
    """
    listing = subprocess.run([PYTHON, "-m", "pip", "config", "list"], stdout=subprocess.PIPE, text=True)
    configured = {
        UV_VARIABLES[option]: ("," if option == "find-links" else " ").join(ast.literal_eval(value).split())
        for section in ("global", "install", ":env:")  # A later one has precedence.
        for option, value in re.findall(rf"^{section}\.({'|'.join(UV_VARIABLES)})=(.+)$", listing.stdout, re.MULTILINE)
    }
    return {"UV_INDEX_STRATEGY": "unsafe-best-match", **configured, **os.environ}


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
    packages = [package for library, package in (NEEDED | FASTER).items() if not loads(library)]
    if packages and os.geteuid() == 0 and shutil.which("apt-get"):
        install = f"apt-get -qq update; apt-get -qq install -y --no-install-recommends {' '.join(packages)}"
        subprocess.run(["env", "DEBIAN_FRONTEND=noninteractive", "sh", "-c", install])
    if missing := [library for library in NEEDED | FASTER if not loads(library)]:
        command = f"sudo apt-get update && sudo apt-get install -y {' '.join(packages)}"
        print(f"set-up: the system libraries {', '.join(missing)} are missing; install them:\n  {command}", flush=True)
    if any(library in NEEDED for library in missing):
        sys.exit("set-up: without them the packages do not load (elsewhere than on Debian: packages with these files)")


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
