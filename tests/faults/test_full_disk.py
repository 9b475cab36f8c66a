"""A full disk and a folder that may not be written: said as the user's to mend, nothing cut is kept, and the next run goes on."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from factorlib import __main__ as command_line
from factorlib.disk import disk_error
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY
from tests.runner import toy
from tests.runner.toy import files_of, make_project, write

LARGE = "(out / 'large.bin').write_bytes(bytes(200_000))\n    (out /"
STRANGE = "raise RuntimeError('a library: I/O error: No space left on device (os error 28)')\n    (out /"


def make(project, **options):
    settings = {"targets": None, "settings": [], "force": False} | options
    return verbs.make(project, verbs.Wish("set", **settings))


class Disk:
    """A file system in memory of a given size."""

    def __init__(self, folder: Path):
        self.folder = folder

    def mount(self, size: int) -> None:
        self._call("mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", self.folder)

    def become(self, options: str) -> None:
        self._call("mount", "-o", f"remount,{options}", self.folder)

    def unmount(self) -> None:
        subprocess.run(["umount", "-l", self.folder], check=False, capture_output=True)

    def fill(self, but: int) -> None:
        """Leave so many bytes free, in whole pages."""
        free = shutil.disk_usage(self.folder).free
        (self.folder / "ballast").write_bytes(bytes(max(0, free - but)))

    def _call(self, *words) -> None:
        subprocess.run(list(map(str, words)), check=True, capture_output=True)


@pytest.fixture
def disk(tmp_path):
    made = Disk(tmp_path / "disk")
    made.folder.mkdir()
    try:
        made.mount(8_000_000)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("mounting a small file system needs root")
    yield made
    made.unmount()


@pytest.fixture
def project(disk, tmp_path):
    """The toy with its build/ on a small disk; its table is large."""
    made = make_project(tmp_path / "root")
    write(made.root / "stages" / "table.py", toy.TABLE.replace("(out /", LARGE, 1))
    made.build.symlink_to(disk.folder)
    return made


@pytest.fixture(scope="module")
def made_once(tmp_path_factory):
    made = make_project(tmp_path_factory.mktemp("toy") / "root")
    assert make(made) == 0
    return made


def said_well(text: str, folder: str = "disk") -> bool:
    return "MB are free" in text and folder in text and "Traceback" not in text and "defect" not in text


def run_as_command(project, monkeypatch, *words) -> str:
    """What `python -m factorlib` ends with."""
    monkeypatch.setattr(command_line, "project", lambda: project)
    monkeypatch.setattr(sys, "argv", ["factorlib", *words])
    with pytest.raises(SystemExit) as caught:
        command_line.main()
    return str(caught.value.code)


def test_a_step_that_finds_the_disk_full_says_so_and_goes_on_when_there_is_room(project, disk, capsys):
    disk.fill(but=120_000)
    assert make(project, targets=["table"]) == 1
    said = capsys.readouterr().err
    assert "error: table: " in said and "the disk is full" in said and said_well(said)
    assert not list((disk.folder / "store").glob("trees/*")) and not list((disk.folder / "store").glob("keys/*"))
    assert not list((disk.folder / "set").glob("errors/*"))
    (disk.folder / "ballast").unlink()
    assert make(project) == 0 and verbs.verify(project, None) == 0
    assert (project.build / "set" / "total" / "total.txt").read_text() == "total: 18"


def test_a_library_that_says_it_in_words_of_its_own(made_once, tmp_path, capsys):
    project = toy.copy(made_once, tmp_path / "root")
    write(project.root / "stages" / "table.py", toy.TABLE.replace("(out /", STRANGE, 1))
    assert make(project, targets=["table"]) == 1
    said = capsys.readouterr().err
    assert "the disk is full" in said and said_well(said, "root")


def test_a_disk_that_is_full_before_the_run_begins(project, disk, monkeypatch):
    disk.fill(but=0)
    said = run_as_command(project, monkeypatch, "all", "--dataset", "set")
    assert said.startswith("error: ") and "the disk is full" in said and said_well(said)


@pytest.mark.long
@pytest.mark.parametrize("free", range(0, 400_000, 40_000))
def test_wherever_the_disk_becomes_full_the_next_run_ends_in_the_same_bytes(project, disk, monkeypatch, free):
    disk.fill(but=free)
    said = run_as_command(project, monkeypatch, "all", "--dataset", "set")
    assert said in ("0", "1") or said_well(said)
    assert verbs.verify(project, None) == 0, "something cut was kept"
    (disk.folder / "ballast").unlink()
    assert make(project) == 0 and verbs.verify(project, None) == 0
    found = files_of(project.build / "set" / "table") | files_of(project.build / "set" / "upper")
    whole = make_project(project.root.parent / "whole")
    write(whole.root / "stages" / "table.py", toy.TABLE.replace("(out /", LARGE, 1))
    assert make(whole) == 0
    assert found == files_of(whole.build / "set" / "table") | files_of(whole.build / "set" / "upper")


def test_a_read_only_build_shows_everything_and_runs_nothing(project, disk, monkeypatch):
    assert make(project) == 0
    disk.become("ro")
    assert run_as_command(project, monkeypatch, "all", "--dataset", "set") == "0"
    for verb in ("plan", "why", "status", "validate"):
        assert run_as_command(project, monkeypatch, verb, "--dataset", "set") == "0", verb
    assert run_as_command(project, monkeypatch, "verify") == "0"
    write(project.root / "data" / "set" / "a.txt", "another")
    said = run_as_command(project, monkeypatch, "all", "--dataset", "set")
    assert said.startswith("error: ") and "read-only" in said and said_well(said)
    disk.become("rw")
    assert make(project) == 0


@pytest.mark.parametrize(
    "closed",
    [
        "store/trees",
        "set",
        "store/cache",
        *(pytest.param(name, marks=pytest.mark.long) for name in ("store/keys", "store/tmp", "store/logs", ".")),
    ],
)
def test_a_build_that_the_user_may_not_write(made_once, tmp_path, closed):
    project = toy.copy(made_once, tmp_path / "root")
    write(project.root / "data" / "set" / "a.txt", "another")
    (project.build / closed).chmod(0o555)
    try:
        said = without_rights(project)
    finally:
        (project.build / closed).chmod(0o755)
    if closed in (".", "store/cache"):
        assert said.returncode == 0, "nothing is written into build itself, and a cache can be done without"
        return
    assert said.returncode != 0 and "permission denied" in said.stdout, said.stdout
    assert said_well(said.stdout, f"build/{closed}"), said.stdout
    assert make(project) == 0 and verbs.verify(project, None) == 0


def without_rights(project):
    """A run of somebody who is not root, or as root that has given up to write where it pleases."""
    code = (
        "import sys; from pathlib import Path; from factorlib import __main__ as command_line; from tests.runner import toy;"
        "root = Path(sys.argv.pop(1)); command_line.project = lambda: toy.toy(root); command_line.main()"
    )
    drop = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    if drop and shutil.which("setpriv") is None:
        pytest.skip("setpriv is not there, and root may write everywhere")
    command = [*drop, sys.executable, "-c", code, str(project.root), "all", "--dataset", "set"]
    environment = {**os.environ, "PYTHONPATH": str(LIBRARY), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=60
    )


def test_a_file_that_may_not_be_read_is_no_full_folder(tmp_path, monkeypatch):
    path = tmp_path / "photo.txt"
    path.write_text("1")
    monkeypatch.setattr(os, "access", lambda *_: False)
    said = str(disk_error(PermissionError(13, "Permission denied", str(path)), tmp_path))
    assert "it may not be read" in said and "photo.txt" in said


def test_a_defect_stays_a_defect(tmp_path):
    assert disk_error(ValueError("x"), tmp_path) is None
    assert disk_error(FileNotFoundError(2, "No such file", "x"), tmp_path) is None
    defect = KeyError("a defect while another error was handled")
    defect.__context__ = PermissionError(13, "Permission denied", "x")
    assert disk_error(defect, tmp_path) is None


# ── what is left of a failure ────────────────────────────────────────────────────────────────────────────────────────


def test_the_traceback_of_a_failure_goes_once_its_step_succeeds(made_once, tmp_path):
    project = toy.copy(made_once, tmp_path / "root")
    errors = project.build / "set" / "errors"
    write(project.root / "stages" / "table.py", toy.TABLE.replace("json.dumps(params.scale)", "json.dumps(1 / 0)"))
    assert make(project) == 1 and [path.name for path in errors.iterdir()] == ["table.txt"]
    assert make(project, targets=["count"]) == 0 and errors.exists(), "the table has not succeeded"
    write(project.root / "stages" / "table.py", toy.TABLE.replace("params.scale", "2 * params.scale"))
    assert make(project, targets=["table"]) == 0 and not errors.exists()


def test_the_traceback_goes_too_where_the_code_is_as_it_was_before(made_once, tmp_path):
    project = toy.copy(made_once, tmp_path / "root")
    write(project.root / "stages" / "table.py", toy.TABLE.replace("json.dumps(params.scale)", "json.dumps(1 / 0)"))
    assert make(project) == 1 and (project.build / "set" / "errors" / "table.txt").exists()
    write(project.root / "stages" / "table.py", toy.TABLE)
    assert make(project) == 0 and not (project.build / "set" / "errors").exists()
