"""Wrong results under a right key: what a step can read counts in its key, and is looked at again before its result is kept."""

import ast
from pathlib import Path

import pytest

from factorlib.errors import InputError
from factorlib.runner import verbs
from factorlib.runner.closure import Sources
from factorlib.runner.filehash import FileHashes
from factorlib.runner.project import LIBRARY
from tests.runner import toy
from tests.runner.toy import make_project, reasons, state, write


def make(project, **options):
    settings = {"targets": None, "settings": [], "force": False} | options
    return verbs.make(project, verbs.Wish("set", **settings))


@pytest.fixture
def project(tmp_path):
    return make_project(tmp_path / "root")


def editing(text, file, content):
    """The stage `text`, which writes `content` to `file` while it runs, as an editor beside it would."""
    return text.replace("(out /", f"Path({str(file)!r}).write_text({content!r})\n    (out /", 1).replace(
        "import json", "import json\nfrom pathlib import Path", 1
    )


# ── what changes while a step runs ───────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "name, file, content",
    [
        ("stages.table", "stages/table.py", toy.TABLE.replace("params.scale", "7")),
        ("toylib.more", "toylib/more.py", "NUMBER = 2\n"),
        ("stages:note.txt", "stages/note.txt", "other"),
    ],
)
def test_code_or_package_data_edited_while_a_step_runs_is_not_kept_under_the_old_key(
    project, capsys, name, file, content
):
    path = project.root / file
    write(project.root / "toylib" / "more.py", "NUMBER = 1\n")
    write(project.root / "stages" / "note.txt", "one")
    source = toy.TABLE.replace("import msgspec", "import msgspec\nfrom toylib import more")
    write(project.root / "stages" / "table.py", editing(source, path, content))
    assert make(project, targets=["table"]) == 1
    said = capsys.readouterr().err
    assert file in said and "changed while" in said and "run again" in said and "defect" not in said
    assert not list((project.build / "store").glob("keys/*")) and not list((project.build / "store").glob("trees/*"))


def test_a_stage_whose_code_was_edited_is_not_started_for_further_photos(project, capsys, monkeypatch):
    monkeypatch.setattr("factorlib.runner.executors.machine_cores", lambda: 1)
    path = project.root / "stages" / "count.py"
    write(path, editing(toy.COUNT, path, toy.COUNT + "\nMORE = 1\n"))
    assert make(project) == 1
    said = capsys.readouterr()
    assert said.err.count("changed while the run went on") == 1
    assert "1 step failed: count/a" in said.out and "not run for that: count" in said.out


def test_a_syntax_error_half_typed_while_a_step_runs_is_no_defect(project, capsys):
    write(project.root / "stages" / "table.py", editing(toy.TABLE, project.root / "stages" / "table.py", "def ("))
    assert make(project, targets=["table"]) == 1
    said = capsys.readouterr().err
    assert "stages/table.py" in said and "defect" not in said


def test_a_remark_typed_while_a_step_runs_loses_nothing(project):
    path = project.root / "stages" / "table.py"
    text = toy.TABLE.replace(
        "(out /", f"f = Path({str(path)!r}); f.write_text('# a remark\\n' + f.read_text())\n    (out /", 1
    )
    write(path, text.replace("import json", "import json\nfrom pathlib import Path", 1))
    assert make(project, targets=["table"]) == 0 and path.read_text().startswith("# a remark")


def test_code_edited_before_its_step_begins_stops_it_before_it_costs_anything(project, capsys):
    """The table edits a stage that comes after it."""
    later, sign = project.root / "stages" / "total.py", project.root / "it-ran"
    text = toy.TOTAL.replace("counts =", f"Path({str(sign)!r}).touch()\n    counts =")
    write(later, text)
    write(project.root / "stages" / "table.py", editing(toy.TABLE, later, text.replace("str(scale", "str(2 * scale")))
    assert make(project) == 1
    assert "stages/total.py" in capsys.readouterr().err and not sign.exists()
    assert make(project) == 0 and (project.build / "set" / "total" / "total.txt").read_text() == "total: 36"


# ── what counts ──────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", ["kernel.c", "table", "weights/w.json", "README.md", "lib.so"])
def test_every_file_in_the_package_of_a_module_counts_whatever_it_is_called(project, name):
    write(project.root / "toylib" / name, "1")
    assert make(project) == 0
    write(project.root / "toylib" / name, "2")
    assert reasons(project, "count/a") == [f"package data toylib:{name}: changed"]
    (project.root / "toylib" / name).unlink()
    assert reasons(project, "count/a") == [f"package data toylib:{name}: gone"]


