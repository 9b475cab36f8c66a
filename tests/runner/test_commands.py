"""What a user can write, and what can befall build/, ends in words; `clean` deletes results folders alone."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from itertools import cycle
from pathlib import Path

import pytest

from factorlib.errors import InputError
from factorlib.runner import results_folder
from factorlib.runner.project import LIBRARY
from tests.runner import toy
from tests.runner.toy import call, files_of, make, state, write

# ── DATASET ──────────────────────────────────────────────────────────────────────────────────────────────────────────

NO_NAMES = [
    "", "/", "//", ".", "..", "./", "../", "../..", "store", "bench", "studies", "data/..", "build/store",
    "loop", "data/loop", "loop/set", "x" * 256, "data/" + "y" * 300, "a/" * 3000, "nul\0", "data/nul\0/x", "\udcff",
]  # fmt: skip
NOBODYS = ["mine", "data", "nowhere", "elsewhere/set", "/nowhere/set", "../set", "data/elsewhere/../../set", "stages"]


@pytest.fixture
def checkout(project, monkeypatch):
    """The toy, everything current, with a .git, links in circles and a folder beside the results; the user stands in it."""
    write(project.root / ".git" / "HEAD", "ref: refs/heads/main")
    write(project.build / "bench" / "times.json", "{}")
    write(project.build / "mine" / "notes.txt", "not the runner's")
    for folder in (project.root, project.root / "data"):
        (folder / "loop").symlink_to("loop")
    monkeypatch.chdir(project.root)
    return project


def everything(project):
    """Every path of the checkout, but for the locks that tell who is using the store."""
    paths = (Path(folder) / name for folder, names, files in os.walk(project.root) for name in names + files)
    return sorted(str(p) for p in paths if p.name != "door.lock" and p != project.build / "store" / "tmp")


def clean(project, dataset):
    """What `make clean` returns or refuses with."""
    try:
        return results_folder.clean(project, dataset)
    except InputError as error:
        return str(error)


@pytest.mark.parametrize("verb", ["all", "validate", "clean"])
def test_every_verb_refuses_what_is_no_name_and_deletes_nothing(checkout, verb):
    before = everything(checkout)
    for word in NO_NAMES:
        last = call(checkout, verb, "--dataset", word)
        assert last.startswith("error: ") and "DATASET" in last, word
    os.mkdir(os.fsencode(checkout.root / "data") + b"/\xff\xfe")
    assert "cannot be called" in call(checkout, verb, "--dataset", os.fsdecode(b"\xff\xfe"))
    os.rmdir(os.fsencode(checkout.root / "data") + b"/\xff\xfe")
    assert everything(checkout) == before


def test_clean_deletes_a_results_folder_as_a_whole_nobody_elses_and_follows_no_link(checkout, tmp_path, capsys):
    shutil.copytree(checkout.root / "data" / "set", tmp_path / "other" / "set")
    home, precious = checkout.build / "set", tmp_path / "precious" / "photo.txt"
    write(precious, "p"), write(checkout.root / "data" / "new" / "a.txt", "text")
    (home / "album").symlink_to(precious.parent)
    (home / "log.jsonl").unlink()
    (home / "log.jsonl").symlink_to(precious)
    before, trees = everything(checkout), files_of(checkout.build / "store" / "trees")
    for word in [*NOBODYS, "new"]:
        clean(checkout, word)
    assert "holds the results of" in clean(checkout, str(tmp_path / "other" / "set")) and everything(checkout) == before
    capsys.readouterr()
    assert clean(checkout, "data/../data/set") == 0 and not home.exists()
    assert capsys.readouterr().out == "deleted build/set\n"
    assert files_of(checkout.build / "store" / "trees") == trees
    outside = [path for path in everything(checkout) if not path.startswith(str(checkout.build / "store"))]
    assert clean(checkout, None) == 0 and everything(checkout) == outside
    assert capsys.readouterr().out == "deleted build/store\n" and clean(checkout, None) == 0
    assert capsys.readouterr().out == "nothing to delete\n"
    assert files_of(precious.parent) == {"photo.txt": b"p"}


# ── pipeline.yaml and SET ────────────────────────────────────────────────────────────────────────────────────────────


SETTINGS = [f"table.scale={value}" for value in (
    ".inf", "-.inf", ".nan", "[1, .nan]", "{a: .inf}", "9" * 5000, "9" * 4000, "0x" + "f" * 30,
    "[" * 500 + "]" * 500, "[" * 2400, "{a: " * 1000, "'\"\\0\"'", "'\"\\ud800\"'", "'", '"', "&a [*a]",
    "!!python/object:os.system x", "'{a: 1, a: 2}'", "\udcff",
)] + ["upper.sleep=.inf", "table" + ".a" * 3000 + "=1", "=", ".=", "table.=1", "\udcff.scale=1"]  # fmt: skip
NO_FOLDERS = ["loop", "x" * 300, "a/" * 1000, "'\"\\0\"'", "3", "[1]", "{a: b}"]


def test_a_setting_that_is_none_and_a_given_folder_that_leads_nowhere(checkout, capsys):
    before = state(checkout)
    for setting in SETTINGS:
        last = call(checkout, "table", "--dataset", "set", "--set", setting)
        text = str(capsys.readouterr().err if last == 1 else last)
        assert text.startswith("error: ") and len(text) < 600 and "Traceback" not in text, setting
    assert state(checkout) == before and not list((checkout.build / "set").glob("errors/*"))
    write(checkout.root / "pipeline.yaml", toy.PIPELINE.replace("table: {}", "table: {given: {start: [seed.txt]}}"))
    for path in NO_FOLDERS:
        assert call(checkout, "plan", "--dataset", "set", "--set", f"table.start={path}").startswith("error: "), path


def test_values_that_the_stage_itself_refuses_are_named_before_anything_runs(checkout, capsys):
    before = state(checkout)
    for verb in ("plan", "count"):
        assert call(checkout, verb, "--dataset", "set", "--set", "upper.times=13") == 1
        captured = capsys.readouterr()
        assert (
            "thirteen is unlucky" in captured.out + captured.err
            and "take another number" in captured.out + captured.err
        )
    assert state(checkout) == before


# ── what lies in build/ ──────────────────────────────────────────────────────────────────────────────────────────────

DAMAGED = [
    b"{", b"[]", b"5", b'"x"', b"\xff\xfe", b'{"total": 5}', b'{"total": "../../x"}', b'{"a": {"b": []}}', b"[" * 5000, b"",
]  # fmt: skip
OF_CACHES = [*DAMAGED, b'{"contents": [], "sources": 5}', b'{"contents": {"a": 5}, "sources": {"a": [[1], 2]}}']
OF_MARKS = [b"", b"\xff\xfe", b"x" * 5000, b"a\0b", b"/nowhere/set\n"]


def test_damaged_files_of_the_runner_lose_nothing_and_are_made_anew(project):
    home, store = project.build / "set", project.build / "store"
    mark, names = home / "current.json", sorted((store / "trees").iterdir())
    before = json.loads(mark.read_bytes())
    for content in DAMAGED:
        mark.write_bytes(content)
        last = call(project, "all", "--dataset", "set")
        assert "current.json" in last and "delete it" in last and sorted((store / "trees").iterdir()) == names
    assert "delete it" in call(project, "plan", "--dataset", "set")
    mark.unlink()
    assert make(project) == 0 and json.loads(mark.read_bytes()) == before
    caches = {store / "cache" / "files.json", *(store / "cache").glob("*.json")}
    for path, contents in [*((cache, OF_CACHES) for cache in caches), (home / "dataset.txt", OF_MARKS)]:
        for content in contents:
            path.write_bytes(content)
            assert set(state(project).values()) == {"current"}, (path, content)


# ── make and the shell: what is given as NAME=value reaches programs as it was written ───────────────────────────────

PWNED = "pwned"
TRIES = [
    f"$(shell touch {PWNED})", f"${{shell touch {PWNED}}}", f"$$(touch {PWNED})", f"`touch {PWNED}`",
    f'"; touch {PWNED}; "', f"'; touch {PWNED}; '", f"x; touch {PWNED}", f"x\ntouch {PWNED}",
    f"$(eval X:=$(shell touch {PWNED}))", f"x #\\\n| touch {PWNED}", f"$(info $(shell touch {PWNED}))",
]  # fmt: skip
VARIABLES = ["DATASET", "SET", "HELD_OUT", "FORCE", "DATASETS", "RECIPE", "PYTHON", "TORCH_INDEX", "EXTRAS", "OTHER"]
OWN = ["PY", "STAGES", "GOAL"]  # the Makefile's own


@pytest.fixture
def checkout_copy(tmp_path):
    """A checkout that has this one's code, and data sets and results of its own."""
    root = tmp_path / "a checkout"
    (root / "data").mkdir(parents=True)
    for name in ("Makefile", "pipeline.yaml", "requirements.lock", "factorlib", "stages"):
        (root / name).symlink_to(LIBRARY / name)
    set_root = f"export FACTORLIB_ROOT={shlex.quote(str(root))}"
    write(root / ".venv" / "bin" / "python", f'#!/bin/sh\n{set_root}\nexec {shlex.quote(sys.executable)} "$@"\n')
    (root / ".venv" / "bin" / "python").chmod(0o755)
    (root / ".venv" / "ready").touch()
    return root


