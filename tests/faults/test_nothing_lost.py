"""Whatever befalls a run, what was finished is kept and the next run ends in the same bytes.

With real processes and a seed for each try.  `make test` makes a few tries of each fault, `make test-long` all of them, which
are the numbers of docs/reliability.md (`make results ONLY=faults`).
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from factorlib.runner import verbs
from factorlib.runner.gc import collect
from factorlib.runner.project import LIBRARY
from tests.faults.battered import (
    PAUSE,
    STAGES,
    done,
    end,
    half_written,
    kept,
    kill,
    lost_in,
    make,
    new_runs,
    results,
    slow_project,
    start,
    wait_until,
    workers,
)
from tests.faults.tries import note
from tests.runner import toy
from tests.runner.toy import state, write

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
WHOM = ("all of its processes", "the run", "one that is at work")
few = lambda some, most: pytest.mark.parametrize(  # noqa: E731
    "seeds", [range(some), pytest.param(range(some, most), marks=pytest.mark.long)], ids=str
)


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """The toy, nothing made yet."""
    return slow_project(tmp_path_factory.mktemp("toy") / "root")


@pytest.fixture(scope="module")
def finished(fresh, tmp_path_factory):
    """The toy, everything made by a run that nothing befell."""
    made = toy.copy(fresh, tmp_path_factory.mktemp("toy") / "root")
    assert make(made) == 0
    return made


@pytest.fixture
def again(tmp_path):
    """A project of the same content in a folder of its own, for each try."""
    count = iter(range(1000))
    return lambda project: toy.copy(project, tmp_path / f"try {next(count)}")


def no_loss(fault, losses, stages=None):
    """Every try lost nothing; all of them are noted."""
    note("faults", fault, len(losses), sum(map(bool, losses)), stages=stages)
    assert not any(losses), [(number, lost) for number, lost in enumerate(losses) if lost]


def edit(project, stage, old, new):
    path = project.root / "stages" / f"{stage}.py"
    write(path, path.read_text().replace(old, new, 1))


# ── SIGKILL and SIGTERM ──────────────────────────────────────────────────────────────────────────────────────────────


@few(3, 100)
def test_a_kill_at_any_moment_loses_nothing_that_was_finished(fresh, finished, again, seeds):
    """Two of three tries wait until a stage is writing, and strike in that time; the third strikes at any time."""
    wanted, hits, losses = results(finished), dict.fromkeys(STAGES, 0), {whom: [] for whom in WHOM}
    for seed in seeds:
        project = again(fresh)
        for stage in struck(project, seed, WHOM[seed % 3]):
            hits[stage] += 1
        losses[WHOM[seed % 3]].append(lost_in(project, wanted))
        shutil.rmtree(project.root)
    for whom, each in losses.items():
        no_loss(f"SIGKILL to {whom}", each)
    note("hits", "mid-write", sum(hits.values()), stages=hits)
    assert len(seeds) < 50 or min(hits.values()) >= 5, hits


def struck(project, seed, whom):
    """A run that is killed; the stages that were writing just then."""
    chance = random.Random(seed)
    stage = STAGES[seed // 3 % 4] if seed % 9 < 6 else None
    process = start(project)
    if stage is not None:
        assert wait_until(lambda: stage in half_written(project) or process.poll() is not None)
        time.sleep(chance.uniform(0, 6 * PAUSE))
    else:
        time.sleep(chance.uniform(0, 3))
    writing = half_written(project)
    writing -= {step.partition("/")[0] for step in kept(project).values()} - {stage}
    kill(process, whom)
    end(process)
    return writing


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one processor runs one step at a time")
def test_a_killed_worker_does_not_fail_the_step_beside_it(tmp_path):
    project, go = toy.make_project(tmp_path), tmp_path / "go"
    toy.wait_for(project, go)
    process = start(project)
    assert wait_until(lambda: at_work(project, "upper-a") and at_work(project, "upper-b"))
    os.kill(workers(process.pid)[0], signal.SIGKILL)
    go.touch()
    text = process.communicate(timeout=60)[0]
    assert process.returncode == 1 and text.count("process died") == 1 and "1 step failed" in text
    made = state(project)
    assert sorted(made[f"upper/{photo}"] for photo in "ab") == ["current", "to run"]
    assert len([step for step in done(project) if step.startswith("upper")]) == 1, "the step beside it ran again"


def at_work(project, step):
    return list((project.build / "store" / "tmp").glob(f"run-*/{step}/*"))


C_STACK = """
import ctypes, os, signal
libc = ctypes.CDLL(None)
@ctypes.CFUNCTYPE(None, ctypes.c_int)
def _c_stack(number):
    os.write(2, b"*** SIGTERM received by PID 1; stack trace: ***\\n")
    os._exit(1)