@pytest.mark.parametrize(
    "name",
    [
        ".letters.py.swp",
        "letters.py~",
        "#letters.py#",
        ".hidden/x.c",
        "__pycache__/letters.cpython-311.pyc",
        "letters.pyc",
    ],
)
def test_what_python_or_an_editor_leaves_does_not_count(project, name):
    assert make(project) == 0
    write(project.root / "toylib" / name, "1")
    assert set(state(project).values()) == {"current"}


def test_the_kernel_of_the_reflection_networks_counts():
    sources = Sources([LIBRARY], FileHashes(None))
    for stage in ("train", "solve", "render", "refine"):
        closure = sources.closure("stages", stage, LIBRARY / "pipeline.yaml")
        assert "factorlib.reflection:kernel.c" in closure.data, stage
        assert {"factorlib.reflection.network", "factorlib.reflection.fused"} <= closure.modules.keys(), stage


def test_no_module_is_named_only_at_run_time():
    """`import_module(name)` hides a module from the keys of the steps that run it; the runner alone loads stages so.

    The package's own `__init__` hides `load_result` from every stage on purpose: no stage calls it, and all import the package.
    """
    runner, door = LIBRARY / "factorlib" / "runner", LIBRARY / "factorlib" / "__init__.py"
    files = [
        p
        for folder in ("factorlib", "stages")
        for p in (LIBRARY / folder).rglob("*.py")
        if runner not in p.parents and p != door
    ]
    assert not [p for p in (LIBRARY / "stages").glob("*.py") if "load_result" in p.read_text()]
    hidden = [
        f"{p}: {n.id if isinstance(n, ast.Name) else n.attr}"
        for p in files
        for n in ast.walk(ast.parse(p.read_text()))
        if _loads(n)
    ]
    assert not hidden


def _loads(node) -> bool:
    name = node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""
    return name in ("import_module", "__import__", "run_path", "run_module", "spec_from_file_location")


# ── what a module reads from the environment ─────────────────────────────────────────────────────────────────────────

SPEAKING = 'import os\nENVIRONMENT = ("TOY_FORM",)\nPROGRAMS = {"TOY_CC": "sh"}\ndef letters(text):\n    return len(text) if os.environ.get("TOY_FORM") == "0" else 1\n'


@pytest.fixture
def speaking(project, monkeypatch):
    """The toy whose letters depend on the environment, and say so."""
    for name in ("TOY_FORM", "TOY_CC"):
        monkeypatch.delenv(name, raising=False)
    write(project.root / "toylib" / "letters.py", SPEAKING)
    assert make(project) == 0
    return project


def test_an_environment_variable_that_a_module_declares_is_in_the_key(speaking, monkeypatch):
    assert (speaking.build / "set" / "total" / "total.txt").read_text() == "total: 4"
    monkeypatch.setenv("TOY_FORM", "0")
    assert reasons(speaking, "count/a") == ['environment variable TOY_FORM: none -> "0"']
    assert state(speaking)["upper/a"] == "current", "only what runs that module"
    assert make(speaking) == 0 and (speaking.build / "set" / "total" / "total.txt").read_text() == "total: 18"
    monkeypatch.delenv("TOY_FORM")
    assert set(state(speaking).values()) == {"current"}, "the other form's results are still there"


def test_whether_a_program_that_a_module_declares_is_there_is_in_the_key(speaking, monkeypatch):
    monkeypatch.setenv("TOY_CC", "no-such-program")
    assert reasons(speaking, "count/a") == ['program TOY_CC: "sh" -> none']
    monkeypatch.setenv("TOY_CC", "/bin/sh")
    assert set(state(speaking).values()) == {"current"}, "where it lies is no matter"


def test_a_command_that_no_shell_could_read_is_refused(speaking, monkeypatch):
    monkeypatch.setenv("TOY_CC", "sh 'open")
    with pytest.raises(InputError, match="is no command") as caught:
        state(speaking)
    assert caught.value.key == "TOY_CC"


def test_a_declaration_that_is_no_list_of_names_is_refused(project):
    write(project.root / "toylib" / "letters.py", SPEAKING.replace('("TOY_FORM",)', 'tuple(["TOY_FORM"])'))
    with pytest.raises(InputError, match="ENVIRONMENT") as caught:
        state(project)
    assert "letters.py" in str(caught.value)


def test_the_form_of_the_reflection_operator_is_in_the_keys_of_what_runs_it():
    sources = Sources([LIBRARY], FileHashes(None))
    for stage in ("solve", "render", "refine"):
        closure = sources.closure("stages", stage, Path("pipeline.yaml"))
        assert "FACTORLIB_FUSED" in closure.environment and closure.programs["CC"] == "cc", stage
    assert not sources.closure("stages", "masks", Path("pipeline.yaml")).environment
