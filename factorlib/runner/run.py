"""Running a plan: start what is ready, take in what is done, plan again, until nothing is left that can run.

Once all that was ready has been started and there are results, the same pure `plan` is asked anew, so an output that came
out unchanged stops what follows there, and what another run made meanwhile is used.  What a plan calls ready stays so, for
all it takes is made; hence a plan for every stage is enough, not one for every result.  A step that fails holds up only
what depends on it; one that fails because its stage's code was edited meanwhile holds up the stage's further steps too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from factorlib.runner.display import Display
from factorlib.runner.executors import Pools
from factorlib.runner.gc import tenant
from factorlib.runner.home import claim, label, remember, sound_lines, view_of
from factorlib.runner.pipeline import DASK, DATASET, Pipeline
from factorlib.runner.plan import Planned, Step
from factorlib.runner.shared import shared_store
from factorlib.runner.survey import Survey, given_folder
from factorlib.runner.worker import Code, Outcome, Task, check_params, run_step
from factorlib.wholefile import append_text, write_bytes, write_text

if TYPE_CHECKING:
    from factorlib.runner.cluster import Cluster

POLL = 0.1  # seconds between two looks at what the workers say


@dataclass
class Running:
    """A step in a worker, the lock held for it, and how much of its events has been read."""

    planned: Planned
    task: Task
    lock: FileLock
    future: Future | None = None
    read: int = 0


@dataclass
class Tally:
    """What a run came to."""

    ran: list[Step] = field(default_factory=list)
    failed: dict[Step, Outcome] = field(default_factory=dict)
    held_up: list[Step] = field(default_factory=list)
    seconds: float = 0.0


def run(survey: Survey, display: Display, pools: Pools | Cluster | None = None) -> Tally:
    """Run whatever of the plan must run; the results are in the store and under build/<dataset>/ afterwards."""
    started = time.perf_counter()
    claim(survey.project, survey.home, survey.data.folder)
    with tenant(survey.store, display.say) as folder:
        pools = pools or pools_for(survey.spec.pipeline, folder, display.say)
        work = Run(survey, display, pools, folder)
        try:
            work.check()
            work.go()
        except BaseException:
            pools.close(kill=True)
            raise
        finally:
            work.release()
            remember(survey)
        pools.close()
    work.tally.seconds = time.perf_counter() - started
    return work.tally


def pools_for(pipeline: Pipeline, folder: Path, say: Callable[[str], None]) -> Pools | Cluster:
    """Where the steps of a run with that folder run: processes of this machine, or a Dask cluster, which is loaded only then."""
    if pipeline.executor != DASK:
        return Pools()
    from factorlib.runner.cluster import Cluster

    return Cluster(pipeline.scheduler, folder, say)


class Run:
    """The state of one run."""

    def __init__(self, survey: Survey, display: Display, pools: Pools | Cluster, folder: Path):
        self.survey, self.display, self.pools, self.folder = survey, display, pools, folder
        self.running: dict[Step, Running] = {}
        self.waiting: set[Step] = set()
        self.tally = Tally()
        self.planned: list[Planned] = []
        self.outputs: dict[Step, str | None] = {}  # as planned
        self.keys: dict[Step, str | None] = {}
        self.stale = False  # there are results that the plan does not know
        self.made: set[str] = set()  # keys
        self.edited: set[str] = set()  # stages whose code is no longer that of their keys
        self.shared = shared_store(survey.store.root)

    def go(self) -> None:
        """Run all that can run; returns when nothing is running, and what is left waits for a step that failed."""
        self._plan()
        while True:
            self._start_ready()
            if not self.running and not self.waiting:
                break
            self._wait()
        self.tally.held_up = [p.step for p in self.planned if p.status != "current" and p.step not in self.tally.failed]

    def check(self) -> None:
        """Refuse bad parameters before anything has run."""
        self._plan()
        stages = dict.fromkeys(p.step.stage for p in self.planned if p.status != "current")
        checks = [self._code(name) for name in stages if self.survey.spec.pipeline.stages[name].values]
        running: dict[Future, Code] = {}
        while checks or running:
            while checks and self.pools.free(checks[0].taken):
                code = checks.pop(0)
                running[self.pools.submit(code.taken, code.threads, check_params, code)] = code
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                outcome, code = _outcome_of(future), running.pop(future)
                self.pools.done(future)
                if outcome.error:
                    self._fail(Step(code.stage), outcome)
        if self.tally.failed:
            raise Refused(self.tally.failed)

    def release(self) -> None:
        """Give back the locks of all steps that run."""
        for work in self.running.values():
            work.lock.release()

    # ── starting ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def _plan(self) -> None:
        self.planned = self.survey.planned(self.survey.spec.forced - set(self.tally.ran) - set(self.tally.failed))
        self.outputs = {planned.step: planned.output for planned in self.planned}
        self.keys = {planned.step: planned.key for planned in self.planned}
        self.display.plan(self.planned)
        self.stale = False

    def _start_ready(self) -> None:
        self.waiting = set()
        self._start_planned()
        while self.stale and self.pools.free(1):
            self._plan()
            self._start_planned()

    def _start_planned(self) -> None:
        for planned in self.planned:
            if planned.status != "to run" or planned.key is None or (self.stale and planned.key in self.made):
                continue
            if planned.step in self.running or planned.step in self.tally.failed or planned.step.stage in self.edited:
                continue
            if not self.pools.free(1):
                return
            if self.pools.free(self._code(planned.step.stage).taken):
                self._start(planned)

    def _start(self, planned: Planned) -> None:
        if planned.key in self.made:
            self._fail(
                planned.step, Outcome(error=f"{planned.reasons[0]}, and was made just now: is the disk failing?")
            )
            return
        lock = FileLock(self.survey.store.locks / f"{planned.key}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            self.waiting.add(planned.step)
            self.display.waits(planned.step)
            return
        self.survey.outputs.forget(planned.key)
        if self.survey.outputs.get(planned.key) is not None and "forced" not in planned.reasons:
            lock.release()  # another run has made it meanwhile
            self.stale = True
            return
        if not self.survey.outputs.still([self.keys[above] for above in self.survey.spec.above(planned.step)]):
            lock.release()  # a run takes hours, and what is used only now is damaged by now
            self.waiting.add(planned.step)
            return
        work = Running(planned, self._task(planned), lock)
        self.running[planned.step] = work
        self.display.start(planned.step)
        work.future = self.pools.submit(work.task.code.taken, work.task.code.threads, run_step, work.task)

    def _code(self, stage: str) -> Code:
        project, spec = self.survey.project, self.survey.spec.pipeline.stages[stage]
        cores = self.pools.cores if spec.cores == "all" else min(spec.cores, self.pools.cores)
        return Code(
            project.root,
            project.package,
            stage,
            spec.values,
            project.pipeline_file,
            spec.threads,
            cores,
            self.survey.words,
        )

    def _task(self, planned: Planned) -> Task:
        step, data = planned.step, self.survey.data
        stage = self.survey.spec.pipeline.stages[step.stage]
        slices = {name: data.slice(name, step.photo) for name in stage.slices}
        files = {file: data.folder / file for slice_ in slices.values() for file in slice_.files}
        given = {param: given_folder(stage, param) for param in stage.folders}
        read = {
            f"given:{param}/{file}": folder / file for param, folder in given.items() for file in stage.given[param]
        }
        recipe = self.survey.recipes[step.recipe] if step.recipe else None
        read |= {f"recipe file:{name}": path for name, path in recipe.files.items()} if recipe else {}
        return Task(
            code=self._code(step.stage),
            photo=step.photo,
            makes=stage.makes,
            gather=stage.gather,
            folders={name: self._folder(step, name) for name in stage.upstream} | given,
            facts={DATASET + name: slice_.facts for name, slice_ in slices.items()}
            | ({"recipe": recipe.facts} if recipe else {}),
            files=files | read,
            hashes={file: planned.record[f"file:{file}"] for file in files}
            | {file: planned.record[file] for file in read},
            log=self._log_above(step, self.folder / f"{label(step)}.log.jsonl") if stage.logs else None,
            store=self.survey.store.root,
            key=planned.key,
            record=planned.record,
            temporary=self.folder / label(step),
            events=self.folder / f"{label(step)}.events.jsonl",
            shipped=None if "forced" in planned.reasons else stage.shipped,
            shared=self.shared,
            forced="forced" in planned.reasons,
        )

    def _folder(self, step: Step, name: str) -> Path:
        """Where the files of the stage `name` are for this step."""
        stage, store, outputs = self.survey.spec.pipeline.stages[name], self.survey.store, self.outputs
        if not stage.over:
            return store.tree(outputs[Step(name)])
        if step.photo is not None:
            return store.tree(outputs[Step(name, step.photo)])
        return view_of(
            store,
            self.survey.outputs.inspector,
            {found.photo: outputs[found] for found in self.survey.spec.steps_of(name)},
            stage.gather,
        )

    def _log_above(self, step: Step, path: Path) -> Path:
        """What the steps above cost and said when their present results were made, whichever run made them."""
        above = set(self.survey.spec.pipeline.needed([step.stage])) - {step.stage}
        logs = [self.survey.store.log(p.key) for p in self.planned if p.step.stage in above and p.key]
        write_bytes(path, b"".join(line + b"\n" for log in logs for line in sound_lines(log)))
        return path

    # ── taking in ────────────────────────────────────────────────────────────────────────────────────────────────────

    def _wait(self) -> None:
        futures = {work.future: step for step, work in self.running.items()}
        if futures:
            done, _ = wait(futures, timeout=POLL, return_when=FIRST_COMPLETED)
        else:
            time.sleep(POLL)
            done = set()
        for work in self.running.values():
            self._listen(work)
        for future in done:
            self._take(self.running.pop(futures[future]))
        self.stale = self.stale or bool(done or self.waiting)
        for planned in self.planned if self.waiting else []:
            if planned.step in self.waiting:
                self.survey.outputs.forget(planned.key)
        self.display.tick()

    def _listen(self, work: Running) -> None:
        """Pass on what a worker has said since the last look."""
        try:
            with open(work.task.events, "rb") as stream:
                stream.seek(work.read)
                text = stream.read()
        except OSError:
            return
        whole = text[: text.rfind(b"\n") + 1]
        work.read += len(whole)
        for line in whole.splitlines():
            try:
                event = json.loads(line)
            except ValueError:  # cut where a try of the step was killed
                continue
            if "warning" in event:
                self.display.warn(work.planned.step, event["warning"])
            else:
                self.display.progress(work.planned.step, event["done"], event["total"], event["text"])

    def _take(self, work: Running) -> None:
        outcome = _outcome_of(work.future)
        self.pools.done(work.future)
        work.lock.release()
        step = work.planned.step
        if outcome.error is not None:
            self._fail(step, outcome)
            return
        before = self.survey.outputs.get(work.task.key)
        if before is not None and before != outcome.output:
            self.display.warn(step, "made again from the same inputs, it came out different")
        self.survey.outputs.forget(work.task.key)
        if outcome.damaged:
            self.display.warn(
                step,
                f"its kept result was damaged and is replaced; what was there: {self.survey.project.shown(outcome.damaged)}",
            )
        self.survey.previous[str(step)] = work.task.record
        self.tally.ran.append(step)
        self.made.add(work.task.key)
        self._log(self.survey.store.log(work.task.key).read_text(encoding="utf-8"))
        remember(self.survey, {str(step): work.task.key})
        self.display.finish(step, outcome.seconds)

    def _fail(self, step: Step, outcome: Outcome) -> None:
        self.tally.failed[step] = outcome
        if outcome.code_changed:
            self.edited.add(step.stage)
        where = None
        if outcome.traceback:
            path = self.survey.home.errors / f"{label(step)}.txt"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, outcome.traceback)
            where = self.survey.project.shown(path)
        self.display.fail(step, outcome.error, where)
        self._log(
            json.dumps(
                {"event": "failed", "stage": step.stage, "photo": step.of, "text": outcome.error}, sort_keys=True
            )
            + "\n"
        )

    def _log(self, lines: str) -> None:
        self.survey.home.folder.mkdir(parents=True, exist_ok=True)
        append_text(self.survey.home.log, lines)


class Refused(Exception):
    """Parameters that no stage takes; each has been shown."""


def _outcome_of(future: Future) -> Outcome:
    try:
        return future.result()
    except (BrokenProcessPool, CancelledError):
        return Outcome(
            error="its process died: killed from outside, or for want of memory, or crashed in a library; run again to resume"
        )
    except Exception as error:
        return Outcome(error=f"{type(error).__name__}: {error}", traceback=repr(error))
