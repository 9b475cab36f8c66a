"""Values and gradients of the reflection networks as C functions, compiled on first use.

The formulas are written once, in torch. A `Tape` records them, differentiates them, and writes values and derivatives
as C into kernel.c; that code can leave the derivatives out. With t = tanh(net/s) the result is
R = formula · exp(fade · s · t). kernel.c itself computes the network and its derivative by the features; its part
BACKWARD begins with ∂R/∂formula, ∂R/∂fade and ∂R/∂feature.

Without a C compiler (`cc`, or the command in CC) torch computes the same in 6.5 times the time. The module `tape`
compares this with other code generators.
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
# "0" runs the networks in torch, with the same values up to rounding; the keys of steps hold this choice
ENVIRONMENT = ("FACTORLIB_FUSED",)
PROGRAMS = {"CC": "cc"}
# No flag changes the bits: no operation is contracted, reordered or replaced, and nobody reads errno or traps.
FLAGS = (
    "-std=gnu11 -O3 -march=native -ffp-contract=off -ffinite-math-only -fno-signed-zeros -fno-math-errno "
    "-fno-trapping-math -fPIC -shared"
)
MOMENTS = ("sharpness", "lam", "mean", "along", "across")  # λ and the moments of a lobe, which are functions of λ
PLACES = {name: f"lobe[{k}][l]" for k, name in enumerate([*MOMENTS, *(f"d{m}" for m in MOMENTS)])}
PLACES |= {name: f"{name}[l]" for name in ("no", "nz", "oz", "net")} | {"alpha": "alpha"}


class Fused:
    """Compiled function of one part (diffuse or specular) with a network's weights."""

    def __init__(self, part: str, layers: Layers):
        self.made_of = part, layers
        self.function = compiled(part, layers.weights[0].shape[1], layers.weights[0].shape[0], len(layers.weights) - 1)
        first = layers.weights[0] * layers.scale
        weights, biases = [first, *layers.weights[1:]], [layers.biases[0] - first @ layers.mean, *layers.biases[1:]]
        tables = weights, biases, [w.T for w in weights[:-1]]
        self.tables = [torch.cat([t.detach().float().reshape(-1) for t in table]).contiguous() for table in tables]

    def __reduce__(self) -> tuple:
        """Return the constructor and its arguments: a copy in another process compiles or loads its own code."""
        return Fused, self.made_of

    def value(self, roughness: float, sharpness: Tensor, no: Tensor, nz: Tensor, oz: Tensor) -> Tensor:
        """Return the value alone, in about a third of the time of value and derivatives.

        Args:
            roughness: Roughness √α of the material.
            sharpness: Sharpness λ of each lobe, [p].
            no: Cosine n·o of each point, [n].
            nz: Cosine n·z, [n, p].
            oz: Cosine o·z, [n, p].

        Returns:
            Reflection of unit lobes, [n, p], float32.
        """
        return self(roughness, sharpness, no, nz, oz, results=1)[0]

    def __call__(self, roughness: float, sharpness: Tensor, *cosines: Tensor, results: int = 6) -> list[Tensor]:
        """Return the value and its derivatives by roughness, log λ, n·o, n·z and o·z; [n, p] each, float32."""
        no, nz, oz = (t.detach().float().contiguous() for t in cosines)
        out = [torch.empty_like(nz) for _ in range(results)]
        pointers = (ctypes.c_void_p * 6)(*(t.data_ptr() for t in out))  # null pointers after the last
        lobes = _lobe_table_of(sharpness.detach().double().numpy().tobytes())
        arrays = [t.data_ptr() for t in (lobes, no, nz, oz, *self.tables)]
        self.function(nz.shape[0], nz.shape[1], ctypes.c_float(roughness**2), *map(ctypes.c_void_p, arrays), pointers)
        for by_alpha in out[1:2]:
            by_alpha *= 2 * roughness
        return out


@lru_cache(maxsize=256)  # every material asks for the same lobes
def _lobe_table_of(sharpness: bytes) -> Tensor:
    """Return the MOMENTS of lobes and their derivatives by log λ, [10, p]; `sharpness` holds λ as float64."""
    with torch.enable_grad():
        log_sharpness = torch.from_numpy(np.frombuffer(sharpness).copy()).log().requires_grad_()
        lam = log_sharpness.exp()
        moments = [lam, gaussian_sharpness(lam), *lobe_moments(lam)]
        slopes = [torch.autograd.grad(t.sum(), log_sharpness, retain_graph=True)[0] for t in moments]
    return torch.stack([*(t.detach() for t in moments), *slopes]).float().contiguous()


