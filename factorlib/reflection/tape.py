"""Derivatives and C code of an elementwise function that is written in torch.

The function runs once with a `Value` in place of each tensor. A `Tape` records its operations, equal ones only once.
`Tape.gradient` goes backward over the tape and records the derivatives in the same way (reverse mode). `Tape.c_code`
writes the operations that given results need as C statements on floats, one a line.

No existing generator does the same. SymPy differentiates without sharing (it had not finished the specular part after
60 s, which takes 0.04 s here). CasADi does not accept torch functions. Enzyme needs every user to have Clang.
torch.compile chooses the order of operations itself; that order is fixed here so that every processor gives the same
bits.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import torch

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
