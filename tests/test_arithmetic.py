"""A solve is the same bits whatever the processor: libraries held to one instruction set, checked on processors that are emulated."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from factorlib.arithmetic import VARIABLES
from factorlib.light.visibility import square_root

ROOT = Path(__file__).resolve().parents[1]
EMULATOR = shutil.which("qemu-x86_64")
SOLVE = """
from factorlib.arithmetic import fix
fix()
import hashlib, msgspec, torch
torch.set_num_threads(1)
from factorlib.reflection import fused
fused.FLAGS = fused.FLAGS.replace("-march=native", "-march=x86-64-v3")  # an emulated processor's compiler is this one's
from factorlib.model.problem import JointProblem
from factorlib.reflection import reflection_operator
from factorlib.solve.few_lobes.solve import few_lobes
from factorlib.solve.options import FewLobes
from studies.scenes.problems import square
operator = reflection_operator("network")
brief = FewLobes(rounds=1, iterations=3, polish=2, lobes=4, insert=4)
solution = few_lobes(JointProblem(square(1, operator, 0), operator), 1, brief)
point = solution.point
parts = [point.materials.vector(), *(part for light in point.lights for part in (light.axis, light.log_sharpness, light.weight))]
print(hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest())
"""
BITS = """
import hashlib, numpy as np
x = np.random.default_rng(0).normal(size=(257, 257))
print(hashlib.sha256(np.exp(x).tobytes() + (x @ x).tobytes()).hexdigest())
"""


def process(code: str, emulator: tuple[str, ...] = (), **environment: str) -> str:
    """What Python prints in a process that no test has set variables for."""
    set_ = {k: v for k, v in os.environ.items() if k not in VARIABLES and not k.startswith("PYTEST_")}
    set_ |= {"OMP_NUM_THREADS": "1"} | environment
    command = [*emulator, sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, env=set_, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_solve_is_the_same_bits_whatever_the_variables_were():
    assert process(SOLVE) == process(SOLVE, OPENBLAS_CORETYPE="Nehalem", ATEN_CPU_CAPABILITY="default")


@pytest.mark.long
@pytest.mark.skipif(EMULATOR is None, reason="qemu-x86_64 is not installed (Debian: qemu-user)")
@pytest.mark.parametrize("processor", ["EPYC-Rome", "Haswell-noTSX"])
def test_a_solve_is_the_same_bits_on_an_emulated_processor(processor):
    assert process(SOLVE, emulator=(EMULATOR, "-cpu", processor)) == process(SOLVE)


def test_a_test_computes_the_bits_of_a_worker(capsys):
    exec(BITS, {})
    assert capsys.readouterr().out == process(BITS, **VARIABLES)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_square_roots_are_those_of_ieee_754(dtype):
    x = np.random.default_rng(0).random(100_003).astype(dtype) * 7
    assert square_root(torch.from_numpy(x)).numpy().tobytes() == np.sqrt(x).tobytes()
