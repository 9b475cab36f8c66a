"""A full disk, a quota, a limit, folders that may not be written: the user's to mend; nothing cut is kept.

Runs go without root's privileges (`setpriv`), which pass limits and rights.  The disk is a small file system in memory;
the quota a library that says EDQUOT (`quota.c`), for which a C compiler is needed.
"""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from factorlib.disk import disk_error
from factorlib.runner import verbs
from factorlib.runner.project import LIBRARY
from tests.faults.battered import COMMAND, STAGES, call, kept, lost_in, make, results, slow_project
from tests.faults.tries import note
from tests.runner import toy
from tests.runner.toy import write

SIZE = 100_000  # bytes that a heavy stage writes beside its result
HEAVY = "    (out / f'large-{{inputs.photo}}.bin').write_bytes(bytes({0}))\n    write(out /"
ABOVE = {"upper": ["table"], "count": ["upper", "table"], "table": ["count"], "total": ["count", "table"]}
KINDS = {  # name in the table -> words of the error
    "a disk that is full": "the disk is full",
    "a quota that is used up": "the disk quota is used up",
    "a limit on the size of files": "no file may become that large",
}


class Disk:
    """A file system in memory, mounted on a folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def become(self, options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", self.folder], check=True, capture_output=True)

    def fill(self, but: int) -> None:
        """Leave so many bytes free, in whole pages."""
        free = shutil.disk_usage(self.folder).free
        (self.folder / "ballast").write_bytes(bytes(max(0, free - but)))

    def empty(self) -> None:
        (self.folder / "ballast").unlink(missing_ok=True)


@contextlib.contextmanager
def mounted(folder: Path, size: int = 4_000_000):
    folder.mkdir()
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("mounting a small file system needs root")
    try:
        yield Disk(folder)
    finally:
        subprocess.run(["umount", "-l", folder], check=False, capture_output=True)


@pytest.fixture
def disk(tmp_path):
    with mounted(tmp_path / "disk") as made:
        yield made


@pytest.fixture(scope="module")
def quota(tmp_path_factory):
    """A file with the bytes that are left, and the variables under which a run of a project finds no more."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("the quota is a library in C")
    folder = tmp_path_factory.mktemp("quota")
    library, source = folder / "quota.so", Path(__file__).with_name("quota.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)

    def of(project, left: int) -> dict[str, str]:
        (folder / "left").write_bytes(struct.pack("<q", left))
        return {"LD_PRELOAD": str(library), "QUOTA_FOLDER": str(project.build), "QUOTA_FILE": str(folder / "left")}

    return of


def heavy(root, stage):
    """The toy, one of whose stages writes more than there is room for."""
    made = slow_project(root)
    path = root / "stages" / f"{stage}.py"
    write(path, path.read_text().replace("    write(out /", HEAVY.format(SIZE), 1))
    return made


def run(project, environment=None, **more):
    """`make all` by one who is nobody special, though root may own the files."""
    command = [sys.executable, "-c", COMMAND, str(project.root), "all", "--dataset", "set"]
    if os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("setpriv is not there, and root may write everywhere")
        command = ["setpriv", "--bounding-set", "-all", "--inh-caps", "-all", *command]
    set_ = {**os.environ, "PYTHONPATH": str(LIBRARY), "PYTHONDONTWRITEBYTECODE": "1"} | (environment or {})
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.run(command, env=set_, timeout=120, check=False, **pipes, **more)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """By stage, the results of a run of its heavy toy that had room."""
    known = {}

    def of(stage):
        if stage not in known:
            made = heavy(tmp_path_factory.mktemp("whole") / "root", stage)
            assert make(made) == 0
            known[stage] = results(made)
        return known[stage]

    return of


def is_said(text: str, folder: str = "") -> bool:
    """Whether a text tells a user what to mend, and where."""
    return "MB are free" in text and folder in text and "Traceback" not in text and "defect" not in text


SHORT = [*(("table", kind) for kind in KINDS), ("upper", "a disk that is full")]  # the rest in `make test-long`


@pytest.mark.parametrize("stage, kind", [
    pytest.param(stage, kind, marks=() if (stage, kind) in SHORT else pytest.mark.long) for stage in STAGES for kind in KINDS
])  # fmt: skip
def test_no_room_is_said_as_what_it_is_and_with_room_the_run_goes_on(tmp_path, whole, request, stage, kind):
    project, disk = heavy(tmp_path / "root", stage), None
    if kind == "a disk that is full":
        disk = request.getfixturevalue("disk")
        project.build.symlink_to(disk.folder)
    assert make(project, targets=ABOVE[stage]) == 0
    before = set(kept(project).values())
    if disk:
        disk.fill(but=SIZE // 2)
        ended = run(project)
        disk.empty()
    elif kind == "a quota that is used up":
        ended = run(project, request.getfixturevalue("quota")(project, SIZE // 2))
    else:
        ended = run(project, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (SIZE // 2, SIZE // 2)))
    text = ended.stdout
    assert ended.returncode == 1 and f"error: {stage}" in text and KINDS[kind] in text and is_said(text), text
    assert before <= set(kept(project).values())
    assert stage not in {step.partition("/")[0] for step in kept(project).values()}
    assert not any((project.build / "store" / "tmp").iterdir()) and not list((project.build / "set").glob("errors/*"))
    losses = lost_in(project, whole(stage))
    note("faults", kind, 1, int(bool(losses)), stages={stage: 1})
    assert not losses


@pytest.mark.long
@pytest.mark.parametrize("left", range(0, 30_000, 1500))
def test_wherever_a_quota_ends_nothing_is_lost(tmp_path, quota, left):
    """In results, keys, logs, links and caches: of all that a run writes."""
    project, usual = slow_project(tmp_path / "root"), slow_project(tmp_path / "usual")
    assert make(usual) == 0
    ended = run(project, quota(project, left))
    expected = ended.returncode == 0 or (KINDS["a quota that is used up"] in ended.stdout and is_said(ended.stdout))
    losses = [*([] if expected else [ended.stdout]), *lost_in(project, results(usual))]
    note("faults", "a quota that ends anywhere", 1, int(bool(losses)))
    assert not losses


@pytest.mark.parametrize(
    "free", [0, *(pytest.param(free, marks=pytest.mark.long) for free in range(40_000, 400_000, 40_000))]
)
def test_wherever_the_disk_becomes_full_the_next_run_ends_in_the_same_bytes(tmp_path, disk, whole, free):
    project = heavy(tmp_path / "root", "table")
    project.build.symlink_to(disk.folder)
    disk.fill(but=free)
    last = str(call(project, "all", "--dataset", "set"))
    assert last in ("0", "1") or is_said(last, "disk")
    assert free or (last.startswith("error: ") and "the disk is full" in last)
    disk.empty()
    assert not lost_in(project, whole("table"))


def test_a_library_that_says_in_words_of_its_own_that_the_disk_is_full(project, capsys):
    strange = "raise RuntimeError('a library: I/O error: No space left on device (os error 28)')\n    (out /"
    write(project.root / "stages" / "table.py", toy.TABLE.replace("(out /", strange, 1))
    assert make(project, targets=["table"]) == 1
    text = capsys.readouterr().err
    assert "the disk is full" in text and is_said(text, "checkout")


def test_a_read_only_build_shows_everything_and_runs_nothing(tmp_path, disk):
    project = toy.make_project(tmp_path / "root")
    project.build.symlink_to(disk.folder)
    assert make(project) == 0
    disk.become("ro")
    for verb in ("all", "plan", "why", "status", "validate", "verify"):
        assert call(project, verb, "--dataset", "set") == 0, verb
    write(project.root / "data" / "set" / "a.txt", "another")
    last = call(project, "all", "--dataset", "set")
    assert last.startswith("error: ") and "read-only" in last and is_said(last, "disk")
    disk.become("rw")
    assert make(project) == 0


QUICK = ("store/trees", "set", "store/cache")


@pytest.mark.parametrize("closed", [
    *QUICK, *(pytest.param(name, marks=pytest.mark.long) for name in ("store/keys", "store/tmp", "store/logs", "."))
])  # fmt: skip
def test_a_build_that_the_user_may_not_write(project, closed):
    if not (project.build / closed).exists():
        pytest.skip("this store has no such folder")
    write(project.root / "data" / "set" / "a.txt", "another")
    (project.build / closed).chmod(0o555)
    try:
        ended = run(project)
    finally:
        (project.build / closed).chmod(0o755)
    if closed in (".", "store/cache"):
        assert ended.returncode == 0, "nothing is written into build itself, and a cache can be done without"
        return
    assert ended.returncode != 0 and "permission denied" in ended.stdout, ended.stdout
    assert is_said(ended.stdout, f"build/{closed}"), ended.stdout
    assert make(project) == 0 and verbs.verify(project, None) == 0


def test_a_file_that_may_not_be_read_is_no_full_folder_and_a_defect_stays_a_defect(tmp_path, monkeypatch):
    path = tmp_path / "photo.txt"
    path.write_text("1")
    monkeypatch.setattr(os, "access", lambda *_: False)
    text = str(disk_error(PermissionError(13, "Permission denied", str(path)), tmp_path))
    assert "it may not be read" in text and "photo.txt" in text
    defect = KeyError("a defect while another error was handled")
    defect.__context__ = PermissionError(13, "Permission denied", "x")
    for error in (ValueError("x"), FileNotFoundError(2, "No such file", "x"), defect):
        assert disk_error(error, tmp_path) is None


def test_the_traceback_of_a_failure_goes_once_its_step_succeeds_even_by_code_of_before(project):
    errors, path = project.build / "set" / "errors", project.root / "stages" / "table.py"
    broken = toy.TABLE.replace("json.dumps(params.scale)", "json.dumps(1 / 0)")
    for mended in (toy.TABLE.replace("params.scale", "2 * params.scale"), toy.TABLE):
        write(path, broken)
        assert make(project) == 1 and [error.name for error in errors.iterdir()] == ["table.txt"]
        assert make(project, targets=["count"]) == 0 and errors.exists(), "the table has not succeeded"
        write(path, mended)
        assert make(project, targets=["table"]) == 0 and not errors.exists()