libc.signal(signal.SIGTERM, _c_stack)  # what pycolmap does where it is imported
"""


@pytest.mark.parametrize("whom", WHOM[:2])
def test_sigterm_ends_a_run_as_an_interrupt_does_and_no_library_that_takes_it_prints_a_stack(tmp_path, whom):
    project = toy.make_project(tmp_path)
    write(project.root / "stages" / "upper.py", toy.UPPER.replace("class Params", C_STACK + "class Params", 1))
    process = start(project, "upper.sleep=30")
    assert wait_until(lambda: at_work(project, "upper-a"))
    os.kill(process.pid if whom == "the run" else -process.pid, signal.SIGTERM)
    text = process.communicate(timeout=60)[0]
    assert end(process) == 143 and "stopped; what was finished is kept" in text
    assert not any(words in text for words in ("Traceback", "process died", "stack trace"))
    assert not list((project.build / "store" / "tmp").iterdir())


def test_a_reader_that_takes_sigterm_prints_no_c_stack():
    """pycolmap itself, as reading cameras of a COLMAP model imports it."""
    code = (
        "import os, signal, factorlib.runner.stop as stop\n"
        "with stop.heed_stops():\n"
        "    import pycolmap; stop.take_sigterm_back(); os.kill(os.getpid(), signal.SIGTERM)"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=LIBRARY, capture_output=True, text=True, check=False)
    assert ended.returncode == 143 and not ended.stderr


def test_drafts_of_killed_writers_go_once_they_are_old_and_those_of_others_stay(finished, again):
    project, gone = again(finished), subprocess.Popen(["true"])
    gone.wait()
    folders = [project.build / "set", *(project.build / "store" / name for name in ("keys", "logs", "cache"))]
    pids = {"old": gone.pid, "new": gone.pid, "own": os.getpid()}
    drafts = {name: [folder / f".{name}.json.{pid}" for folder in folders] for name, pid in pids.items()}
    for name, path in ((name, path) for name, paths in drafts.items() for path in paths):
        write(path, "{")
        os.utime(path, (time.time() - 7200 * (name != "new"),) * 2)
    link = project.build / "set" / f".upper.{os.getppid()}"  # that another run is about to rename
    link.symlink_to("../store", target_is_directory=True)
    write(project.root / "data" / "set" / "c.txt", "Gamma")
    assert make(project) == 0 and link.is_symlink()
    there = {name for name, paths in drafts.items() for path in paths if path.exists()}
    assert there == {"new", "own"} and all(path.exists() for name in there for path in drafts[name])


# ── two runs, inputs, clocks, places ─────────────────────────────────────────────────────────────────────────────────


@few(1, 12)
def test_runs_at_the_same_time_do_the_work_once(fresh, finished, again, seeds):
    losses = []
    for seed in seeds:
        chance, project, runs = random.Random(seed), again(fresh), []
        for _ in range(2 + seed % 2):
            runs.append(start(project))
            time.sleep(chance.uniform(0, 0.8))
        codes = [end(run) for run in runs]
        twice = sorted(step for step in set(done(project)) if done(project).count(step) > 1)
        losses.append([*([f"ended with {codes}"] if any(codes) else []), *twice, *lost_in(project, results(finished))])
    no_loss("two or three runs at once", losses)


@few(1, 12)
def test_a_photo_that_vanishes_in_mid_run_is_named_and_costs_its_own_steps(fresh, finished, again, seeds):
    losses = []
    for seed in seeds:
        chance, project = random.Random(seed), again(fresh)
        photo = project.root / "data" / "set" / f"{'ab'[seed % 2]}.txt"
        content, process = photo.read_bytes(), start(project)
        wait_until(partial(half_written, project), seconds=20)
        time.sleep(chance.uniform(0, 0.3))
        photo.unlink()
        text = process.communicate(timeout=60)[0]
        photo.write_bytes(content)
        named = process.returncode == 0 or (photo.name in text and "defect" not in text and "Traceback" not in text)
        losses.append([*([] if named else [text]), *lost_in(project, results(finished))])
    no_loss("a photo that vanishes in mid-run", losses)


@pytest.mark.parametrize("stage, what, code", [
    ("upper", "a.txt", "inputs.file('a.txt').unlink() if inputs.photo == 'a' else None"),
    ("total", "table", "__import__('shutil').rmtree(inputs['table'], ignore_errors=True) if not {once}.exists() else None; {once}.touch()"),
])  # fmt: skip
def test_what_vanishes_as_it_is_read_is_no_defect_and_costs_what_reads_it(
    fresh, finished, again, capfd, stage, what, code
):
    """A photo, and a result of the store, which is made again."""
    project = again(fresh)
    once = f"__import__('pathlib').Path({str(project.root / 'once')!r})"
    read = "    text =" if stage == "upper" else "    counts ="
    edit(project, stage, read, f"    {code.format(once=once)}\n{read}")
    assert make(project) == 1
    text = capfd.readouterr().err
    assert what in text and "changed while it was being read" in text and "defect" not in text
    assert "upper/b" in kept(project).values()
    if stage == "total":
        assert make(project) == 0 and verbs.verify(project, None) == 0
        total = "set/total/total.txt"
        assert (project.build / total).read_bytes() == (finished.build / total).read_bytes()


CLOCK = "import time\n_now, _now_ns = time.time, time.time_ns\ntime.time = lambda: _now() - {0}\ntime.time_ns = lambda: _now_ns() - {0} * 10**9\n"


@pytest.mark.parametrize("days", [1, *(pytest.param(days, marks=pytest.mark.long) for days in (400, -1, -4000))])
def test_a_clock_that_goes_back_loses_nothing_and_hides_no_edit(finished, again, tmp_path, days):
    """All files are from the future, and what is edited now is older than what is remembered."""
    project, seconds = again(finished), days * 86400
    write(tmp_path / "clock" / "sitecustomize.py", CLOCK.format(seconds))
    path, before = f"{tmp_path / 'clock'}{os.pathsep}{LIBRARY}", len(done(project))
    assert end(start(project, PYTHONPATH=path)) == 0 and len(done(project)) == before, "nothing to do"
    photo, more = (project.root / "data" / "set" / f"{name}.txt" for name in "ac")
    write(photo, photo.read_text().swapcase())
    os.utime(photo, (time.time() - seconds,) * 2)
    write(more, "Gamma")
    assert end(start(project, PYTHONPATH=path)) == 0
    ran = sorted(done(project)[before:])
    write(photo, photo.read_text().swapcase())
    more.unlink()
    wrong = [] if ran == ["count/c", "total", "upper/a", "upper/c"] else ran
    no_loss("a clock that goes back", [wrong + lost_in(project, results(finished))])


@few(1, 3)
def test_a_checkout_that_is_moved_in_mid_life_keeps_its_keys(fresh, finished, again, tmp_path, seeds):
    """Killed here, moved, and finished there."""
    losses = []
    for seed in seeds:
        project, moved = again(fresh), toy.toy(tmp_path / f"moved {seed}")
        struck(project, seed, "all of its processes")
        shutil.move(project.root, moved.root)
        losses.append([*lost_in(moved, results(finished)), *(set(kept(finished)) ^ set(kept(moved)))])
    no_loss("a checkout that is moved", losses)


GONE = [".", "set", "store", *(f"store/{name}" for name in ["trees", "keys", "views", "logs", "locks", "cache", "tmp"])]


@pytest.mark.parametrize("gone", GONE)
def test_a_folder_of_results_that_is_deleted_is_made_again(finished, again, gone):
    project = again(finished)
    if not (project.build / gone).exists():
        pytest.skip("this store has no such folder")
    shutil.rmtree(project.build / gone)
    verbs.show_status(project, verbs.Wish("set"))
    losses = ["the next run failed"] if make(project) != 0 else []
    losses += [] if results(project) == results(finished) else ["other bytes"]
    no_loss("a deleted folder of build/", [losses + ([] if verbs.verify(project, None) == 0 else ["damaged"])])


@pytest.mark.parametrize("link", ["build", "build/store"])
def test_a_store_on_another_file_system_gives_the_same(fresh, finished, again, link):
    memory = Path("/dev/shm")
    if not memory.is_dir() or memory.stat().st_dev == Path(fresh.root).stat().st_dev:
        pytest.skip("there is no second file system")
    project, place = again(fresh), Path(memory / f"store-{os.getpid()}-{link.replace('/', '-')}")
    place.mkdir()
    try:
        (project.root / link).parent.mkdir(exist_ok=True)
        (project.root / link).symlink_to(place)
        struck(project, 5, "all of its processes")
        losses = lost_in(project, results(finished)) + sorted(set(kept(project)) ^ set(kept(finished)))
        assert (project.build / "store").resolve().is_relative_to(place)
        no_loss("a store on another file system", [losses])
    finally:
        shutil.rmtree(place)


# ── gc ───────────────────────────────────────────────────────────────────────────────────────────────────────────────

SLOW_GC = """
import os, sys, time
from pathlib import Path
from tests.runner import toy
from factorlib.runner.gc import collect
def slow(function):
    def wrapped(*words, **more):
        time.sleep(0.01)
        return function(*words, **more)
    return wrapped
