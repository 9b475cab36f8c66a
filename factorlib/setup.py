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
import queue
import re
import shutil
import subprocess
import sys
import threading
import time
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
PARTS = 3  # installations at once, PyTorch alone in one of them
BEAT = 3.0  # seconds between two signs of life
LOADED = ("torch, scipy.optimize, mitsuba, pytest", "open3d, OpenImageIO, pycolmap, pyarrow.parquet, trimesh, jinja2, rich.progress, typer")
ALONE = ("blender", "interchange")  # extras: .venv has what they need, and bpy would ask for an older NumPy
LIBRARIES = {"libGL.so.1": "libgl1", "libX11.so.6": "libx11-6", "libudev.so.1": "libudev1", "libgomp.so.1": "libgomp1"}  # of Open3D


def main() -> None:
    """Make .venv for requirements.lock and this Python, unless it is there already.  Ends the program, with a cure, where it cannot."""
    state = hashlib.sha256(LOCK.read_bytes() + sys.version.encode() + os.environ.get("TORCH_INDEX", "").encode()).hexdigest()
    if READY.exists() and READY.read_text() == state:
        READY.touch()
        return
    seconds: dict[str, float] = {}
    for phase, step in (("system libraries", check_system), (".venv", make_venv), ("packages", install_packages), ("check", check_packages)):
        started = time.monotonic()
        step()
        seconds[phase] = time.monotonic() - started
    READY.write_text(state)
    said = ", ".join(f"{phase} {took:.0f} s" for phase, took in seconds.items() if took >= 0.5)
    say(f"the environment is ready, after {sum(seconds.values()):.0f} s ({said})")


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


def install_packages() -> None:
    """Everything that the lock names, without asking what it needs: the lock answers that.  Several installations run at once.

    A PyTorch that is not of its index of CPU wheels may need more (CUDA): that is asked for afterwards.
    """
    index = torch_index()
    locked = [line.strip() for line in LOCK.read_text().splitlines() if line.strip() and not line.startswith("#")]
    say(f"installing {len(locked) + 1} packages (about 400 MB); PyTorch from {index or 'the default package index'}")
    torch = [TORCH, *(["--index-url", index] if index else [])]
    of_torch = (with_uv if shutil.which("uv") and index else with_pip)(["--no-deps", *torch])  # pip alone knows a user's own wheels
    if not (shutil.which("uv") and install([of_torch, with_uv(["--no-deps", *locked])], len(locked) + 1)):
        parts = [["--no-deps", *torch], *(["--no-deps", *locked[k :: PARTS - 1]] for k in range(PARTS - 1))]
        ended(install([with_pip(part) for part in parts], len(locked) + 1))
    if index != TORCH_CPU:
        ended(install([with_pip(["-c", str(LOCK), *torch])]))
    # relative, so that the checkout can be moved; `import factorlib` then works from anywhere, notebooks too
    site_packages().joinpath("factorlib.pth").write_text("../../../..\n")


def check_packages() -> None:
    """Load what the project loads: Python keeps them compiled, which pip would do for many times as much that is never used."""
    say("loading the packages for the first time")
    quiet = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    python = [str(VENV / "bin" / "python"), "-c"]
    running = [subprocess.Popen([*python, f"import {names}"], cwd="/", env=quiet) for names in LOADED]
    while any(process.poll() is None for process in running):
        show_life("loading the packages for the first time")
        time.sleep(0.1)
    if any(process.returncode for process in running):
        sys.exit("set-up: the packages are installed, but one does not load: see above")


def pip(*words: str) -> None:
    """One command of pip; a failed installation ends set-up with pip's own words."""
    verb, *rest = words
    ended(install([with_pip(rest, verb)]))


def ended(well: bool) -> None:
    """Stop where an installation failed; it has said why."""
    if not well:
        sys.exit("set-up: the packages could not be installed: see above; run make again when that is mended")


def with_pip(words: list[str], verb: str = "install") -> list[str]:
    """pip's command.  It compiles nothing: that takes longer than all the rest, and most of it is never loaded."""
    quiet = ["--disable-pip-version-check", "--progress-bar", "off"]
    return [str(VENV / "bin" / "python"), "-m", "pip", verb, *(["--no-compile"] if verb == "install" else []), *words, *quiet]


def with_uv(words: list[str]) -> list[str]:
    """The same for uv, where the user has it."""
    return ["uv", "pip", "install", "-q", "--python", str(VENV / "bin" / "python"), *words]


def install(commands: list[list[str]], total: int = 0) -> bool:
    """Run the commands, all at once, and show that they live; whether all went well.

    What they warn of is shown once for each kind, errors as they come.  total: of packages, 0 where that is not known
    """
    lines: queue.Queue[str | None] = queue.Queue()
    running = [_started(command, lines) for command in commands]
    open_, warned, started, before = len(running), Warnings(), time.monotonic(), _installed()
    while open_:
        try:
            line = lines.get(timeout=0.2)
        except queue.Empty:
            line = ""
        open_ -= line is None
        warned.hear(line or "")
        there = f"{_installed() - before} of {total} packages installed" if total else "installing"
        show_life(f"{there}, {time.monotonic() - started:.0f} s")
    show_life("", always=True)
    warned.close()
    return not any(process.wait() for process in running)


def _installed() -> int:
    return sum(1 for _ in site_packages().glob("*.dist-info"))


def _started(command: list[str], lines: queue.Queue) -> subprocess.Popen:
    """A process whose lines go into a queue, None when it has no more; of standard output only what is an error."""
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace")

    def read() -> None:
        """Until it ends."""
        for line in process.stderr:
            lines.put(line.rstrip())
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    return process


class Warnings:
    """What a package client says on standard error: a warning once for each kind, which is its text without names and numbers."""

    def __init__(self) -> None:
        self.kinds: dict[str, int] = {}

    def hear(self, line: str) -> None:
        """Show a line, unless it is a warning of a known kind."""
        kind = re.sub(r"'[^']*'|\"[^\"]*\"|\w+://\S+|\d+", "…", line)
        if line.lower().startswith("warning"):
            self.kinds[kind] = self.kinds.get(kind, 0) + 1
        if line and self.kinds.get(kind, 0) < 2:
            show_life("", always=True)
            print(line, file=sys.stderr, flush=True)

    def close(self) -> None:
        """How many were left out."""
        if more := sum(self.kinds.values()) - len(self.kinds):
            say(f"{more} more {'warning' if more == 1 else 'warnings'} of the same {'kind' if len(self.kinds) == 1 else 'kinds'} left out")


_shown = 0.0  # when a sign of life was shown last


def show_life(text: str, always: bool = False) -> None:
    """On a terminal one line that is written over, elsewhere a line every BEAT seconds."""
    global _shown
    now = time.monotonic()
    if sys.stdout.isatty():
        print(f"\r\033[K{'set-up: ' + text if text else ''}", end="", flush=True)
    elif text and (always or now - _shown >= BEAT):
        _shown = now
        say(text)


def site_packages() -> Path:
    """Where .venv keeps packages."""
    return next(VENV.glob("lib/python*/site-packages"))


def torch_index() -> str | None:
    """TORCH_INDEX, if it is set; else PyTorch's own index of CPU wheels, if it answers; else None, for the default index."""
    return os.environ.get("TORCH_INDEX") or (TORCH_CPU if answers(f"{TORCH_CPU}/torch/") else None)


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
