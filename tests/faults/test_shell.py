"""What is given to make as NAME=value reaches programs as it was written, unread by make and the shell."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from itertools import cycle
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PWNED = "pwned"
TRIES = [
    f"$(shell touch {PWNED})", f"${{shell touch {PWNED}}}", f"$$(touch {PWNED})", f"`touch {PWNED}`",
    f'"; touch {PWNED}; "', f"'; touch {PWNED}; '",
    f"x; touch {PWNED}", f"x\ntouch {PWNED}", f"$(eval X:=$(shell touch {PWNED}))", f"x #\\\n| touch {PWNED}",
    f"$(info $(shell touch {PWNED}))",
]  # fmt: skip
VARIABLES = ["DATASET", "SET", "FORCE", "DATASETS", "RECIPE", "PYTHON", "TORCH_INDEX", "EXTRAS", "OTHER"]
OWN = ["PY", "STAGES", "GOAL"]  # the Makefile's own
ODD = 'it\'s $(touch pwned) "two" `touch pwned` \\ ;&|<>*?~ $HOME %s é\n#last'


@pytest.fixture
def checkout(tmp_path):
    """A checkout that has this one's code, and data sets and results of its own."""
    root = tmp_path / "a checkout"
    root.mkdir()
    for name in ("Makefile", "pipeline.yaml", "requirements.lock", "factorlib", "stages"):
        (root / name).symlink_to(ROOT / name)
    python = root / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    set_root = f"export FACTORLIB_ROOT={shlex.quote(str(root))}"
    python.write_text(f'#!/bin/sh\n{set_root}\nexec {shlex.quote(sys.executable)} "$@"\n')
    python.chmod(0o755)
    (root / ".venv" / "ready").touch()
    (root / "data").mkdir()
    return root


def make(checkout, *words, **environment):
    clean = {k: v for k, v in os.environ.items() if k not in (*VARIABLES, *OWN, "MAKEFLAGS", "MAKELEVEL", "MFLAGS")}
    options = {"capture_output": True, "text": True, "timeout": 600, "check": False}
    done = subprocess.run(["make", *words], cwd=checkout, env=clean | environment, **options)
    assert not [p for p in checkout.rglob(PWNED) if p.name == PWNED], "a command was run"
    assert "Traceback" not in done.stderr
    return done


@pytest.mark.parametrize("shift", [0, 5])
def test_no_variable_is_expanded_on_its_way(checkout, shift):
    """Each variable holds another try, with another shift yet another, on the command line and in the environment."""
    spy = f"#!{sys.executable}\nimport json, os, sys\nprint(json.dumps([sys.argv[1:], dict(os.environ)]))\n"
    (checkout / ".venv" / "bin" / "python").write_text(spy)
    given = dict(zip((*VARIABLES, *OWN), cycle(TRIES[shift:] + TRIES[:shift])))
    for done in (make(checkout, "plan", *map("=".join, given.items())), make(checkout, "plan", **given)):
        arguments, environment = json.loads(done.stdout)
        assert arguments == ["-m", "factorlib", "plan"] and environment["GOAL"] == "plan"
        assert {name: environment[name] for name in VARIABLES} == {name: given[name] for name in VARIABLES}


def test_no_goal_and_no_path_to_python_is_a_command(checkout):
    goals = ["x;touch pwned", "$(shell touch pwned)", "`touch pwned`", "x\ntouch pwned", '"$(touch pwned)"']
    assert make(checkout, "--keep-going", *goals).returncode != 0
    shutil.rmtree(checkout / ".venv")
    (checkout / "factorlib").unlink()
    (checkout / "factorlib").mkdir()
    (checkout / "factorlib" / "setup.py").write_text("print('set up')")
    for text in TRIES[3:6]:
        assert "set up" in make(checkout, "setup", f"PYTHON={text}").stdout


def test_the_real_program_refuses_what_is_no_dataset_and_what_is_neither_0_nor_1(checkout):
    done = make(checkout, "plan", f"DATASET={TRIES[0]}", f"SET={TRIES[1]}", "FORCE=0")
    assert done.returncode != 0 and "error: " in done.stderr
    assert "FORCE: 'yes' is neither 1 nor 0" in make(checkout, "plan", "DATASET=x", "FORCE=yes").stderr
    (checkout / "build" / "set").mkdir(parents=True)
    (checkout / "build" / "set" / "dataset.txt").write_text("data/set\n")
    assert "DATASET" in make(checkout, "clean", "DATASET=").stderr, "an empty name is not none"
    assert (checkout / "build" / "set").exists()


@pytest.mark.long
def test_a_folder_with_any_name_is_a_dataset(checkout):
    shutil.copytree(ROOT / "data" / "synthetic", checkout / "data" / ODD)
    done = make(checkout, "masks", f"DATASET={ODD}")
    assert done.returncode == 0, done.stderr
    assert (checkout / "build" / ODD / "masks" / "photos.json").exists()
    assert make(checkout, "status", f"DATASET=data/{ODD}").stdout.startswith("masks      3 current")
    assert make(checkout, "clean", f"DATASET={ODD}").returncode == 0 and not (checkout / "build" / ODD).exists()


def test_who_reads_no_further_gets_no_traceback():
    """As `make params | head -1` does."""
    command = [sys.executable, "-m", "factorlib", "params"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 1
