"""A disk that becomes full, a quota that is used up and a limit on files, at every stage of a run: said as the user's to mend, nothing lost.

Without root's privileges (`setpriv`), which pass limits and rights.  The disk is a small file system in memory; the quota a library
that says EDQUOT (`quota.c`), for which a C compiler is needed.
"""

from __future__ import annotations

import os
import resource
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from faults import battered
from faults.battered import STAGES, lost_in, make, results, slow_project
from faults.test_full_disk import Disk
from faults.tries import note

from factorlib.runner.project import LIBRARY
from tests.runner.toy import write

SIZE = 100_000  # bytes that each stage writes beside its result
HUGE = "    (out / f'large-{{inputs.photo}}.bin').write_bytes(bytes({0}))\n    write(out /"
WORDS = {"disk": "the disk is full", "quota": "the disk quota is used up", "limit": "no file may become that large"}
COMMAND = (
    "import sys; from pathlib import Path; from factorlib import __main__ as line; from tests.runner import toy;"
    "root = Path(sys.argv.pop(1)); line.project = lambda: toy.toy(root); line.main()"
)
SHORT = ("table", "upper")  # the rest in `make test-long`


def heavy(root, stage):
    """The toy, one of whose stages writes more than there is room for."""
    made = slow_project(root)
    path = root / "stages" / f"{stage}.py"
    write(path, path.read_text().replace("    write(out /", HUGE.format(SIZE), 1))
    return made


def command(project):
    """A run by one who is nobody special, though root may own the files."""
    words = [sys.executable, "-c", COMMAND, str(project.root), "all", "--dataset", "set"]
    if os.geteuid() != 0:
        return words
    if shutil.which("setpriv") is None:
        pytest.skip("setpriv is not there, and root may write everywhere")
    return ["setpriv", "--bounding-set", "-all", "--inh-caps", "-all", *words]


def run(project, **more):
    environment = {**os.environ, "PYTHONPATH": str(LIBRARY), "PYTHONDONTWRITEBYTECODE": "1"} | more.pop("env", {})
    return subprocess.run(
        command(project),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
        check=False,
        **more,
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """By stage, the results of a run that had room."""
    found = {}

    def of(stage):
        if stage not in found:
            made = heavy(tmp_path_factory.mktemp("whole") / "root", stage)
            assert make(made) == 0
            found[stage] = results(made)
        return found[stage]

    return of


def check(what, stage, project, done, wanted):
    """It was said, of that stage and as what it is; with room again the run goes on."""
    said = done.stdout
    assert done.returncode == 1 and f"error: {stage}" in said and WORDS[what] in said and "MB are free" in said, said
    assert "Traceback" not in said and "defect" not in said
    assert not any((project.build / "store" / "tmp").iterdir()) and stage not in {
        step.partition("/")[0] for step in battered.kept(project).values()
    }
    losses = lost_in(project, wanted)
    note(
        "faults",
        {"disk": "a disk that is full", "quota": "a quota that is used up", "limit": "a limit on the size of files"}[
            what
        ],
        1,
        int(bool(losses)),
        stages={stage: 1},
    )
    assert not losses


stages = pytest.mark.parametrize(
    "stage", [stage if stage in SHORT else pytest.param(stage, marks=pytest.mark.long) for stage in STAGES]
)


@stages
def test_a_disk_that_is_full(tmp_path, whole, stage):
    disk = Disk(tmp_path / "disk")
    disk.folder.mkdir()
    try:
        disk.mount(4_000_000)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("mounting a small file system needs root")
    try:
        project = heavy(tmp_path / "root", stage)
        project.build.symlink_to(disk.folder)
        before = make_above(project, stage)
        disk.fill(but=SIZE // 2)
        done = run(project)
        (disk.folder / "ballast").unlink()
        assert before <= set(battered.kept(project).values())
        check("disk", stage, project, done, whole(stage))
    finally:
        disk.unmount()


def make_above(project, stage):
    """What the stage takes is made while there is room."""
    from factorlib.runner import verbs

    above = {"upper": ["table"], "count": ["upper", "table"], "table": ["count"], "total": ["count", "table"]}[stage]
    assert verbs.make(project, verbs.Wish("set", above)) == 0
    return set(battered.kept(project).values())


@stages
def test_a_quota_that_is_used_up(tmp_path, whole, stage):
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("the quota is a library in C")
    library, left = tmp_path / "quota.so", tmp_path / "left"
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", library, Path(__file__).with_name("quota.c"), "-ldl"], check=True
    )
    left.write_bytes(struct.pack("<q", SIZE // 2))
    project = heavy(tmp_path / "root", stage)
    make_above(project, stage)
    done = run(project, env={"LD_PRELOAD": str(library), "QUOTA_FOLDER": str(project.build), "QUOTA_FILE": str(left)})
    check("quota", stage, project, done, whole(stage))


@stages
def test_a_limit_on_files(tmp_path, whole, stage):
    project = heavy(tmp_path / "root", stage)
    make_above(project, stage)
    done = run(project, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (SIZE // 2, SIZE // 2)))
    check("limit", stage, project, done, whole(stage))


@pytest.mark.long
@pytest.mark.parametrize("left", range(0, 30_000, 1500))
def test_wherever_a_quota_ends_nothing_is_lost(tmp_path, left):
    """In results, keys, logs, links and caches: of all that a run writes."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("the quota is a library in C")
    library, file = tmp_path / "quota.so", tmp_path / "left"
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", library, Path(__file__).with_name("quota.c"), "-ldl"], check=True
    )
    file.write_bytes(struct.pack("<q", left))
    project, usual = slow_project(tmp_path / "root"), slow_project(tmp_path / "usual")
    assert make(usual) == 0
    done = run(project, env={"LD_PRELOAD": str(library), "QUOTA_FOLDER": str(project.build), "QUOTA_FILE": str(file)})
    said = (WORDS["quota"] in done.stdout and "Traceback" not in done.stdout) or done.returncode == 0
    losses = [*([] if said else [done.stdout]), *lost_in(project, results(usual))]
    note("faults", "a quota that ends anywhere", 1, int(bool(losses)))
    assert not losses
