"""The tape of `factorlib.reflection` beside other ways to derivatives: SymPy's code generation, and torch's own.

`python -m benchmarks.operator.generators` prints, for each part of the operator,

- the arithmetic operations that C code of formula, features and their derivatives has, and the processor seconds to derive
  them: by the tape (reverse mode), and by SymPy (symbolic derivatives, then common subexpressions), which is stopped after
  `--limit` seconds of processor time,
- processor milliseconds of a call with all derivatives at 4096 points × 64 lobes on one thread: compiled, and by torch without it.

SymPy comes with torch; it is no dependency of this project.
"""

from __future__ import annotations

import operator
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Annotated

import torch
import typer

from benchmarks.operator.timing import point
from benchmarks.operator.variants import variants
from factorlib.reflection.fused import MOMENTS, diffuse_on, specular_on
from factorlib.reflection.tape import Tape

PARTS = {"diffuse": diffuse_on, "specular": specular_on}
INPUTS = ("alpha", "no", "nz", "oz", *MOMENTS)
ROWS, REPEATS = 4096, 5


def by_tape(part: str) -> tuple[int, float]:
    """Operations of the derived C code, and seconds."""
    start = time.process_time()
    tape = Tape()
    formula, columns = PARTS[part](tape)
    values = [formula, *columns]
    slopes = tape.gradient([(value, tape.input(f"seed{k}")) for k, value in enumerate(values)], [tape.input(name) for name in INPUTS])
    names = {arguments[0]: arguments[0] for name, arguments in tape.ops if name == "input"}
    lines = tape.c_code({f"result{k}": value for k, value in enumerate([*values, *slopes])}, names)
    inputs = sum(line.split(" = ")[1].rstrip(";") in names for line in lines if line.startswith("const float"))
    return sum(line.startswith("const float") for line in lines) - inputs, time.process_time() - start


def by_sympy(part: str) -> tuple[int, float]:
    """The same by SymPy.  Functions are known by their derivatives alone: SymPy's own are simplified at every use, for minutes."""
    import sympy

    def function(name: str, *derivatives: Callable) -> type:
        return type(name, (sympy.Function,), {"fdiff": lambda self, argindex=1: derivatives[argindex - 1](*self.args)})

    zero = sympy.Integer(0)
    above = function("above", lambda a, b: zero, lambda a, b: zero)
    exp = function("exp_", lambda a: exp(a))
    functions = {
        "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv, "sqrt": sympy.sqrt, "above": above, "exp": exp,
        "log": function("log_", lambda a: 1 / a), "log1p": function("log1p_", lambda a: 1 / (1 + a)),
        "erfc": function("erfc_", lambda a: -2 / sympy.sqrt(sympy.pi).evalf() * exp(-a * a)),
        "max": function("max_", lambda a, b: 1 - above(b, a), lambda a, b: above(b, a)),
        "min": function("min_", lambda a, b: 1 - above(a, b), lambda a, b: above(a, b)),
    }  # fmt: skip
    start = time.process_time()
    tape, every, symbol = Tape(), [], {name: sympy.Symbol(name) for name in INPUTS}
    formula, columns = PARTS[part](tape)
    for name, arguments in tape.ops:
        if name == "input":
            every.append(symbol[arguments[0]])
        else:
            every.append(functions[name](*(every[a] if isinstance(a, int) else sympy.Float(a) for a in arguments)))
    values = [every[value.index] for value in (formula, *columns)]
    total = sum(sympy.Symbol(f"seed{k}") * value for k, value in enumerate(values))
    shared, results = sympy.cse([*values, *(sympy.diff(total, symbol[name]) for name in INPUTS)], order="none")
    return sum(int(sympy.count_ops(e)) for e in [*(e for _, e in shared), *results]), time.process_time() - start


def milliseconds() -> dict[str, float]:
    """Median processor time of a call with all derivatives, per operator."""
    found = {}
    for label, some in variants(("float32",)).items():
        if label.startswith("network"):
            inputs = point(some, ROWS)
            taken = []
            for _ in range(REPEATS + 1):  # the first one compiles
                start = time.process_time()
                some.response(*inputs)
                taken.append(time.process_time() - start)
            found[label] = 1000 * statistics.median(taken[1:])
    return found


def within(limit: int, part: str) -> str:
    """What `by_sympy` says, in a process of its own that may take `limit` seconds of processor time."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.operator.generators", "--only", part], capture_output=True, text=True, env=os.environ,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit)),
    )  # fmt: skip
    return done.stdout.strip() if done.returncode == 0 else f"SymPy: not done after {limit} s"


def said(name: str, found: tuple[int, float]) -> str:
    return f"{name}: {found[0]} operations, {found[1]:.2f} s"


def main(
    limit: Annotated[int, typer.Option(help="seconds of processor time for SymPy, for each part")] = 60,
    only: Annotated[str, typer.Option(help="SymPy alone, for this part")] = "",
) -> None:
    torch.set_num_threads(1)
    if only:
        print(said("SymPy", by_sympy(only)))
        return
    for part in PARTS:
        print(f"{part}: {said('tape', by_tape(part))}; {within(limit, part)}")
    for label, each in milliseconds().items():
        print(f"{label}: {each:.0f} ms")


if __name__ == "__main__":
    typer.run(main)
