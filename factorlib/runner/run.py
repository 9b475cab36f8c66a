"""Execution of a plan: start the steps that are ready, collect their outcomes, and plan again until none can run.

The same pure `plan` is called again when there are results.  An output that did not change therefore stops what follows
it, and results that another run has made meanwhile are used.  A failed step holds up only the steps that depend on it;
if it failed because its stage's code was edited meanwhile, the stage's further steps are held up too.
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
from factorlib.runner.dataset_state import DatasetState
from factorlib.runner.display import Display
from factorlib.runner.plan import Planned, Step
from factorlib.runner.results_folder import begin_run, label, view_of
from factorlib.runner.store import lock, read_events
from factorlib.runner.worker import Outcome, StageCode, Task, Workers, run_step
from factorlib.wholefile import append_text, write_text

POLL = 0.1  # seconds between two looks at the workers' events
DIED = "its process died (killed from outside, out of memory, or crashed in a library); run again to resume"


@dataclass
class RunningStep:
    """Step in a worker, the descriptor of its lock, and the number of bytes read of its events."""

    planned: Planned
    task: Task
    lock: int
    future: Future
    position: int = 0


def run(state: DatasetState, display: Display) -> Run:
    """Run the steps that must run; their results are then in the store and in build/<dataset>/."""
    state.results.set_owner(state.project, state.data.folder)
    folder, descriptor = begin_run(state.store, display.report)
    with contextlib.ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        workers = Workers(state.spec.pipeline.executor, folder, display.report)
        stack.callback(workers.close)
        stack.callback(os.close, descriptor)  # Processes of unfinished steps end then.
        current = Run(state, display, folder, workers)
        try:
            current.execute()
        finally:
            for step in current.running.values():
                os.close(step.lock)
            if current.failed:
                state.store.forget_all()  # An input may have been damaged meanwhile.
            state.publish(state.plan(frozenset()))
        return current


class Run:
    """One run.

    Attributes:
        completed, failed, held_up: steps that succeeded, that failed, and that wait for a failed one
    """

    def __init__(self, state: DatasetState, display: Display, folder: Path, workers: Workers):
        self.state = state
        self.display = display
        self.folder = folder
        self.workers = workers
        self.store = state.store
        self.running: dict[Step, RunningStep] = {}
        self.waiting: set[Step] = set()  # for another run, or for a damaged input to be made again
        self.completed: list[Step] = []
        self.failed: dict[Step, Outcome] = {}
        self.held_up: list[Step] = []
        self.planned: dict[Step, Planned] = {}
        self.stale = False  # There are results that the plan does not know.
        self.keys: set[str] = set()  # keys of completed steps
        self.edited: set[str] = set()  # stages whose code is no longer that of their keys

    def execute(self) -> None:
        """Run all steps that can run; the others then wait for a failed step."""
        self._plan()
        while True:
            self.waiting = set()
            for planned in self.planned.values():
                if self.workers.free(1):
                    self._start_if_ready(planned)
            if self.stale and self.workers.free(1):  # Planning takes time: first all that is ready has started.
                self._plan()
            elif self.running or self.waiting:
                self._wait()
            else:
                break
        pending = (p.step for p in self.planned.values() if p.status != "current")
        self.held_up = [step for step in pending if step not in self.failed]

    def _plan(self) -> None:
        planned = self.state.plan(self.state.spec.forced - set(self.completed) - set(self.failed))
        self.planned = {p.step: p for p in planned}
        self.stale = False
        self.display.plan(planned)

    def _start_if_ready(self, planned: Planned) -> None:
        """Start a step if it must run, its inputs are made, and its cores are free."""
        step = planned.step
        if planned.status != "to run" or not planned.key or (self.stale and planned.key in self.keys):
            return
        if step in self.running or step in self.failed or step.stage in self.edited:
            return
        code = self.state.code(step.stage)
        if not self.workers.free(max(code.threads, code.cores)):
            return
        if planned.key in self.keys:
            error = f"{planned.reasons[0]}, although it was made in this run: is the disk failing?"
            return self._fail(step, Outcome(error=error))
        try:
            descriptor = lock(self.store.locks / f"{planned.key}.lock")
        except BlockingIOError:
            self.waiting.add(step)
            return self.display.wait(step)
        self.store.forget(planned.key)
        if self.store.get(planned.key) is not None and "forced" not in planned.reasons:
            os.close(descriptor)  # Another run has made it meanwhile.
            self.stale = True
        elif not self.store.unchanged([self.planned[above].key for above in self.state.spec.upstream(step)]):
            os.close(descriptor)  # An input was damaged during the run.
            self.waiting.add(step)
        else:
            self.display.start(step)
            task = self._task(planned, code)
            future = self.workers.submit(max(code.threads, code.cores), code.threads, run_step, task)
            self.running[step] = RunningStep(planned, task, descriptor, future)

    def _task(self, planned: Planned, code: StageCode) -> Task:
        step = planned.step
        stage = self.state.spec.pipeline.stages[step.stage]
        inputs = self.state.inputs[step]
        temporary = self.folder / label(step)
        return Task(
            code=code,
            stage=stage,
            folders={name: self._folder(step, name) for name in stage.upstream} | stage.folders,
            facts=inputs.facts,
            files=inputs.files,
            log=self._log_above(step, temporary.with_name(f"{temporary.name}.log.jsonl")) if stage.logs else None,
            store=self.store.root,
            key=planned.key,
            record=planned.record,
            temporary=temporary,
            events=temporary.with_name(f"{temporary.name}.events.jsonl"),
            forced="forced" in planned.reasons,
        )

    def _folder(self, step: Step, name: str) -> Path:
        """Return the folder with the files of the stage `name` for a step."""
        spec = self.state.spec
        stage = spec.pipeline.stages[name]
        if not stage.over or step.photo is not None:
            return self.store.trees / self.planned[Step(name, step.photo if stage.over else None)].output
        keys = {each.item: self.planned[each].key for each in spec.steps_of(name)}
        return self.store.trees / view_of(self.store, name, keys, stage.gather).output

    def _log_above(self, step: Step, path: Path) -> Path:
        """Write the logs of the current results of all stages above, whichever run made them."""
        above = set(self.state.spec.pipeline.needed([step.stage])) - {step.stage}
        logs = [self.store.log(p.key) for p in self.planned.values() if p.step.stage in above and p.key]
        lines = [json.dumps(event, sort_keys=True) + "\n" for log in logs for event in read_events(log)]
        write_text(path, "".join(lines))
        return path

    def _wait(self) -> None:
        """Wait for outcomes or events, and mark the plan as stale if there are outcomes, or steps wait."""
        futures = {work.future: step for step, work in self.running.items()}
        done = wait(futures, timeout=POLL, return_when=FIRST_COMPLETED).done if futures else set()
        if not futures:
            time.sleep(POLL)
        for work in self.running.values():
            self._read_events(work)
        for future in done:
            self._collect(self.running.pop(futures[future]))
        for step in self.waiting:
            self.store.forget(self.planned[step].key)
        self.stale |= bool(done or self.waiting)
        self.display.tick()

    def _read_events(self, work: RunningStep) -> None:
        """Display the new events of a worker."""
        text = b""
        with contextlib.suppress(OSError), open(work.task.events, "rb") as stream:
            stream.seek(work.position)
            text = stream.read()
        lines = text[: text.rfind(b"\n") + 1]
        work.position += len(lines)
        for line in lines.splitlines():
            with contextlib.suppress(ValueError):  # cut where the step's process was killed
                event = json.loads(line)
                if "warning" in event:
                    self.display.warn(work.planned.step, event["warning"])
                else:
                    self.display.progress(work.planned.step, event["done"], event["total"], event["text"])

    def _collect(self, work: RunningStep) -> None:
        step = work.planned.step
        key = work.task.key
        try:
            outcome = work.future.result()
        except Exception as error:  # of the executor: `run_step` raises nothing
            expected = isinstance(error, InputError)
            outcome = Outcome(error=str(error) if expected else f"{DIED} ({type(error).__name__})")
        os.close(work.lock)
        if outcome.error is not None:
            return self._fail(step, outcome)
        if self.store.get(key) not in (None, outcome.output):
            self.display.warn(step, "the same inputs gave another result than before")
        self.store.forget(key)
        self.state.previous[str(step)] = work.task.record
        self.completed.append(step)
        self.keys.add(key)
        append_text(self.state.results.log, self.store.log(key).read_text(encoding="utf-8"))
        self.state.remember({str(step): key})
        self.display.finish(step, outcome.seconds)

    def _fail(self, step: Step, outcome: Outcome) -> None:
        results = self.state.results
        place = None
        self.failed[step] = outcome
        self.edited |= {step.stage} if outcome.code_changed else set()
        if outcome.traceback:
            path = results.errors / f"{label(step)}.txt"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, outcome.traceback)
            place = self.state.project.shown(path)
        self.display.fail(step, outcome.error or "", place)
        event = {"event": "failed", "stage": step.stage, "photo": step.item or None, "text": outcome.error}
        append_text(results.log, json.dumps(event, sort_keys=True) + "\n")