def recorded(part: str, tape: Tape) -> tuple[Any, tuple]:
    """Record the formula of `part` on the tape; return its value and the network's features.

    The inputs have the names of PLACES.
    """
    if part == "diffuse":
        inputs = [tape.input(name) for name in ("lam", "mean", "along", "across", "nz")]
        return diffuse_of_moments(*inputs), diffuse_columns(*inputs)
    inputs = [tape.input(name) for name in ("alpha", "sharpness", "lam", "along", "no", "nz", "oz")]
    form, (alpha, *_, no, nz, oz) = filtered(*inputs), inputs
    return form.value, specular_columns(alpha, no, nz, oz, form)


def source(part: str, features: int, width: int, depth: int) -> str:
    """Return the C source of `part`: kernel.c with the recorded formulas written in.

    Args:
        part: "diffuse" or "specular".
        features: Number of the network's inputs.
        width: Number of units of a hidden layer.
        depth: Number of hidden layers.

    Returns:
        The text of one C file.
    """
    tape = Tape()
    formula, columns = recorded(part, tape)
    # features, formula and R = formula · exp(fade · s · tanh(net/s))
    fade = fading(tape.input("sharpness"))
    forward = tape.c_code({f"feature[{k}][l]": c for k, c in enumerate(columns)} | {"formula[l]": formula}, PLACES)
    t = torch.tanh(tape.input("net") / LARGEST)
    grown = torch.exp(fade * LARGEST * t)
    result = formula * grown
    # derivatives of R; the result is clamped to MOST, where its derivatives are zero
    inside = tape.apply("above", MOST, result)
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
    # write the three pieces of code into kernel.c
    text = (Path(__file__).parent / "kernel.c").read_text()
    for place, lines in (("      FORWARD\n", forward), ("        BACKWARD\n", backward), ("        VALUE\n", value)):
        code = "".join(line + "\n" for line in lines)
        for name in ("expf", "logf", "log1pf", "erfcf"):  # kernel.c has functions of its own for these
            code = code.replace(f"{name}(", f"{name[:-1]}_(")
        text = text.replace(place, code)
    sizes = {"FEATURES": features, "WIDTH": width, "DEPTH": depth, "MOMENTS": len(MOMENTS)}
    return "".join(f"#define {name} {size}\n" for name, size in sizes.items()) + text


@lru_cache(maxsize=8)
def compiled(part: str, features: int, width: int, depth: int) -> Callable:
    """Return the C function of `part`, compiled once and kept in the user's cache.

    The library's name holds a hash of source, flags, compiler version and processor.

    Args:
        part: "diffuse" or "specular".
        features: Number of the network's inputs.
        width: Number of units of a hidden layer.
        depth: Number of hidden layers.

    Returns:
        The function `response` of kernel.c.

    Raises:
        OSError: If the compiler cannot be started or the library cannot be loaded.
        subprocess.SubprocessError: If the compiler fails.
    """
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
    """Describe the processor as far as -march=native depends on it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        return platform.machine() + platform.processor()


def fused(part: str, layers: Layers) -> Fused | None:
    """Return the compiled network, or None if FACTORLIB_FUSED=0, if there is no compiler, or if the sizes do not fit.

    Sizes fit if the numbers of features and of units are multiples of 4. A missing compiler is logged.

    Raises:
        InputError: If the compiler fails.
    """
    if os.environ.get("FACTORLIB_FUSED") == "0" or layers.weights[0].shape[0] % 4 or layers.weights[0].shape[1] % 4:
        return None
    if shutil.which(shlex.split(os.environ.get("CC", "cc"))[0]) is None:
        log.info("no C compiler: the reflection network runs in torch, about ten times slower")
        return None
    try:
        return Fused(part, layers)
    except (OSError, subprocess.SubprocessError) as error:
        # no fallback to torch: the keys of steps hold the form that runs, and cannot tell that it failed
        said = " ".join((getattr(error, "stderr", None) or str(error)).split())
        cure = "mend the compiler, name another (CC=gcc), or take torch, about ten times slower: FACTORLIB_FUSED=0"
        raise InputError(
            f"the C code of the reflection network did not compile ({said})", key="CC", cure=cure
        ) from error
