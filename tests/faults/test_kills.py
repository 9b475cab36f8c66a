"""Kills at random moments, resumed: what was finished is kept and the next run ends in the same bytes.

The same holds of what changes or is damaged meanwhile, and of a disk without room.  Processes are real, with a seed for each try;
`make test-long` kills a hundred times.
"""

import contextlib
import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from factorlib.runner.project import LIBRARY
from factorlib.runner.results_folder import verify
from factorlib.runner.worker import _begin_process
from tests.runner import toy
from tests.runner.toy import done, edit, files_of, make, new_runs, reasons, state, write

STAGES = ("upper", "count", "table", "total")
SLOWLY = """
import os, pathlib, sys, time
def write_text(self, text, *_):
    with open(self, "w") as stream:
        for k in range(8):
            stream.write(text[k * len(text) // 8 : (k + 1) * len(text) // 8])
            stream.flush()
            time.sleep({0})
pathlib.Path.write_text = write_text
"""
PAUSE = 0.008  # seconds for a piece, where something is to happen meanwhile
COMMAND = (  # `python -m factorlib` on the toy in the folder that is the first word
    "import sys; from pathlib import Path; from factorlib import __main__ as line; from tests.runner import toy;"
    "root = Path(sys.argv.pop(1)); line.project = lambda: toy.toy(root); line.main()"
)

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
WHOM = {  # who gets SIGKILL -> ids of processes, or of a group
    "all of its processes": lambda run: [-run.pid], "the run": lambda run: [run.pid],
    "a process that is at work": lambda run: members(run.pid, b"--multiprocessing-fork")[-1:],
}  # fmt: skip
LONG = pytest.mark.long


# ── runs of the toy, and what is left of them ─────────────────────────────────────────────────────────────────────────


@pytest.fixture
def again(tmp_path):
    """A project of the same content in a folder of its own, for each try."""
    count = iter(range(1000))
    return lambda project: toy.copy(project, tmp_path / f"try {next(count)}" / "root")


def doing(project, stage, code, before="    (out /"):
    """Let a stage run some code of one line before a line of its own."""
    edit(project, f"stages/{stage}.py", before, f"    from pathlib import Path; {code}\n{before}")


def is_said(text, *words):
    """Whether a text tells a user what to mend, as theirs."""
    return all(word in text for word in words) and "Traceback" not in text and "defect" not in text


