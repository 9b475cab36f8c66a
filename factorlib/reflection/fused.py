"""The reflection networks' values and gradients as C functions, compiled on first use.

The formulas are written once, in torch.  They are run on a `Tape`, which derives their derivatives and writes both as C into kernel.c;
that code can leave the derivatives out.  With t = tanh(net/s) the result is R = formula · exp(fade · s · t).  kernel.c computes the
network and its derivative by the features itself, and its part BACKWARD begins with ∂R/∂formula, ∂R/∂fade and ∂R/∂feature.

Without a C compiler (`cc`, or what CC says) torch computes the same in 6.5 times the time.  `tape` says how this compares with other generators.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from factorlib.errors import InputError
from factorlib.reflection.closed_form import diffuse_of_moments
from factorlib.reflection.features import LARGEST, Layers, diffuse_columns, fading, specular_columns
from factorlib.reflection.filtering import filtered
from factorlib.reflection.lobe import gaussian_sharpness, lobe_moments
from factorlib.reflection.operator import MOST
from factorlib.reflection.tape import Tape
from factorlib.wholefile import sync

log = logging.getLogger("factorlib.reflection")
ENVIRONMENT = ("FACTORLIB_FUSED",)  # "0": in torch, the same up to rounding: which form ran is in the keys of steps
PROGRAMS = {"CC": "cc"}
# Every flag leaves the bits as they are: no operation is contracted, reordered or replaced, errno and traps are nobody's.
FLAGS = "-std=gnu11 -O3 -march=native -ffp-contract=off -ffinite-math-only -fno-signed-zeros -fno-math-errno -fno-trapping-math -fPIC -shared"
MOMENTS = ("sharpness", "lam", "mean", "along", "across")  # of a lobe; all but the first are functions of it
PLACES = {name: f"lobe[{k}][l]" for k, name in enumerate([*MOMENTS, *(f"d{m}" for m in MOMENTS)])}
PLACES |= {name: f"{name}[l]" for name in ("no", "nz", "oz", "net")} | {"alpha": "alpha"}


class Fused:
    """The compiled function with a network's weights."""

    def __init__(self, part: str, layers: Layers):
        self.made_of = part, layers
        self.function = compiled(part, layers.weights[0].shape[1], layers.weights[0].shape[0], len(layers.weights) - 1)
        first = layers.weights[0] * layers.scale
        weights, biases = [first, *layers.weights[1:]], [layers.biases[0] - first @ layers.mean, *layers.biases[1:]]
        tables = weights, biases, [w.T for w in weights[:-1]]
        self.tables = [torch.cat([t.detach().float().reshape(-1) for t in table]).contiguous() for table in tables]

    def __reduce__(self) -> tuple:
        """A copy in another process compiles, or finds in the user's cache, its own."""
        return Fused, self.made_of

    def value(self, roughness: float, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
        """The value alone, in about a third of the time."""
        return self(roughness, sharpness, no, nz, oz, results=1)[0]

    def __call__(self, roughness: float, sharpness: Tensor, *cosines: Tensor, results: int = 6) -> list[Tensor]:
        """Value and derivatives by roughness, log λ, n·o, n·z, o·z; [n, p], float32."""
        no, nz, oz = (t.detach().float().contiguous() for t in cosines)
        out = [torch.empty_like(nz) for _ in range(results)]
        pointers = (ctypes.c_void_p * 6)(*(t.data_ptr() for t in out))  # the rest are null
        lobes = _lobe_table_of(sharpness.detach().double().numpy().tobytes())
        arrays = [t.data_ptr() for t in (lobes, no, nz, oz, *self.tables)]
        self.function(nz.shape[0], nz.shape[1], ctypes.c_float(roughness**2), *map(ctypes.c_void_p, arrays), pointers)
        for by_alpha in out[1:2]:
            by_alpha *= 2 * roughness
        return out


@lru_cache(maxsize=256)  # the same lobes are asked for again for every material
def _lobe_table_of(sharpness: bytes) -> Tensor:
    """MOMENTS and their derivatives by log λ, [10, p], of float64 λ."""
    with torch.enable_grad():
        log_sharpness = torch.from_numpy(np.frombuffer(sharpness).copy()).log().requires_grad_()
        lam = log_sharpness.exp()
        moments = [lam, gaussian_sharpness(lam), *lobe_moments(lam)]
        slopes = [torch.autograd.grad(t.sum(), log_sharpness, retain_graph=True)[0] for t in moments]
    return torch.stack([*(t.detach() for t in moments), *slopes]).float().contiguous()


def recorded(part: str, tape: Tape) -> tuple[Any, tuple]:
    """The formula and the features of `part`, of inputs named as in PLACES."""
    if part == "diffuse":
        inputs = [tape.input(name) for name in ("lam", "mean", "along", "across", "nz")]
        return diffuse_of_moments(*inputs), diffuse_columns(*inputs)
    inputs = [tape.input(name) for name in ("alpha", "sharpness", "lam", "along", "no", "nz", "oz")]
    form, (alpha, *_, no, nz, oz) = filtered(*inputs), inputs
    return form.value, specular_columns(alpha, no, nz, oz, form)


def source(part: str, features: int, width: int, depth: int) -> str:
    """kernel.c with the formulas of `part` written in."""
    tape = Tape()
    formula, columns = recorded(part, tape)
    fade = fading(tape.input("sharpness"))
    forward = tape.c_code({f"feature[{k}][l]": c for k, c in enumerate(columns)} | {"formula[l]": formula}, PLACES)
    t = torch.tanh(tape.input("net") / LARGEST)
    grown = torch.exp(fade * LARGEST * t)
    result = formula * grown
    inside = tape.apply("above", MOST, result)  # beyond, the result is MOST and its derivatives are nil
    by_net = inside * result * fade * (1 - t * t)
    seeds: list[tuple[Any, Any]] = [(formula, inside * grown), (fade, inside * result * LARGEST * t)]
    seeds += [(c, by_net * tape.input(f"slope{k}")) for k, c in enumerate(columns)]
    inputs = [tape.input(name) for name in ("alpha", "no", "nz", "oz", *MOMENTS)]
    by_alpha, by_no, by_nz, by_oz, *by_moments = tape.gradient(seeds, inputs)
    by_log_sharpness = sum(slope * tape.input(f"d{name}") for name, slope in zip(MOMENTS, by_moments, strict=True))
    results = (result.clamp_max(MOST), by_alpha, by_log_sharpness, by_no, by_nz, by_oz)
    places = PLACES | {"formula": "formula[l]"} | {f"slope{k}": f"slope[{k}][l]" for k in range(len(columns))}
    backward = tape.c_code({f"result[{k}][l]": value for k, value in enumerate(results)}, places)
    value = tape.c_code({"result[0][l]": (tape.input("formula") * grown).clamp_max(MOST)}, places)
    text = (Path(__file__).parent / "kernel.c").read_text()
    for place, lines in (("      FORWARD\n", forward), ("        BACKWARD\n", backward), ("        VALUE\n", value)):
        code = "".join(line + "\n" for line in lines)
        for name in ("expf", "logf", "log1pf", "erfcf"):  # kernel.c has its own
            code = code.replace(f"{name}(", f"{name[:-1]}_(")
        text = text.replace(place, code)
    sizes = {"FEATURES": features, "WIDTH": width, "DEPTH": depth, "MOMENTS": len(MOMENTS)}
    return "".join(f"#define {name} {size}\n" for name, size in sizes.items()) + text


@lru_cache(maxsize=8)
def compiled(part: str, features: int, width: int, depth: int) -> Callable:
    """The C function; kept in the user's cache by what it was made of."""
    compiler = shlex.split(os.environ.get("CC", "cc"))
    text = source(part, features, width, depth)
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=True).stdout
    key = hashlib.sha256(f"{text}\0{FLAGS}\0{version}\0{_machine()}".encode()).hexdigest()[:24]
    library = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "factorlib" / f"{part}-{key}.so"
    library.parent.mkdir(parents=True, exist_ok=True)
    if not library.exists():
        with tempfile.TemporaryDirectory(dir=library.parent) as folder:
            made, code = Path(folder) / "kernel.so", Path(folder) / "kernel.c"
            code.write_text(text)
            command = [*compiler, *FLAGS.split(), "-o", str(made), str(code), "-lm"]
            subprocess.run(command, check=True, capture_output=True, text=True)
            sync(made)
            os.replace(made, library)
    function = ctypes.CDLL(str(library)).response
    function.restype = None
    function.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_float, *[ctypes.c_void_p] * 7, ctypes.c_void_p * 6]
    return function


def _machine() -> str:
    """What -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        return platform.machine() + platform.processor()


def fused(part: str, layers: Layers) -> Fused | None:
    """The compiled network, or None, with a message, where there is no compiler; InputError where it fails."""
    if os.environ.get("FACTORLIB_FUSED") == "0" or layers.weights[0].shape[0] % 4 or layers.weights[0].shape[1] % 4:
        return None
    if shutil.which(shlex.split(os.environ.get("CC", "cc"))[0]) is None:
        log.info("no C compiler: the reflection network runs in torch, about ten times slower")
        return None
    try:
        return Fused(part, layers)
    except (OSError, subprocess.SubprocessError) as error:
        # not torch instead: which form runs is in the keys of steps, and nothing there knows that this one failed
        said = " ".join((getattr(error, "stderr", None) or str(error)).split())
        cure = "mend the compiler, name another (CC=gcc), or take torch, about ten times slower: FACTORLIB_FUSED=0"
        raise InputError(
            f"the C code of the reflection network did not compile ({said})", key="CC", cure=cure
        ) from error
