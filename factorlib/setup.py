"""The environment: .venv with the pinned packages, and the few system libraries they need.

Run by the Makefile as a script, on a Python without packages: nothing but the standard library may be imported here.

    python3 -I factorlib/setup.py        (TORCH_INDEX=<url> for a PyTorch of one's own choice, e.g. with CUDA)
    .venv/bin/python -I factorlib/setup.py extras        (EXTRAS="dask blender": extras of pyproject.toml, into .venv)
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tomllib
import urllib.request
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "requirements.lock"
VENV = ROOT / ".venv"
READY = VENV / "ready"
TORCH = "torch==2.13.0"
TORCH_CPU = "https://download.pytorch.org/whl/cpu"  # PyPI's own wheels for Linux draw in gigabytes of CUDA
PROBE_SECONDS = 5
ALONE = ("blender", "interchange")  # extras: .venv has what they need, and bpy would ask for an older NumPy
LIBRARIES = {"libGL.so.1": "libgl1", "libX11.so.6": "libx11-6", "libudev.so.1": "libudev1", "libgomp.so.1": "libgomp1"}  # of Open3D


def main() -> None:
    """Make .venv for requirements.lock and this Python, unless it is there already.  Ends the program, with a cure, where it cannot."""
    state = hashlib.sha256(LOCK.read_bytes() + sys.version.encode() + os.environ.get("TORCH_INDEX", "").encode()).hexdigest()
    if READY.exists() and READY.read_text() == state:
        READY.touch()
        return
    check_system()
    make_venv()
    install_torch()  # first, with what it needs: the others are installed as they stand in the lock
    say("installing the pinned packages (about 400 MB, some minutes)")
    pip("install", "--no-deps", "-r", str(LOCK))
    # relative, so that the checkout can be moved; `import factorlib` then works from anywhere, notebooks too
    next(VENV.glob("lib/python*/site-packages")).joinpath("factorlib.pth").write_text("../../../..\n")
    subprocess.run([VENV / "bin" / "python", "-c", "import open3d, torch, mitsuba, OpenImageIO, pycolmap"], check=True, cwd="/")
    READY.write_text(state)
    say("the environment is ready")


def install_extras() -> None:
    """EXTRAS of pyproject.toml: those that are ALONE without what they ask for, the others with it, but no package of the lock moves."""
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    asked = os.environ.get("EXTRAS", "").replace(",", " ").split()
    if unknown := [name for name in asked if name not in known]:
        sys.exit(f"set-up: there is no extra {unknown[0]!r} in pyproject.toml; there are {', '.join(known)}")
    for how, names in ((["--no-deps"], [name for name in asked if name in ALONE]), (["-c", str(LOCK)], [name for name in asked if name not in ALONE])):
        if names:
            pip("install", *how, *(package for name in names for package in known[name]))


def say(text: str) -> None:
    """Print a line, marked as set-up's."""
    print(f"set-up: {text}", flush=True)


# ── Python ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def make_venv() -> None:
    """Create .venv with pip; one of another Python version is replaced."""
    READY.unlink(missing_ok=True)
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if (VENV / "bin" / "python").exists() and (VENV / "lib" / f"python{version}").is_dir():
        return
    say(f"making .venv with Python {platform.python_version()}")
    try:
        import ensurepip  # noqa: F401  (Debian keeps it in a package of its own)
    except ImportError:
        sys.exit(f"set-up: this Python has no venv; install it: {'' if os.geteuid() == 0 else 'sudo '}apt-get install python{version}-venv")
    shutil.rmtree(VENV, ignore_errors=True)
    venv.create(VENV, with_pip=True, symlinks=True)


def pip(*words: str) -> None:
    """Each package is named as it comes; a failed installation ends set-up with pip's own words."""
    command = [str(VENV / "bin" / "python"), "-m", "pip", *words, "--disable-pip-version-check", "--progress-bar", "off"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        names = (line.split()[1] for line in process.stdout if line.startswith(("Collecting ", "Installing ")))
        for count, name in enumerate(names, start=1):
            show_life(f"{count:3} {'installing' if name == 'collected' else name}")
    show_life("")
    if process.returncode:
        sys.exit("set-up: pip could not install the packages: see above; run make again when that is mended")


def show_life(text: str) -> None:
    """On a terminal one line that is written over, elsewhere a line each."""
    if sys.stdout.isatty():
        print(f"\r\033[K{'set-up: ' + text if text else ''}", end="", flush=True)
    elif text:
        say(text)


def install_torch() -> None:
    """TORCH_INDEX, if it is set; else PyTorch's own index of CPU wheels, if it answers; else the default index."""
    index = os.environ.get("TORCH_INDEX") or (TORCH_CPU if answers(f"{TORCH_CPU}/torch/") else None)
    say(f"installing PyTorch from {index or 'the default package index'}")
    pip("install", "-c", str(LOCK), TORCH, *(["--index-url", index] if index else []))


def answers(url: str) -> bool:
    """Whether a HEAD request to `url` succeeds within PROBE_SECONDS."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=PROBE_SECONDS) as reply:
            return reply.status == 200
    except (OSError, ValueError):
        return False


# ── system libraries ─────────────────────────────────────────────────────────────────────────────────────────────────


def check_system() -> None:
    """Found: silent.  Missing and root on Debian or Ubuntu: installed.  Otherwise one message with the command."""
    if sys.version_info[:2] not in ((3, 11), (3, 12)):
        sys.exit(f"set-up: Python {platform.python_version()} will not do, the pinned packages need 3.11 or 3.12: make PYTHON=python3.11 …")
    missing = missing_libraries()
    if not missing:
        return
    packages = [LIBRARIES[name] for name in missing]
    if os.geteuid() == 0 and shutil.which("apt-get"):
        say(f"installing {' '.join(packages)}")
        quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        for command in (["apt-get", "update", "-qq"], ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *packages]):
            subprocess.run(command, env=quiet, check=False, stdout=subprocess.DEVNULL)
        missing = missing_libraries()
    if missing:
        sys.exit(f"set-up: the system libraries {', '.join(missing)} are missing; install them:\n  {command_for(missing)}")


def missing_libraries() -> list[str]:
    """Names of system libraries that this Linux lacks; nothing elsewhere."""
    return [name for name in LIBRARIES if not loads(name)] if sys.platform == "linux" else []


def loads(library: str) -> bool:
    """Whether the dynamic linker finds and loads a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def command_for(missing: list[str]) -> str:
    """The command that installs the missing libraries on this system, to be shown to the user."""
    if shutil.which("apt-get"):
        return f"sudo apt-get update && sudo apt-get install -y {' '.join(LIBRARIES[name] for name in missing)}"
    if shutil.which("dnf"):
        return f"sudo dnf install {' '.join(f'{chr(39)}{name}()(64bit){chr(39)}' for name in missing)}"
    return "(the packages of your system that hold these files)"


if __name__ == "__main__":
    install_extras() if sys.argv[1:] == ["extras"] else main()
