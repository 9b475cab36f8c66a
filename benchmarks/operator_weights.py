"""Make the shipped weights again: `python -m benchmarks.operator_weights` runs the stage `train` with its own parameters."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from factorlib.reflection.network import SHIPPED
from factorlib.stage import Inputs
from stages import train


def say(done: float, total: float, text: str = "") -> None:
    print(f"{done:g}/{total:g} {text}", flush=True)


if __name__ == "__main__":
    SHIPPED.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        train.main(train.Params(), Inputs({}), Path(folder), say)
        for name in ("diffuse.safetensors", "specular.safetensors", "accuracy.json"):
            shutil.copy(Path(folder) / name, SHIPPED / name)