def start(project, *settings, verb="all", without_rights=False, first=None):
    """A verb of the command line in a group of processes of its own, which write texts and delete slowly."""
    words = [sys.executable, "-c", COMMAND, str(project.root), verb]
    if verb == "all":
        words += ["--dataset", "set", *(f"--set={setting}" for setting in settings)]
    if without_rights and os.geteuid() == 0:
        if shutil.which("setpriv") is None:
            pytest.skip("setpriv is not there, and root may write everywhere")
        words = ["setpriv", "--bounding-set", "-all", "--inh-caps", "-all", *words]
    site = project.root.parent / "site"
    write(site / "sitecustomize.py", SLOWLY.format(PAUSE))
    environment = {**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{LIBRARY}", "PYTHONDONTWRITEBYTECODE": "1"}
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(words, env=environment, start_new_session=True, preexec_fn=first, **pipes)


def wait_until(true, seconds=60, every=0.001):
    """What a function returns once that is true, or False after so many seconds."""
    end = time.monotonic() + seconds
    while not (value := true()):
        if time.monotonic() > end:
            return False
        time.sleep(every)
    return value


def at_work(project, step=""):
    """Stages of which a step (of that name) has begun to write files that are no result yet."""
    with contextlib.suppress(OSError):  # a run sweeps meanwhile
        begun = (project.build / "store" / "tmp").glob(f"run-*/{step}*/*")
        return {path.parent.name.partition("-")[0] for path in begun}
    return set()


def members(group, words=b""):
    """Processes of a group that are not yet dead, with these words in their command."""
    pids = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, of = stat.read_text().rpartition(")")[2].split()[:3]
            if of == str(group) and state != "Z" and words in stat.with_name("cmdline").read_bytes():
                pids.append(int(stat.parent.name))
    return sorted(pids)


def end(process):
    """The exit code of a run and what it said; none of its processes is left."""
    text = process.communicate(timeout=120)[0]
    assert wait_until(lambda: not members(process.pid), every=0.02)
    return process.returncode, text


def kill(process, whom):
    with contextlib.suppress(ProcessLookupError):
        for pid in WHOM[whom](process):
            os.kill(pid, signal.SIGKILL)


def results(project):
    """What stands under the data set's name, but for the log of runs; drafts of a writer that was killed are hidden."""
    files = files_of(project.build / "set")
    return {k: v for k, v in files.items() if k != "log.jsonl" and not k.startswith(("errors/", "."))}


def entries(project):
    """Entry by key, of every result in the store."""
    store = project.build / "store"
    listed = {path.stem: json.loads(path.read_bytes()) for path in (store / "keys").glob("*.json")}
    return {key: entry for key, entry in listed.items() if (store / "trees" / entry["output"]).is_dir()}


def stored(project):
    """Step by key, of every result in the store."""
    records = {key: entry["record"] for key, entry in entries(project).items()}
    return {key: "/".join(filter(None, (record["stage"], record["photo"]))) for key, record in records.items()}


def is_sound(project, dataset=None):
    return verify(project, dataset) == 0


def lost_in(project, wanted, *settings):
    """What a fault cost: the next run must be accepted, make only what is missing, and end in the same bytes."""
    before, already = set(stored(project).values()), len(done(project))
    losses = [] if is_sound(project) else ["something that is damaged is taken for a result"]
    losses += [] if make(project, *settings) == 0 else ["the next run failed"]
    losses += [f"made twice: {step}" for step in sorted(before & set(done(project)[already:]))]
    now = results(project)
    losses += [f"other bytes: {name}" for name in sorted(now.keys() | wanted) if now.get(name) != wanted.get(name)]
    return losses + ([] if is_sound(project) else ["damaged afterwards"])


# ── SIGKILL and SIGTERM ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 100), marks=LONG)], ids=str)
def test_a_kill_at_any_moment_loses_nothing_that_was_finished(fresh, made_once, again, seeds):
    """Two of three tries wait until a stage is writing, and strike in that time; the third strikes at any time."""
    wanted, hits = results(made_once), dict.fromkeys(STAGES, 0)
    for seed in seeds:
        project = again(fresh)
        for stage in strike(project, seed, [*WHOM][seed % 3]):
            hits[stage] += 1
        assert lost_in(project, wanted) == [], seed
        shutil.rmtree(project.root)
    assert len(seeds) < 50 or min(hits.values()) >= 5, hits


def strike(project, seed, whom="all of its processes"):
    """Kill a run; the stages that were writing just then."""
    chance, process = random.Random(seed), start(project)
    stage = STAGES[seed // 3 % 4] if seed % 9 < 6 else None
    if stage is not None:
        assert wait_until(lambda: stage in at_work(project) or process.poll() is not None)
    time.sleep(chance.uniform(0, 6 * PAUSE if stage else 3))
    writing = at_work(project) - ({step.partition("/")[0] for step in stored(project).values()} - {stage})
    kill(process, whom)
    end(process)
    return writing


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one processor runs one step at a time")
def test_a_killed_worker_does_not_fail_the_step_beside_it(fresh, tmp_path):
    toy.wait_for(fresh, tmp_path / "go")
    process = start(fresh)
    assert wait_until(lambda: at_work(fresh, "upper-a") and at_work(fresh, "upper-b"))
    os.kill(members(process.pid, b"--multiprocessing-fork")[0], signal.SIGKILL)
    (tmp_path / "go").touch()
    code, text = end(process)
    assert code == 1 and text.count("process died") == 1 and "1 step failed" in text
    assert sorted(state(fresh)[f"upper/{photo}"] for photo in "ab") == ["current", "to run"]
    assert len([step for step in done(fresh) if step.startswith("upper")]) == 1, "the step beside it ran again"


def test_sigterm_ends_a_run_as_an_interrupt_does(fresh):
    process = start(fresh, "upper.sleep=30")
    assert wait_until(lambda: at_work(fresh, "upper-a"))
    os.kill(process.pid, signal.SIGTERM)
    code, text = end(process)
    assert code == 143 and "stopped; what was finished is kept" in text
    assert "Traceback" not in text and "process died" not in text
    assert not list((fresh.build / "store" / "tmp").iterdir())


def test_sigterm_prints_no_stack_after_files_were_validated():
    """pycolmap, which validation imports, has a handler of its own."""
    code = (
        "import os, pathlib, signal; from factorlib.runner.project import photo_sets; "
        "photo_sets().read(pathlib.Path('data/eames'), ()).cautions(); os.kill(os.getpid(), signal.SIGTERM)"
    )
    process = subprocess.run([sys.executable, "-c", code], cwd=LIBRARY, capture_output=True, text=True)
    assert process.returncode == -signal.SIGTERM and not process.stderr


def test_a_worker_ignores_signals_also_once_colmap_has_its_own_handler(capfd):
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, _begin_process, (None,)) as pool:
        pool.submit(exec, "import os, signal, pycolmap; os.kill(os.getpid(), signal.SIGTERM)").result()
    assert not capfd.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_make_photos_ends_at_a_signal_inside_native_code_and_removes_what_it_began(tmp_path, number):
    code = (
        "import ctypes, pathlib, tempfile; from factorlib.runner.verbs import ended_by_signals\n"
        f"with ended_by_signals(pathlib.Path({str(tmp_path / 'mine')!r})):\n    import pycolmap; "
        f"print(tempfile.mkdtemp(), tempfile.mkdtemp(dir={str(tmp_path)!r}, prefix='.mine.'), flush=True); "
        "ctypes.CDLL(None).sleep(60)"
    )
    words = [sys.executable, "-c", code]
    with subprocess.Popen(words, cwd=LIBRARY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        folders = process.stdout.readline().split()
        assert all(map(os.path.isdir, folders)) and len(folders) == 2
        process.send_signal(number)
        assert process.wait(30) == 128 + number and process.stderr.read() == "stopped\n"
    assert not any(map(os.path.exists, folders))


# ── two runs, inputs, clocks, places ─────────────────────────────────────────────────────────────────────────────────


READ = "changed while it was being read"
MEANWHILE = {  # what changes while a step runs -> that stage, the line before which it does, how, and words of the error
    "a photo goes": ("upper", "    text =", "Path({root!r}, 'data/set/a.txt').unlink(True)", ("a.txt", READ)),
    "a result goes": ("total", "    counts =", "__import__('shutil').rmtree(inputs['table'])", ("table", READ)),
    "a result is spoilt": ("total", "    counts =", "p = inputs['count'] / 'a.json'; p.chmod(0o644); p.write_text('{{\"letters\": 100}}')", ("a.json", READ)),
    "the code is another": ("table", "    (out /", "f = Path(__file__); f.write_text(f.read_text() + 'NEW = 1\\n')",
                            ("stages/table.py", "changed while", "run again")),
    "the code is half typed": ("table", "    (out /", "Path(__file__).write_text('def (')", ("stages/table.py",)),
    "what it imports is another": ("count", "    (out /", "Path({root!r}, 'toylib/letters.py').write_text('letters = len')",
                                   ("toylib/letters.py", "changed while", "run again")),
    "a file of its package is another": ("table", "    (out /", "Path({root!r}, 'stages/templates/total.html').write_text('other')",
                                         ("stages/templates/total.html", "changed while", "run again")),
}  # fmt: skip


USUAL = ("a photo goes", "a result is spoilt", "the code is another")  # the others are variants of these


@pytest.mark.parametrize("what", [pytest.param(what, marks=[LONG] * (what not in USUAL)) for what in MEANWHILE])
def test_what_changes_while_a_step_runs_is_named_and_costs_that_step(fresh, made_once, capfd, what):
    """Nothing is kept under a key that says something else, and once it is as it was the run goes on."""
    stage, before, code, words = MEANWHILE[what]
    files = (path for part in ("stages", "toylib", "data") for path in (fresh.root / part).rglob("*.*"))
    usual = {path: path.read_text() for path in files}
    doing(fresh, stage, code.format(root=str(fresh.root)), before)
    assert make(fresh) == 1
    assert is_said(capfd.readouterr().err, *words)
    step = f"{stage}/a" if stage in ("upper", "count") else stage  # the view of a stage over photos holds the others'
    assert step not in stored(fresh).values()
    for path, text in usual.items():
        write(path, text)
    assert make(fresh) == 0 and is_sound(fresh) and results(fresh) == results(made_once)


def test_a_folder_of_results_that_is_deleted_is_made_again(project):
    wanted = results(project)
    folders = (".", "set", "store/trees", "store/keys", "store/views", "store/cache")
    for deleted in (deleted for deleted in folders if (project.build / deleted).exists()):
        shutil.rmtree(project.build / deleted)
        assert make(project) == 0 and is_sound(project) and results(project) == wanted, deleted


# ── damage in the store ──────────────────────────────────────────────────────────────────────────────────────────────


def overwrite(path, text="OTHER", keep_times=False):
    """In place, as an editor that writes into the file: every hard link to it changes."""
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    path.chmod(0o644)
    path.write_text(text)
    path.chmod(0o444)
    if keep_times:
        os.utime(path, ns=times)


def in_store(project, stage, file):
    """The file of a stage's result where it lies in the store's trees."""
    outputs = (e["output"] for e in entries(project).values() if e["record"]["stage"] == stage and file in e["files"])
    return project.build / "store" / "trees" / next(outputs) / file


DAMAGES = {
    "other content": overwrite, "one too many": lambda path: write(path.with_name("more.txt"), "1"),
    "a link": lambda path: path.symlink_to(shutil.move(path, path.parent.parent / "elsewhere")), "all gone": lambda path: shutil.rmtree(path.parent),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_result_is_made_again_and_nothing_else_is_and_a_damaged_view_too(project, damage):
    before = results(project)
    DAMAGES[damage](in_store(project, "total", "total.txt"))
    assert "damaged" in reasons(project, "total")[0]
    assert [step for step, status in state(project).items() if status == "to run"] == ["total"]
    assert new_runs(project) == ["total"] and results(project) == before
    DAMAGES[damage]((project.build / "set" / "upper").resolve() / "a.txt")  # where a user finds it
    assert make(project) == 0 and new_runs(project) == [] and results(project) == before and is_sound(project)


@pytest.mark.parametrize("cure", ["verify", "force"])
def test_damage_under_the_same_size_and_time_is_found_by_verify_or_replaced_by_force(project, capsys, cure):
    before = results(project)
    overwrite(in_store(project, "total", "total.txt"), "total: 19", keep_times=True)
    assert set(state(project).values()) == {"current"}, "size and time are those that were found right"
    if cure == "verify":
        assert not is_sound(project)
        text = capsys.readouterr().out
        assert "total: " in text and "total.txt: other content" in text and "build/store/trees" in text
        assert new_runs(project) == ["total"]
    assert make(project, force=cure == "force") == 0 and results(project) == before and is_sound(project)


# ── no room ──────────────────────────────────────────────────────────────────────────────────────────────────────────

SIZE = 100_000  # bytes that a heavy stage writes beside its result


def limited():
    resource.setrlimit(resource.RLIMIT_FSIZE, (SIZE // 2, SIZE // 2))


def test_no_room_is_said_as_what_it_is_and_with_room_the_run_goes_on(fresh, again):
    """Without root's rights, which pass limits."""
    project, stage = again(fresh), "table"
    doing(project, stage, f"(out / f'large-{{inputs.photo}}.bin').write_bytes(bytes({SIZE}))")
    usual = again(project)
    assert make(usual) == 0 and make(project, targets=["count"]) == 0
    before = set(stored(project).values())
    code, output = end(start(project, without_rights=True, first=limited))
    assert code == 1 and is_said(output, f"error: {stage}", "no file may become that large", "MB are free"), output
    assert before <= set(stored(project).values()) and stage not in {
        s.partition("/")[0] for s in stored(project).values()
    }
    assert not any((project.build / "store" / "tmp").iterdir()) and not list((project.build / "set").glob("errors/*"))
    assert lost_in(project, results(usual)) == []


def test_a_checkout_that_is_moved_and_its_store_on_another_file_system_change_nothing(fresh, made_once, tmp_path):
    """Killed here, moved, and finished there."""
    if not Path("/dev/shm").is_dir() or Path("/dev/shm").stat().st_dev == fresh.root.stat().st_dev:
        pytest.skip("there is no second file system")
    place, moved = Path(tempfile.mkdtemp(dir="/dev/shm")), toy.toy(tmp_path / "moved")
    try:
        fresh.build.symlink_to(place)
        strike(fresh, 5)
        shutil.move(fresh.root, moved.root)
        assert lost_in(moved, results(made_once)) == [] and set(stored(moved)) == set(stored(made_once))
        assert (moved.build / "store").resolve().is_relative_to(place)
    finally:
        shutil.rmtree(place)
