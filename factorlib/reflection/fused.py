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
import math
import operator
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
from factorlib.wholefile import sync

# Derivatives and C code of an elementwise function that is written in torch.
#
# The function runs once with a `Value` in place of each tensor. A `Tape` records its operations, equal ones only once.
# `Tape.gradient` goes backward over the tape and records the derivatives in the same way (reverse mode). `Tape.c_code`
# writes the operations that given results need as C statements on floats, one a line.
#
# No existing generator does the same. SymPy differentiates without sharing (it had not finished the specular part after
# 60 s, which takes 0.04 s here). CasADi does not accept torch functions. Enzyme needs every user to have Clang.
# torch.compile chooses the order of operations itself; that order is fixed here so that every processor gives the same
# bits.

# C expression of each operation; {0} and {1} are its arguments
C = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "sqrt": "sqrtf({0})",
    "exp": "expf({0})",
    "log": "logf({0})",
    "log1p": "log1pf({0})",
    "max": "max_({0}, {1})",
    "min": "min_({0}, {1})",
    "above": "({0} > {1} ? 1.0f : 0.0f)",
    "erfc": "erfcf({0})",
}
ARITHMETIC = {"add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv}


class Tape:
    """Operations in the order they were first needed.

    Operation k is `ops[k]` = (name, arguments); an argument is the index of another operation or a float.
    """

    def __init__(self) -> None:
        self.ops: list[tuple[str, tuple]] = []
        self.known: dict[tuple, int] = {}

    def input(self, name: str) -> Any:
        """Return the input `name`, a `Value` that stands for a tensor; the tape holds it once."""
        return self._record("input", (name,))

    def apply(self, name: str, *arguments: Value | float) -> Value | float:
        """Record operation `name` of C on values or numbers; return a number if all arguments are numbers."""
        given: tuple[Any, ...] = tuple(a.index if isinstance(a, Value) else float(a) for a in arguments)
        a, b = given if len(given) == 2 else (*given, None)
        # fold constants and drop operations with a neutral element; an int is an index and not a number
        numbers = [v if isinstance(v, float) else None for v in (a, b)]
        if None not in numbers and name in ARITHMETIC:
            return ARITHMETIC[name](a, b)
        if name == "mul" and 0.0 in numbers:
            return 0.0
        if numbers[1] is not None and numbers[1] == {"add": 0.0, "sub": 0.0, "mul": 1.0, "div": 1.0}.get(name):
            return Value(self, a)
        if numbers[0] is not None and numbers[0] == {"add": 0.0, "mul": 1.0}.get(name):
            return Value(self, b)
        return self._record(name, given)

    def _record(self, name: str, arguments: tuple) -> Value:
        """Append an operation unless an equal one is on the tape, and return its value."""
        key = name, tuple((type(a), a) for a in arguments)
        if key not in self.known:
            self.known[key] = len(self.ops)
            self.ops.append((name, arguments))
        return Value(self, self.known[key])

    def gradient(self, results: list[tuple[Value, Value | float]], inputs: list[Value]) -> list[Value | float]:
        """Return Σ seed · ∂result/∂input over all pairs (result, seed), for each input."""
        slope: dict[int, Value | float] = {}
        for result, seed in results:
            slope[result.index] = slope.get(result.index, 0.0) + seed
        for index in range(len(self.ops) - 1, -1, -1):
            name, arguments = self.ops[index]
            if index in slope and name != "input":
                for argument, part in zip(arguments, self._slopes(name, arguments, Value(self, index)), strict=True):
                    if not isinstance(argument, float) and part is not None:
                        slope[argument] = slope.get(argument, 0.0) + slope[index] * part
        return [slope.get(v.index, 0.0) for v in inputs]

    def _slopes(self, name: str, arguments: tuple, y: Value) -> tuple:
        """Return the derivative of the value `y` of operation `name` by each of its arguments; None stands for zero."""
        operands: list[Any] = [*(v if isinstance(v, float) else Value(self, v) for v in arguments), None]
        a, b = operands[:2]
        if name in ("max", "min"):
            second = self.apply("above", b, a) if name == "max" else self.apply("above", a, b)
            return 1.0 - second, second  # at a tie the first argument takes the derivative, as in torch's clamp
        if name == "above":
            return None, None
        return {
            "add": lambda: (1.0, 1.0),
            "sub": lambda: (1.0, -1.0),
            "mul": lambda: (b, a),
            "div": lambda: (1.0 / b, -y / b),
            "sqrt": lambda: (0.5 / y,),
            "exp": lambda: (y,),
            "erfc": lambda: (self.apply("exp", -(a * a)) * (-2 / math.sqrt(math.pi)),),
            "log": lambda: (1.0 / a,),
            "log1p": lambda: (1.0 / (1.0 + a),),
        }[name]()

    def c_code(self, results: dict[str, Value | float], inputs: dict[str, str]) -> list[str]:
        """Return the C statements that compute `results`.

        `results` maps C lvalues to values, `inputs` maps names of inputs to C expressions.
        """
        # all operations that the results depend on
        needed, todo = set(), [v.index for v in results.values() if isinstance(v, Value)]
        while todo:
            if (index := todo.pop()) not in needed:
                needed.add(index)
                todo += [a for a in self.ops[index][1] if isinstance(a, int)]
        lines = []
        for index in sorted(needed):
            name, arguments = self.ops[index]
            right = inputs[arguments[0]] if name == "input" else C[name].format(*map(_c, arguments))
            lines.append(f"const float v{index} = {right};")
        return lines + [f"{target} = {_c(v.index if isinstance(v, Value) else v)};" for target, v in results.items()]


def _c(argument: int | float) -> str:
    """Format an argument as C: a variable for an operation, a literal for a number."""
    return f"v{argument}" if isinstance(argument, int) else f"{argument!r}f"


def _op(name: str, swap: bool = False) -> Callable[[Any, Any], Any]:
    """Return a method of `Value` that records operation `name`, with its operands swapped if `swap`."""
    return lambda self, other: self.tape.apply(name, *((other, self) if swap else (self, other)))


class Value:
    """Number on a tape; supports the arithmetic and the torch functions that the formulas use."""

    def __init__(self, tape: Tape, index: int):
        self.tape, self.index = tape, index

    __add__, __radd__, __sub__, __rsub__ = _op("add"), _op("add", True), _op("sub"), _op("sub", True)
    __mul__, __rmul__, __truediv__, __rtruediv__ = _op("mul"), _op("mul", True), _op("div"), _op("div", True)
    clamp_min, clamp_max = _op("max"), _op("min")

    def __neg__(self) -> Value:
        return 0.0 - self

    def __pow__(self, exponent: int) -> Value:
        return self * self if exponent == 2 else NotImplemented

    def clamp(self, low: float, high: float) -> Value:
        """Clamp to [low, high], as torch does."""
        return self.clamp_min(low).clamp_max(high)

    @classmethod
    def __torch_function__(cls, function: Callable, types: Any, arguments: tuple, keywords: dict | None = None) -> Any:
        x = arguments[0]
        compound = {
            torch.rsqrt: lambda: 1.0 / x.tape.apply("sqrt", x),
            torch.sigmoid: lambda: 1.0 / (1.0 + x.tape.apply("exp", -x)),
            torch.nn.functional.softplus: lambda: (
                x.clamp_min(0.0) + x.tape.apply("log1p", x.tape.apply("exp", -x.tape.apply("max", x, -x)))
            ),
            torch.tanh: lambda: 1.0 - 2.0 / (x.tape.apply("exp", 2.0 * x) + 1.0),
        }
        if function in compound:
            return compound[function]()
        return x.tape.apply(function.__name__.removeprefix("special_"), x)


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
