"""What a user can write, and what can befall build/, ends in words; `clean` deletes what the runner made alone."""

import json
import os
import shutil
from itertools import product
from pathlib import Path

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from tests.faults.battered import call, make
from tests.runner import toy
from tests.runner.toy import files_of, state, write

# ── DATASET ──────────────────────────────────────────────────────────────────────────────────────────────────────────

NO_NAMES = [
    "", "/", "//", ".", "..", "./", "../", "../..", "store", "bench", "studies", "compare", "data/..", "build/store",
]  # fmt: skip
NOWHERE = [
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
        return verbs.clean(project, dataset)
    except InputError as error:
        return str(error)


@pytest.mark.parametrize("verb", ["all", "plan", "status", "validate", "clean"])
def test_every_verb_refuses_what_is_no_name_and_deletes_nothing(checkout, verb):
    before = everything(checkout)
    for word in NO_NAMES + NOWHERE:
        last = call(checkout, verb, "--dataset", word)
        assert last.startswith("error: ") and "DATASET" in last, word
    os.mkdir(os.fsencode(checkout.root / "data") + b"/\xff\xfe")
    assert "not UTF-8" in call(checkout, verb, "--dataset", os.fsdecode(b"\xff\xfe"))
    os.rmdir(os.fsencode(checkout.root / "data") + b"/\xff\xfe")
    assert everything(checkout) == before


def test_a_name_that_has_no_results_of_its_own_deletes_nobody_elses(checkout, tmp_path, capsys):
    shutil.copytree(checkout.root / "data" / "set", tmp_path / "other" / "set")
    write(checkout.root / "data" / "new" / "a.txt", "text")
    before = everything(checkout)
    for word in NOBODYS:
        clean(checkout, word)
    assert "holds the results of" in clean(checkout, str(tmp_path / "other" / "set"))
    assert clean(checkout, "new") == 0 and "nothing to delete" in capsys.readouterr().out
    assert everything(checkout) == before


@pytest.mark.parametrize("word", ["set", "data/set", "./data/set/", "data/../data/set", "gone", "path of what is gone"])
def test_links_and_marks_go_and_results_stay_in_the_store(checkout, word, capsys):
    """Also of a data set that is gone, by its name and by its path."""
    if "gone" in word:
        shutil.rmtree(checkout.root / "data" / "set")
        word = "set" if word == "gone" else str(checkout.root / "data" / "set")
    trees = files_of(checkout.build / "store" / "trees")
    assert clean(checkout, word) == 0
    assert not (checkout.build / "set").exists() and files_of(checkout.build / "store" / "trees") == trees
    assert capsys.readouterr().out == "deleted build/set\n"


def test_what_a_user_put_beside_the_results_stays_and_no_link_is_followed(checkout, tmp_path, capsys):
    home = checkout.build / "set"
    write(home / "notes.txt", "mine")
    write(tmp_path / "precious" / "photo.txt", "p")
    for link in ("errors", "album"):
        (home / link).symlink_to(tmp_path / "precious")
    (home / "log.jsonl").unlink()
    (home / "log.jsonl").symlink_to(tmp_path / "precious" / "photo.txt")
    assert clean(checkout, "set") == 0
    text = capsys.readouterr().out
    assert all(words in text for words in ("deleted build/set/total\n", "deleted build/set/dataset.txt\n"))
    assert "left    build/set/notes.txt" in text and {"notes.txt", "album"} <= {p.name for p in home.iterdir()}
    assert clean(checkout, None) == 0
    assert files_of(tmp_path / "precious") == {"photo.txt": b"p"} and (home / "album").is_symlink()


def test_a_home_that_is_a_link_is_not_taken(checkout, tmp_path):
    (checkout.build / "set").rename(tmp_path / "moved")
    (checkout.build / "set").symlink_to(tmp_path / "moved")
    before = files_of(tmp_path / "moved")
    assert "is a link" in clean(checkout, "set") and clean(checkout, None) == 0
    assert files_of(tmp_path / "moved") == before


def test_without_a_name_the_store_and_every_home_go_and_nothing_else(checkout, capsys):
    taken = tuple(str(checkout.build / name) for name in ("set", "store"))
    outside = [path for path in everything(checkout) if not path.startswith(taken)]
    assert clean(checkout, None) == 0 and everything(checkout) == outside
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["deleted build/set", "deleted build/store", "left    build/bench", "left    build/mine"]


# ── pipeline.yaml and SET ────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", ["../up", ".", "a/b", "", "Store x", "log.jsonl", "errors"])
def test_a_name_in_the_pipeline_that_leads_elsewhere_is_refused(project, name):
    write(project.root / "pipeline.yaml", toy.PIPELINE + f"  ? {name!r}\n  : {{}}\n")
    assert "stage" in call(project, "graph")
    write(project.root / "pipeline.yaml", toy.PIPELINE.replace("gather: sizes.json", "gather: ../../sizes.json"))
    assert "gathered file" in call(project, "graph")


SETTINGS = [f"table.scale={value}" for value in (
    ".inf", "-.inf", ".nan", "[1, .nan]", "{a: .inf}", "9" * 5000, "9" * 4000, 2**63, "0x" + "f" * 30,
    "[" * 500 + "]" * 500, "[" * 2400,
    "{a: " * 1000, "'\"\\0\"'", "'\"\\ud800\"'", "'", '"', "&a [*a]", "!!python/object:os.system x", "'{a: 1, a: 2}'",
    "\udcff",
)] + ["upper.sleep=.inf", "table" + ".a" * 3000 + "=1", "=", ".=", "table.=1", "\udcff.scale=1"]  # fmt: skip


@pytest.mark.parametrize("verb", ["plan", "table"])
def test_a_setting_that_is_none(project, capsys, verb):
    before = state(project)
    for setting in SETTINGS:
        last = call(project, verb, "--dataset", "set", "--set", setting)
        text = capsys.readouterr().err if last == 1 else last
        assert text.startswith("error: ") and len(text) < 600 and "Traceback" not in text, setting
    assert state(project) == before and not list((project.build / "set").glob("errors/*"))


def test_a_given_folder_that_leads_nowhere(checkout):
    write(checkout.root / "pipeline.yaml", toy.PIPELINE.replace("table: {}", "table: {given: {start: [seed.txt]}}"))
    for path in ["loop", "x" * 300, "a/" * 1000, "'\"\\0\"'", "3", "[1]", "{a: b}"]:
        assert call(checkout, "plan", "--dataset", "set", "--set", f"table.start={path}").startswith("error: "), path


# ── what lies in build/ ──────────────────────────────────────────────────────────────────────────────────────────────

DAMAGED = [b"", b"{", b"[]", b"[1, 2]", b"5", b"null", b'"x"', b"\xff\xfe", b'{"total": 5}', b'{"total": "../../x"}']
DAMAGED += [b'{"a": {"b": []}}', b"[" * 5000]
DAMAGED_CACHES = [*DAMAGED, b'{"contents": [], "sources": 5}', b'{"contents": {"a": 5}, "sources": {"a": [[1], 2]}}']


def test_a_damaged_current_json_loses_nothing(project, caplog):
    mark, trees = project.build / "set" / "current.json", project.build / "store" / "trees"
    before, names = json.loads(mark.read_bytes()), sorted(trees.iterdir())
    for content in DAMAGED:
        mark.write_bytes(content)
        caplog.clear()
        if content != b"":
            last = call(project, "gc")
            assert "current.json" in last and "delete it" in last and sorted(trees.iterdir()) == names
        assert set(state(project).values()) == {"current"} and "current.json" in caplog.text
        assert make(project) == 0 and json.loads(mark.read_bytes()) == before


def test_damaged_caches_and_marks_are_made_anew(project):
    cache, mark = project.build / "store" / "cache", project.build / "set" / "dataset.txt"
    names = {"files.json", "packages.json", *(path.name for path in cache.glob("*.json"))}
    for name, content in product(names, DAMAGED_CACHES):
        (cache / name).write_bytes(content)
        assert set(state(project).values()) == {"current"}, (name, content)
    for content in (b"", b"\xff\xfe", b"x" * 5000, b"a\0b", b"/nowhere/set\n"):
        mark.write_bytes(content)
        assert set(state(project).values()) == {"current"}, content


LINES = [
    b"", b"{", b"[]", b"5", b"\xff", b'{"no": "event"}', b'{"event": 5}', b'{"event": "warning", "text": [1]}',
    b"[" * 5000,
]  # fmt: skip


def test_a_damaged_line_of_a_log_costs_that_line(project, caplog, capsys):
    write(project.root / "data" / "set" / "a.txt", "odd")
    assert make(project) == 0
    logs = {path: path.read_bytes() for path in (project.build / "store" / "logs").glob("*.jsonl")}
    for line in LINES:
        for log, content in logs.items():
            log.write_bytes(line + b"\n" + content + line)
        capsys.readouterr(), caplog.clear()
        assert verbs.show_status(project, verbs.Wish("set")) == 0 and "a is odd" in capsys.readouterr().out
        assert make(project, targets=["total"], force=True) == 0
        if line not in (b"", b'{"event": "warning", "text": [1]}'):
            assert "damaged line" in caplog.text
            assert (project.build / "set" / "total" / "log.txt").read_text() == "6", "what the report is handed"


# ── rights ───────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def foreign(made_once, open_folder):
    """A checkout of somebody else's, with everything current."""
    checkout = toy.copy(made_once, open_folder / "checkout")
    assert call(checkout, "plan", "--dataset", "set") == 0  # loads what another user may not, as Python in root's home
    return checkout


def test_of_a_read_only_build_another_user_sees_everything_and_changes_nothing(foreign, as_other_user, capsys):
    for verb in ("plan", "why", "status", "validate"):
        with as_other_user():
            assert call(foreign, verb, "--dataset", "set") == 0
        assert capsys.readouterr().out
    for words in ("table -d set --set table.scale=3", "all -d set --force", "gc", "clean", "clean -d set"):
        with as_other_user():
            last = call(foreign, *words.split()).lower()
        assert last.startswith("error: ") and "permission denied" in last and str(foreign.build) in last, words


@pytest.mark.parametrize(
    "place",
    ["data/set", "data", "build", "build/set", "build/store/keys", "build/set/current.json", "pipeline.yaml", "stages"],
)
def test_what_may_not_be_read_is_said(foreign, as_other_user, place):
    (foreign.root / place).chmod(0)
    for verb in ("all", "plan", "status", "clean"):
        with as_other_user():
            last = call(foreign, verb, "--dataset", "set")
        assert last == 0 or last.startswith("error: "), verb