os.unlink, os.rmdir, os.rename = map(slow, (os.unlink, os.rmdir, os.rename))
print("begun", flush=True)
collect(toy.toy(Path(sys.argv[1])))
"""


@few(1, 25)
def test_gc_that_is_killed_leaves_what_is_current_and_is_finished_by_the_next(finished, again, capfd, seeds):
    losses, half, several = [], 0, again(finished)
    for scale in (3, 4, 5):
        assert make(several, f"table.scale={scale}", f"upper.times={scale}") == 0
    other = results(several)
    assert make(several) == 0
    for seed in seeds:
        project = again(several)
        keys, command = len(kept(project)), [sys.executable, "-c", SLOW_GC, str(project.root)]
        process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(LIBRARY)}, stdout=subprocess.PIPE)
        process.stdout.readline()
        time.sleep(random.Random(seed).uniform(0, 1.0))
        process.kill()
        process.communicate()
        half += 0 < keys - len(kept(project))
        lost = lost_in(project, results(finished))
        collect(project)
        if sorted(kept(project)) != sorted(kept(finished)) or list((project.build / "store/tmp").glob("gc-*")):
            lost.append("gc left something")
        capfd.readouterr()
        if make(project, "table.scale=5", "upper.times=5") or results(project) != other:
            lost.append("what was freed cannot be made again")
        if "damaged" in capfd.readouterr().err:
            lost.append("what gc left was taken for damage")
        losses.append(lost)
    no_loss("gc killed in the middle", losses)
    assert half or len(seeds) == 1


def test_gc_keeps_what_a_current_result_was_made_from(finished, again):
    """The table alone was made anew, with another scale: the total under the set's name was made from the old one."""
    project = again(finished)
    assert make(project, "table.scale=3", targets=["table"]) == 0
    collect(project)
    assert set(state(project).values()) == {"current"} and new_runs(project) == []
    assert results(project) == results(finished)
    collect(project)
    assert set(state(project, settings=("table.scale=3",)).values()) - {"current"}, "what nothing needs goes"
