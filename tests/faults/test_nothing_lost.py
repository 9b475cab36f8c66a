"""Whatever befalls a run, nothing that was finished is lost, nothing half-written is seen, and the next run ends in the same bytes.

With real processes and a seed for each try.  `make test` makes a few tries of each fault, `make test-long` all of them, which
are the numbers of docs/reliability.md (`make results ONLY=faults`).
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from faults import battered
from faults.battered import (
    STAGES,
    done,
    end,
    half_written,
    kept,
    kill,
    lost_in,
    make,
    results,
    slow_project,
    start,
    wait_until,
)
from faults.tries import note

from factorlib.runner import verbs
from factorlib.runner.gc import collect
from factorlib.runner.project import LIBRARY
from tests.runner import toy
from tests.runner.toy import state, write

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
WHOM = ("all of its processes", "the run", "one that is at work")
TRIES = [0, 1, 2, 3, pytest.param(range(100), marks=pytest.mark.long)]
few = lambda most: [range(1), pytest.param(range(1, most), marks=pytest.mark.long)]  # noqa: E731


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
    assert not any(losses), [(number, found) for number, found in enumerate(losses) if found]


# ── SIGKILL ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("seeds", TRIES, ids=str)
def test_a_kill_at_any_moment_loses_nothing_that_was_finished(fresh, finished, again, seeds):
    """Two of three tries wait until a stage is writing, and strike somewhere in that time; the third strikes at any time at all."""
    wanted, hit = results(finished), dict.fromkeys(STAGES, 0)
    tries = [seeds] if isinstance(seeds, int) else seeds
    for whom in WHOM:
        losses = []
        for seed in (seed for seed in tries if WHOM[seed % 3] == whom):
            project = again(fresh)
            for stage in struck(project, seed, whom):
                hit[stage] += 1
            losses.append(lost_in(project, wanted))
            shutil.rmtree(project.root)
        if losses:
            no_loss(f"SIGKILL to {whom}", losses)
    note("hits", "mid-write", sum(hit.values()), stages=hit)
    if not isinstance(seeds, int):
        assert min(hit.values()) >= 5, hit


def struck(project, seed, whom):
    """A run that is killed; the stages that were writing just then."""
    chance = random.Random(seed)
    stage = STAGES[seed // 3 % 4] if seed % 9 < 6 else None
    process = start(project)
    if stage is not None:
        assert wait_until(lambda: stage in half_written(project) or process.poll() is not None)
        time.sleep(chance.uniform(0, 6 * float(battered.PAUSE)))
    else:
        time.sleep(chance.uniform(0, 3))
    writing = half_written(project) - {step.partition("/")[0] for step in kept(project).values()} | (
        {stage} & half_written(project)
    )
    kill(process, whom)
    end(process)
    return writing


def test_drafts_of_killed_writers_go_once_they_are_old_and_those_of_others_stay(finished, again):
    project = again(finished)
    gone = subprocess.Popen(["true"])
    gone.wait()
    folders = [project.build / "set", *(project.build / "store" / name for name in ("keys", "logs", "cache"))]
    old, new, own = (
        [folder / f".{name}.json.{pid}" for folder in folders]
        for name, pid in (("old", gone.pid), ("new", gone.pid), ("own", os.getpid()))
    )
    for path in (*old, *new, *own):
        write(path, "{")
        os.utime(path, (time.time() - 7200 * (path not in new),) * 2)
    write(project.root / "data" / "set" / "c.txt", "Gamma")
    assert make(project) == 0
    assert not any(path.exists() for path in old) and all(path.exists() for path in (*new, *own))


# ── two runs, inputs, clocks, places ─────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("seeds", few(12), ids=str)
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


def test_a_run_leaves_the_link_that_another_run_is_about_to_rename(finished, again):
    project = again(finished)
    draft = project.build / "set" / f".upper.{os.getpid()}"
    draft.symlink_to("../store", target_is_directory=True)
    assert make(project) == 0 and draft.is_symlink()


@pytest.mark.parametrize("seeds", few(12), ids=str)
def test_a_photo_that_vanishes_in_mid_run_is_named_and_costs_its_own_steps(fresh, finished, again, seeds):
    losses = []
    for seed in seeds:
        chance, project = random.Random(seed), again(fresh)
        photo = project.root / "data" / "set" / f"{'ab'[seed % 2]}.txt"
        content, process = photo.read_bytes(), start(project)
        wait_until(partial(half_written, project), seconds=20)
        time.sleep(chance.uniform(0, 0.3))
        photo.unlink()
        said = process.communicate(timeout=60)[0]
        photo.write_bytes(content)
        named = process.returncode == 0 or (photo.name in said and "defect" not in said and "Traceback" not in said)
        losses.append([*([] if named else [said]), *lost_in(project, results(finished))])
    no_loss("a photo that vanishes in mid-run", losses)


def test_a_photo_that_vanishes_before_it_is_read_is_no_defect(fresh, again, capfd):
    project = again(fresh)
    text = (project.root / "stages" / "upper.py").read_text()
    write(
        project.root / "stages" / "upper.py",
        text.replace("    text =", "    inputs.file('a.txt').unlink() if inputs.photo == 'a' else None\n    text ="),
    )
    assert make(project) == 1
    said = capfd.readouterr().err
    assert "a.txt: the file changed while it was being read" in said and "defect" not in said
    assert "upper/b" in kept(project).values()


def test_a_result_that_vanishes_while_it_is_read_is_made_again(fresh, finished, again, capfd):
    project = again(fresh)
    text = (project.root / "stages" / "total.py").read_text()
    once = "    import shutil, os\n    if not os.path.exists('{0}'):\n        open('{0}', 'w').close(); shutil.rmtree(inputs['table'])\n    counts ="
    write(project.root / "stages" / "total.py", text.replace("    counts =", once.format(project.root / "once")))
    assert make(project) == 1
    said = capfd.readouterr().err
    assert "changed while it was being read" in said and "defect" not in said
    assert make(project) == 0 and verbs.verify(project, None) == 0
    assert (project.build / "set/total/total.txt").read_bytes() == (finished.build / "set/total/total.txt").read_bytes()


CLOCK = "import time\n_now, _now_ns = time.time, time.time_ns\ntime.time = lambda: _now() - {0}\ntime.time_ns = lambda: _now_ns() - {0} * 10**9\n"


@pytest.mark.parametrize(
    "days",
    [
        1,
        pytest.param(400, marks=pytest.mark.long),
        pytest.param(-1, marks=pytest.mark.long),
        pytest.param(-4000, marks=pytest.mark.long),
    ],
)
def test_a_clock_that_goes_back_loses_nothing_and_hides_no_edit(finished, again, tmp_path, days):
    """All files are from the time before: theirs is the future, and what is edited now is older than what is remembered."""
    project, seconds = again(finished), days * 86400
    write(tmp_path / "clock" / "sitecustomize.py", CLOCK.format(seconds))
    path = f"{tmp_path / 'clock'}{os.pathsep}{LIBRARY}"
    before = len(done(project))
    assert end(start(project, PYTHONPATH=path)) == 0 and len(done(project)) == before, "nothing to do"
    photo = project.root / "data" / "set" / "a.txt"
    write(photo, photo.read_text().swapcase())
    os.utime(photo, (time.time() - seconds,) * 2)
    write(project.root / "data" / "set" / "c.txt", "Gamma")
    assert end(start(project, PYTHONPATH=path)) == 0
    ran = sorted(done(project)[before:])
    write(photo, photo.read_text().swapcase())
    (project.root / "data" / "set" / "c.txt").unlink()
    no_loss(
        "a clock that goes back",
        [([] if ran == ["count/c", "total", "upper/a", "upper/c"] else ran) + lost_in(project, results(finished))],
    )


def test_a_checkout_that_is_moved_in_mid_life_keeps_its_keys(fresh, finished, again, tmp_path):
    """Killed here, moved, and finished there."""
    losses = []
    for seed in range(2):
        project = again(fresh)
        struck(project, seed, "all of its processes")
        shutil.move(project.root, tmp_path / f"moved {seed}")
        moved = toy.toy(tmp_path / f"moved {seed}")
        losses.append([*lost_in(moved, results(finished)), *(set(kept(finished)) ^ set(kept(moved)))])
    no_loss("a checkout that is moved", losses)


@pytest.mark.parametrize(
    "gone",
    [
        "store",
        "store/trees",
        "store/keys",
        "store/views",
        "store/logs",
        "store/locks",
        "store/cache",
        "store/tmp",
        "set",
        ".",
    ],
)
def test_a_folder_of_results_that_is_deleted_is_made_again(finished, again, gone):
    project, wanted = again(finished), results(finished)
    shutil.rmtree(project.build / gone)
    verbs.show_status(project, verbs.Wish("set"))
    accepted = make(project) == 0
    losses = [*([] if accepted else ["the next run failed"]), *([] if results(project) == wanted else ["other bytes"])]
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
        found = lost_in(project, results(finished)) + sorted(set(kept(project)) ^ set(kept(finished)))
        assert Path(project.build / "store").resolve().is_relative_to(place)
        no_loss("a store on another file system", [found])
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


@pytest.mark.parametrize("seeds", few(25), ids=str)
def test_gc_that_is_killed_leaves_what_is_current_and_is_finished_by_the_next(finished, again, capfd, seeds):
    losses, half = [], 0
    several = again(finished)
    for scale in (3, 4, 5):
        assert make(several, f"table.scale={scale}", f"upper.times={scale}") == 0
    other = results(several)
    assert make(several) == 0
    for seed in seeds:
        project = again(several)
        keys = len(kept(project))
        process = subprocess.Popen(
            [sys.executable, "-c", SLOW_GC, str(project.root)],
            env={**os.environ, "PYTHONPATH": str(LIBRARY)},
            stdout=subprocess.PIPE,
        )
        process.stdout.readline()
        time.sleep(random.Random(seed).uniform(0, 1.0))
        process.kill()
        process.communicate()
        half += 0 < keys - len(kept(project))
        found = lost_in(project, results(finished))
        collect(project)
        found += (
            ["gc left something"]
            if sorted(kept(project)) != sorted(kept(finished)) or list((project.build / "store/tmp").glob("gc-*"))
            else []
        )
        capfd.readouterr()
        remade = make(project, "table.scale=5", "upper.times=5")
        found += ["what was freed cannot be made again"] if remade or results(project) != other else []
        found += ["what gc left was taken for damage"] if "damaged" in capfd.readouterr().err else []
        losses.append(found)
    no_loss("gc killed in the middle", losses)
    assert half or len(seeds) == 1


def test_gc_keeps_what_a_current_result_was_made_from(finished, again):
    """The table alone was made anew, with another scale: the total that is shown was made from the old one."""
    project = again(finished)
    assert verbs.make(project, verbs.Wish("set", ["table"], ["table.scale=3"])) == 0
    collect(project)
    before = len(done(project))
    assert set(state(project).values()) == {"current"} and make(project) == 0 and len(done(project)) == before
    assert results(project) == results(finished)
    collect(project)
    assert set(state(project, settings=("table.scale=3",)).values()) - {"current"}, "what nothing needs goes"
