"""Running a plan: start what is ready, take in what is done, plan again, until nothing is left that can run.

Once all that was ready has been started and there are results, the same pure `plan` is asked anew, so an output that
came out unchanged stops what follows there, and what another run made meanwhile is used.  A step that fails holds up
only what depends on it; one that fails because its stage's code was edited meanwhile holds up the stage's further steps
too.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from pathlib import Path

from factorlib.errors import InputError
from factorlib.runner.dataset_state import Survey
from factorlib.runner.display import Display
from factorlib.runner.plan import Planned, Step
from factorlib.runner.results_folder import begin_run, claim, label, view_of
from factorlib.runner.store import lock, sound_lines
from factorlib.runner.worker import Code, Outcome, Task, Workers, run_step
from factorlib.wholefile import append_text, write_bytes, write_text

POLL = 0.1  # seconds between two looks at what the workers say
DIED = "its process died: killed from outside, or for want of memory, or crashed in a library; run again to resume"


@dataclass
class Running:
    """A step in a worker, the lock held for it, and how much of its events has been read."""

    planned: Planned
    task: Task
    lock: int
    future: Future
    read: int = 0


def run(survey: Survey, display: Display) -> Run:
    """Run whatever of the plan must run; the results are in the store and under build/<dataset>/ afterwards."""
    claim(survey.project, survey.home, survey.data.folder)
    folder, held = begin_run(survey.store, display.say)
    workers = None
    try:
        workers = Workers(survey.spec.pipeline.executor, folder, display.say)
        work = Run(survey, display, folder, workers)
        try:
            work.go()
        finally:
            for running in work.running.values():
                os.close(running.lock)
            survey.show(survey.planned(frozenset()))
        return work
    finally:
        os.close(held)  # Processes whose step is not done end then.
        if workers:
            workers.close()
        shutil.rmtree(folder, ignore_errors=True)


class Run:
    """State of one run.

    Attributes:
        ran, failed, held_up: steps that succeeded, that failed, and that wait for a failed one
    """

    def __init__(self, survey: Survey, display: Display, folder: Path, workers: Workers):
        self.survey = survey
        self.display = display
        self.folder = folder
        self.workers = workers
        self.store = survey.store
        self.running: dict[Step, Running] = {}
        self.waiting: set[Step] = set()  # for another run, or for what is damaged to be made again
        self.ran: list[Step] = []
        self.failed: dict[Step, Outcome] = {}
        self.held_up: list[Step] = []
        self.planned: dict[Step, Planned] = {}
        self.stale = False  # there are results that the plan does not know
        self.made: set[str] = set()  # keys
        self.edited: set[str] = set()  # stages whose code is no longer that of their keys

    def go(self) -> None:
        """Run all that can run; returns when nothing is running, and what is left waits for a step that failed."""
        self._plan()
        while True:
            self.waiting = set()
            self._start_planned()
            while self.stale and self.workers.free(1):
                self._plan()
                self._start_planned()
            if not self.running and not self.waiting:
                break
            self._wait()
        left = (p.step for p in self.planned.values() if p.status != "current")
        self.held_up = [step for step in left if step not in self.failed]

    def _plan(self) -> None:
        planned = self.survey.planned(self.survey.spec.forced - set(self.ran) - set(self.failed))
        self.planned, self.stale = {p.step: p for p in planned}, False
        self.display.plan(planned)

    def _start_planned(self) -> None:
        for step, planned in self.planned.items():
            if planned.status != "to run" or planned.key is None or (self.stale and planned.key in self.made):
                continue
            if step in self.running or step in self.failed or step.stage in self.edited:
                continue
            if not self.workers.free(1):
                return
            code = self.survey.code(step.stage)
            if self.workers.free(max(code.threads, code.cores)):
                self._start(step, planned, code)

    def _start(self, step: Step, planned: Planned, code: Code) -> None:
        if planned.key in self.made:
            words = f"{planned.reasons[0]}, and was made just now: is the disk failing?"
            return self._fail(step, Outcome(error=words))
        held = lock(self.store.locks / f"{planned.key}.lock")
        if held is None:
            self.waiting.add(step)
            return self.display.waits(step)
        self.store.forget(planned.key)
        if self.store.get(planned.key) is not None and "forced" not in planned.reasons:
            os.close(held)  # another run has made it meanwhile
            self.stale = True
        elif not self.store.still([self.planned[each].key for each in self.survey.spec.above(step)]):
            os.close(held)  # a run takes hours, and what is used only now is damaged by now
            self.waiting.add(step)
        else:
            self.display.start(step)
            task = self._task(planned, code)
            future = self.workers.submit(max(code.threads, code.cores), code.threads, run_step, task)
            self.running[step] = Running(planned, task, held, future)

    def _task(self, planned: Planned, code: Code) -> Task:
        step, stage = planned.step, self.survey.spec.pipeline.stages[planned.step.stage]
        facts, files = self.survey.handed[step]
        temporary = self.folder / label(step)
        return Task(
            code=code,
            stage=stage,
            folders={name: self._folder(step, name) for name in stage.upstream} | stage.folders,
            facts=facts,
            files=files,
            log=self._log_above(step, temporary.with_name(f"{temporary.name}.log.jsonl")) if stage.logs else None,
            store=self.store.root,
            key=planned.key,
            record=planned.record,
            temporary=temporary,
            events=temporary.with_name(f"{temporary.name}.events.jsonl"),
            forced="forced" in planned.reasons,
        )

    def _folder(self, step: Step, name: str) -> Path:
        """Return the folder with the files of the stage `name` for this step."""
        stage, spec = self.survey.spec.pipeline.stages[name], self.survey.spec
        if not stage.over or step.photo is not None:
            return self.store.trees / self.planned[Step(name, step.photo if stage.over else None)].output
        keys = {each.photo: self.planned[each].key for each in spec.steps_of(name)}
        return self.store.trees / self.store.get(view_of(self.store, name, keys, stage.gather))

    def _log_above(self, step: Step, path: Path) -> Path:
        """Write the log of the steps above, of their present results, whichever run made them."""
        above = set(self.survey.spec.pipeline.needed([step.stage])) - {step.stage}
        logs = [self.store.log(p.key) for p in self.planned.values() if p.step.stage in above and p.key]
        write_bytes(path, b"".join(line + b"\n" for log in logs for line in sound_lines(log)))
        return path

    def _wait(self) -> None:
        futures, done = {work.future: step for step, work in self.running.items()}, set()
        if futures:
            done = wait(futures, timeout=POLL, return_when=FIRST_COMPLETED).done
        else:
            time.sleep(POLL)
        for work in self.running.values():
            self._listen(work)
        for future in done:
            self._take(self.running.pop(futures[future]))
        self.stale = self.stale or bool(done or self.waiting)
        for step in self.waiting:
            self.store.forget(self.planned[step].key)
        self.display.tick()

    def _listen(self, work: Running) -> None:
        """Pass on what a worker has said since the last look."""
        text = b""
        with contextlib.suppress(OSError), open(work.task.events, "rb") as stream:
            stream.seek(work.read)
            text = stream.read()
        lines = text[: text.rfind(b"\n") + 1]
        work.read += len(lines)
        for line in lines.splitlines():
            with contextlib.suppress(ValueError):  # cut where a try of the step was killed
                event = json.loads(line)
                if "warning" in event:
                    self.display.warn(work.planned.step, event["warning"])
                else:
                    self.display.progress(work.planned.step, event["done"], event["total"], event["text"])

    def _take(self, work: Running) -> None:
        step, key = work.planned.step, work.task.key
        try:
            outcome = work.future.result()
        except Exception as error:  # of the executor: `run_step` raises nothing
            known = isinstance(error, InputError)
            outcome = Outcome(error=str(error) if known else f"{DIED} ({type(error).__name__})")
        os.close(work.lock)
        if outcome.error is not None:
            return self._fail(step, outcome)
        if self.store.get(key) not in (None, outcome.output):
            self.display.warn(step, "made again from the same inputs, it came out different")
        self.store.forget(key)
        self.survey.previous[str(step)] = work.task.record
        self.ran.append(step)
        self.made.add(key)
        append_text(self.survey.home.log, self.store.log(key).read_text(encoding="utf-8"))
        self.survey.remember({str(step): key})
        self.display.finish(step, outcome.seconds)

    def _fail(self, step: Step, outcome: Outcome) -> None:
        self.failed[step], home, where = outcome, self.survey.home, None
        self.edited |= {step.stage} if outcome.code_changed else set()
        if outcome.traceback:
            path = home.errors / f"{label(step)}.txt"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, outcome.traceback)
            where = self.survey.project.shown(path)
        self.display.fail(step, outcome.error, where)
        event = {"event": "failed", "stage": step.stage, "photo": step.of, "text": outcome.error}
        append_text(home.log, json.dumps(event, sort_keys=True) + "\n")
