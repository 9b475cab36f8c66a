"""What a user can write on the command line, and what can befall build/, ends in words, never in a traceback."""

import json
import os
import sys

import pytest

from factorlib import __main__ as command_line
from factorlib.runner import verbs
from tests.runner import toy
from tests.runner.toy import state, write

DAMAGED = [
    b"",
    b"{",
    b"[]",
    b"[1, 2]",
    b"5",
    b"null",
    b'"x"',
    b"\xff\xfe",
    b'{"total": 5}',
    b'{"total": "../../x"}',
    b'{"a": {"b": []}}',
    b"[" * 5000,
]


@pytest.fixture(scope="module")
def made_once(tmp_path_factory):
    made = toy.make_project(tmp_path_factory.mktemp("toy") / "root")
    assert verbs.make(made, verbs.Wish("set")) == 0
    return made


@pytest.fixture
def project(made_once, tmp_path):
    return toy.copy(made_once, tmp_path / "checkout")


def call(monkeypatch, project, *words):
    """What `python -m factorlib` ends with: 0, or its last words."""
    monkeypatch.setattr(command_line, "project", lambda: project)
    monkeypatch.setattr(sys, "argv", ["factorlib", *words])
    with pytest.raises(SystemExit) as caught:
        command_line.main()
    return caught.value.code


# ── DATASET ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "word",
    [
        "loop",
        "data/loop",
        "loop/set",
        "x" * 300,
        "data/" + "y" * 300,
        "a/" * 3000,
        "nul\0",
        "data/nul\0/x",
        "\udcff",
        "data/\udcff",
    ],
)
@pytest.mark.parametrize("verb", ["all", "plan", "status", "validate", "clean"])
def test_a_path_that_leads_nowhere(project, monkeypatch, verb, word):
    for folder in (project.root, project.root / "data"):
        (folder / "loop").symlink_to("loop")
    monkeypatch.chdir(project.root)
    said = call(monkeypatch, project, verb, "--dataset", word)
    assert said.startswith("error: DATASET: ")


def test_a_folder_whose_name_is_no_text(project, monkeypatch):
    os.mkdir(os.fsencode(project.root / "data") + b"/\xff\xfe")
    assert "not UTF-8" in call(monkeypatch, project, "plan", "--dataset", os.fsdecode(b"\xff\xfe"))


# ── SET ──────────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "setting",
    [
        "table.scale=.inf",
        "table.scale=-.inf",
        "table.scale=.nan",
        "table.scale=[1, .nan]",
        "table.scale={a: .inf}",
        "upper.sleep=.inf",
    ]
    + ["table.scale=" + "9" * 5000, "table.scale=" + "9" * 4000, f"table.scale={2**63}", "table.scale=0x" + "f" * 30]
    + [
        "table.scale=" + "[" * 500 + "]" * 500,
        "table.scale=" + "[" * 2400,
        "table.scale=" + "{a: " * 1000,
        "table" + ".a" * 3000 + "=1",
    ]
    + [
        "table.scale='\"\\0\"'",
        "table.scale='\"\\ud800\"'",
        "table.scale='",
        'table.scale="',
        "=",
        ".=",
        "table.=1",
        "table.scale=&a [*a]",
    ]
    + ["table.scale=!!python/object:os.system x", "table.scale='{a: 1, a: 2}'", "\udcff.scale=1", "table.scale=\udcff"],
)
@pytest.mark.parametrize("verb", ["plan", "table"])
def test_a_setting_that_is_none(project, monkeypatch, capsys, verb, setting):
    before = state(project)
    said = call(monkeypatch, project, verb, "--dataset", "set", "--set", setting)
    said = capsys.readouterr().err if said == 1 else said
    assert said.startswith("error: ") and len(said) < 600 and "Traceback" not in said
    assert state(project) == before and not list((project.build / "set").glob("errors/*"))


@pytest.mark.parametrize("path", ["loop", "x" * 300, "a/" * 1000, "'\"\\0\"'", "3", "[1]", "{a: b}"])
def test_a_given_folder_that_leads_nowhere(project, monkeypatch, path):
    write(project.root / "pipeline.yaml", toy.PIPELINE.replace("table: {}", "table: {given: {start: [seed.txt]}}"))
    (project.root / "loop").symlink_to("loop")
    monkeypatch.chdir(project.root)
    assert call(monkeypatch, project, "plan", "--dataset", "set", "--set", f"table.start={path}").startswith("error: ")


