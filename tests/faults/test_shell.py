"""What is given to make as NAME=value reaches programs as it was written, whatever make and the shell would read in it; closed pipes."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PWNED = "pwned"
TRIES = [
    f"$(shell touch {PWNED})",
    f"${{shell touch {PWNED}}}",
    f"$$(touch {PWNED})",
    f"`touch {PWNED}`",
    f'"; touch {PWNED}; "',
    f"'; touch {PWNED}; '",
    f"x; touch {PWNED}",
    f"x\ntouch {PWNED}",
    f"$(eval X:=$(shell touch {PWNED}))",
    f"x #\\\n| touch {PWNED}",
    f"$(info $(shell touch {PWNED}))",
]
VARIABLES = ["DATASET", "SET", "FORCE", "DATASETS", "RECIPE", "PYTHON", "TORCH_INDEX", "EXTRAS", "OTHER"]
OWN = ["PY", "STAGES", "GOAL"]  # the Makefile's own
ODD = "it's $(touch pwned) \"two\" `touch pwned` \\ ;&|<>*?~ $HOME %s é\n#last"


@pytest.fixture
def checkout(tmp_path):
    """A checkout that has this one's code, and data sets and results of its own."""
    root = tmp_path / "a checkout"
    root.mkdir()
    for name in ("Makefile", "pipeline.yaml", "requirements.lock", "factorlib", "stages", "benchmarks"):
        (root / name).symlink_to(ROOT / name)
    python = root / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f"#!/bin/sh\nexport FACTORLIB_ROOT={shlex.quote(str(root))}\nexec {shlex.quote(sys.executable)} \"$@\"\n")
    python.chmod(0o755)
    (root / ".venv" / "ready").touch()
    (root / "data").mkdir()
    return root


def make(checkout, *words, **environment):
    clean = {k: v for k, v in os.environ.items() if k not in (*VARIABLES, *OWN, "MAKEFLAGS", "MAKELEVEL", "MFLAGS")}
    done = subprocess.run(["make", *words], cwd=checkout, env=clean | environment, capture_output=True, text=True, timeout=600, check=False)
    assert not [p for p in checkout.rglob(PWNED) if p.name == PWNED], "a command was run"
    assert "Traceback" not in done.stderr
    return done


def spy(checkout):
    """In place of Python: what was it called with, and what is in the environment?"""
    python = checkout / ".venv" / "bin" / "python"
    python.write_text(f"#!{sys.executable}\nimport json, os, sys\nprint(json.dumps([sys.argv[1:], dict(os.environ)]))\n")
    python.with_name("lint-imports").write_text("#!/bin/sh\n")
    python.with_name("lint-imports").chmod(0o755)


@pytest.mark.parametrize("text", TRIES)
@pytest.mark.parametrize("verb", ["plan", "clean", "nonsense", "bench-parts", "graph"])
def test_no_variable_is_expanded_on_its_way(checkout, verb, text):
    spy(checkout)
    given = dict.fromkeys((*VARIABLES, *OWN), text)
    for done in (make(checkout, verb, *(f"{name}={text}" for name in given)), make(checkout, verb, **given)):
        arguments, seen = json.loads(done.stdout)
        assert arguments in (["-m", "factorlib", verb], ["-m", verb.replace("bench-", "benchmarks.")])
        assert seen["GOAL"] == verb and [seen[name] for name in VARIABLES] == [text] * len(VARIABLES)


@pytest.mark.parametrize("goal", ["x;touch pwned", "$(shell touch pwned)", "`touch pwned`", "bench-x;touch pwned", "x\ntouch pwned", '"$(touch pwned)"'])
def test_no_goal_is_a_command(checkout, goal):
    assert make(checkout, goal).returncode != 0


@pytest.mark.parametrize("text", TRIES)
def test_a_path_to_python_is_no_command(checkout, text):
    shutil.rmtree(checkout / ".venv")
    (checkout / "factorlib").unlink()
    (checkout / "factorlib").mkdir()
    (checkout / "factorlib" / "setup.py").write_text("print('set up')")
    assert "set up" in make(checkout, "setup", f"PYTHON={text}").stdout


@pytest.mark.parametrize("text", TRIES)
def test_plan_with_the_real_program_refuses_what_is_no_dataset(checkout, text):
    done = make(checkout, "plan", f"DATASET={text}", f"SET={text}", "FORCE=0")
    assert done.returncode != 0 and "error: " in done.stderr


def test_force_is_0_or_1(checkout):
    done = make(checkout, "plan", "DATASET=x", "FORCE=yes")
    assert "FORCE: 'yes' is neither 1 nor 0" in done.stderr


@pytest.mark.parametrize("verb", ["plan", "clean"])
def test_an_empty_dataset_is_not_no_dataset(checkout, verb):
    (checkout / "build" / "set").mkdir(parents=True)
    (checkout / "build" / "set" / "dataset.txt").write_text("data/set\n")
    assert "DATASET" in make(checkout, verb, "DATASET=").stderr
    assert "DATASET" in make(checkout, verb, DATASET="").stderr
    assert (checkout / "build" / "set").exists()


@pytest.mark.long
def test_a_folder_with_any_name_is_a_dataset(checkout):
    folder = checkout / "data" / ODD
    shutil.copytree(ROOT / "data" / "synthetic", folder)
    for words in ([f"DATASET={ODD}"], [f"DATASET=data/{ODD}", "SET=align.poses='build/x y'"], [f"DATASET={folder}"]):
        done = make(checkout, "masks", words[0])
        assert done.returncode == 0, done.stderr
        assert (checkout / "build" / ODD / "masks" / "photos.json").exists()
        assert make(checkout, "status", words[0]).stdout.startswith("masks      3 current")
    assert make(checkout, "clean", f"DATASET={folder}").returncode == 0 and not (checkout / "build" / ODD).exists()


def test_who_reads_no_further_gets_no_traceback():
    """As `make params | head -1` does."""
    process = subprocess.Popen([sys.executable, "-m", "factorlib", "params"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 1
