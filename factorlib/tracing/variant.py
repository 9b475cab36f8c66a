"""Selection of the variant of Mitsuba for this machine: `llvm_ad_rgb` if LLVM works, else `scalar_rgb`.

Mitsuba's LLVM variants abort the whole process with LLVM 14 or 15. So a variant is first tried in a process of its own,
with each LLVM library of this machine; libraries that abort are skipped.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

LIBRARY = "DRJIT_LIBLLVM_PATH"  # variable with the path of LLVM for Dr.Jit, Mitsuba's compiler
FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/lib/llvm-*/lib")
PROBE_SECONDS = 60
PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": 3}, "light": {"type": "constant"},
                      "ball": {"type": "sphere", "center": [0, 0, 5], \
"bsdf": {"type": "roughconductor", "material": "none"}},
                      "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}})
import numpy as np
assert np.array(mi.render(scene, spp=1)).sum() > 0
"""
log = logging.getLogger("factorlib.tracing")


@cache
def mitsuba(variant: str | None = None) -> ModuleType:
    """Return the `mitsuba` module with a variant set: the given one, or the fastest that runs here."""
    variant = variant or os.environ.get("FACTORLIB_MITSUBA") or _fastest()
    import mitsuba as module

    module.set_variant(variant)
    module.set_log_level(module.LogLevel.Error)  # Mitsuba's PLY reader warns of our face labels
    return module


def _fastest() -> str:
    """Return the fastest variant that runs here, and set the path of its LLVM library."""
    libraries = {path.resolve() for folder in FOLDERS for path in Path("/").glob(f"{folder[1:]}/libLLVM*.so*")}
    newest_first = [str(path) for path in sorted(libraries, key=_version, reverse=True) if _version(path) >= 16]
    for library in [os.environ.get(LIBRARY), *newest_first]:
        if library and _runs(library):
            os.environ[LIBRARY] = library
            return "llvm_ad_rgb"
    needed = "no LLVM that Mitsuba can use is installed (16 or later; Debian: libllvm19)"
    log.warning("%s: rendering with scalar_rgb, about 3 times slower", needed)
    return "scalar_rgb"


def _version(library: Path) -> int:
    """Return the major version in names such as libLLVM.so.19.1 and libLLVM-14.0.6.so.1; 0 if there is none."""
    digits = library.name.removeprefix("libLLVM").replace("-", ".").replace("so", "").strip(".").split(".")
    return int(digits[0]) if digits[0].isdigit() else 0


def _runs(library: str) -> bool:
    """Return whether the LLVM variant renders a small scene with this library."""
    command = [sys.executable, "-c", PROBE]
    variables = {**os.environ, LIBRARY: library}
    try:
        return subprocess.run(command, env=variables, capture_output=True, timeout=PROBE_SECONDS).returncode == 0
    except subprocess.TimeoutExpired:
        return False