# ── what lies in build/ ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("content", DAMAGED)
def test_a_damaged_current_json_loses_nothing(project, monkeypatch, content, caplog):
    mark = project.build / "set" / "current.json"
    before = json.loads(mark.read_bytes())
    mark.write_bytes(content)
    trees = sorted((project.build / "store" / "trees").iterdir())
    if content != b"":
        assert "current.json" in call(monkeypatch, project, "gc") and "delete it" in call(monkeypatch, project, "gc")
        assert sorted((project.build / "store" / "trees").iterdir()) == trees
    assert set(state(project).values()) == {"current"} and "current.json" in caplog.text
    assert verbs.make(project, verbs.Wish("set")) == 0
    assert json.loads(mark.read_bytes()) == before


@pytest.mark.parametrize(
    "content", [*DAMAGED, b'{"contents": [], "sources": 5}', b'{"contents": {"a": 5}, "sources": {"a": [[1], 2]}}']
)
@pytest.mark.parametrize("cache", ["files.json", "packages.json"])
def test_a_damaged_cache_is_made_anew(project, cache, content):
    (project.build / "store" / "cache").mkdir(exist_ok=True)
    (project.build / "store" / "cache" / cache).write_bytes(content)
    assert set(state(project).values()) == {"current"}


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"{",
        b"[]",
        b"5",
        b"\xff",
        b'{"no": "event"}',
        b'{"event": 5}',
        b'{"event": "warning", "text": [1]}',
        b"[" * 5000,
    ],
)
def test_a_damaged_line_of_a_log_costs_that_line(project, caplog, line, capsys):
    write(project.root / "data" / "set" / "a.txt", "odd")
    assert verbs.make(project, verbs.Wish("set")) == 0
    for log in (project.build / "store" / "logs").glob("*.jsonl"):
        log.write_bytes(line + b"\n" + log.read_bytes() + line)
    assert verbs.show_status(project, verbs.Wish("set")) == 0
    assert "a is odd" in capsys.readouterr().out
    assert verbs.make(project, verbs.Wish("set", ["total"], force=True)) == 0
    if line not in (b"", b'{"event": "warning", "text": [1]}'):
        assert "damaged line" in caplog.text
        assert (project.build / "set" / "total" / "log.txt").read_text() == "6", "what the report is handed"


def test_a_mark_that_names_nobody(project):
    for content in (b"", b"\xff\xfe", b"x" * 5000, b"a\0b", b"/nowhere/set\n"):
        (project.build / "set" / "dataset.txt").write_bytes(content)
        assert set(state(project).values()) == {"current"}


# ── rights ───────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def foreign(made_once, open_folder, monkeypatch):
    """A checkout of somebody else's, with everything current."""
    checkout = toy.copy(made_once, open_folder / "checkout")
    assert (
        call(monkeypatch, checkout, "plan", "--dataset", "set") == 0
    )  # loads what another user may not: Python may lie in root's home
    return checkout


@pytest.mark.parametrize("verb", ["plan", "why", "status", "validate"])
def test_what_only_shows_needs_no_right_to_write(foreign, as_other_user, monkeypatch, verb, capsys):
    with as_other_user():
        assert call(monkeypatch, foreign, verb, "--dataset", "set") == 0
    assert capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [
        ["table", "--dataset", "set", "--set", "table.scale=3"],
        ["all", "--dataset", "set", "--force"],
        ["gc"],
        ["clean"],
        ["clean", "-d", "set"],
    ],
)
def test_a_build_folder_that_is_read_only(foreign, as_other_user, monkeypatch, words):
    with as_other_user():
        said = call(monkeypatch, foreign, *words)
    assert said.lower().startswith("error: ") and "permission denied" in said.lower() and str(foreign.build) in said


@pytest.mark.parametrize(
    "place",
    ["data/set", "data", "build", "build/set", "build/store/keys", "build/set/current.json", "pipeline.yaml", "stages"],
)
@pytest.mark.parametrize("verb", ["all", "plan", "status", "clean"])
def test_what_may_not_be_read(foreign, as_other_user, monkeypatch, verb, place):
    (foreign.root / place).chmod(0)
    with as_other_user():
        said = call(monkeypatch, foreign, verb, "--dataset", "set")
    assert said == 0 or said.startswith("error: ")


# ── names in dataset.yaml ────────────────────────────────────────────────────────────────────────────────────────────