def by_make(checkout, *words, **environment):
    clean = {k: v for k, v in os.environ.items() if k not in (*VARIABLES, *OWN, "MAKEFLAGS", "MAKELEVEL", "MFLAGS")}
    options = {"capture_output": True, "text": True, "timeout": 600, "check": False}
    process = subprocess.run(["make", *words], cwd=checkout, env=clean | environment, **options)
    assert not [p for p in checkout.rglob(PWNED) if p.name == PWNED], "a command was run"
    assert "Traceback" not in process.stderr
    return process


def test_no_variable_is_expanded_on_its_way(checkout_copy):
    """Each variable holds another try, on the command line and, shifted, in the environment."""
    spy = f"#!{sys.executable}\nimport json, os, sys\nprint(json.dumps([sys.argv[1:], dict(os.environ)]))\n"
    write(checkout_copy / ".venv" / "bin" / "python", spy)
    for shift in (0, 5):
        given = dict(zip((*VARIABLES, *OWN), cycle(TRIES[shift:] + TRIES[:shift])))
        process = by_make(
            checkout_copy, "plan", *(map("=".join, given.items()) if not shift else ()), **(given if shift else {})
        )
        arguments, environment = json.loads(process.stdout)
        assert arguments == ["-m", "factorlib", "plan"] and environment["GOAL"] == "plan"
        assert {name: environment[name] for name in VARIABLES} == {name: given[name] for name in VARIABLES}
