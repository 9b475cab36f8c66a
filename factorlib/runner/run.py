"""Execution of a plan: start the steps that are ready, collect their outcomes, and plan again until none can run.

The same pure `plan` is called again when there are results.  An output that did not change therefore stops what follows
it, and results that another run has made meanwhile are used.  A failed step holds up only the steps that depend on it.
"""

from __future__ import annotations

import contextlib
import json
import time
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from factorlib.errors import InputError
from factorlib.runner.dataset_state import DatasetState
from factorlib.runner.display import Display
from factorlib.runner.plan import PlannedStep, Step
from factorlib.runner.results_folder import make_view
from factorlib.runner.run_folder import begin_run, end_run
from factorlib.runner.store import lock
from factorlib.runner.worker import Outcome, StageCode, Task, Workers, run_step
from factorlib.wholefile import append_text, write_text

if TYPE_CHECKING:
    from filelock import BaseFileLock

POLL = 0.1  # seconds between two looks at the workers' events
DIED = "its process died (killed from outside, out of memory, or crashed in a library); run again to resume"


@dataclass
class RunningStep:
    """Step in a worker, its lock, and the number of bytes read of its events."""

    step: Step
    task: Task
    lock: BaseFileLock
    future: Future
    position: int = 0


def run(state: DatasetState, display: Display) -> Run:
    """Run the steps that must run; their results are then in the store and in build/<dataset>/."""
    state.results.set_owner(state.project, state.data.folder)
    folder, alive = begin_run(state.store)
    with contextlib.ExitStack() as stack:
        stack.callback(end_run, folder)
        workers = Workers(state.spec.pipeline.executor, folder, display.report)
        stack.callback(workers.close)
        stack.callback(alive.release)  # Processes of unfinished steps end then.
        current = Run(state, display, folder, workers)
        try:
            current.execute()
        finally:
            for step in current.running.values():
                step.lock.release()
            state.store.forget()  # An input may have been damaged meanwhile.
            state.publish(state.plan(frozenset()))
        return current


class Run:
    """Execution of one plan.

    Attributes:
        completed: steps that succeeded
        failed: steps that failed, with their outcomes
        held_up: steps that need the result of a failed one
    """

    def __init__(self, state: DatasetState, display: Display, folder: Path, workers: Workers):
        self.state = state
        self.display = display
        self.folder = folder
        self.workers = workers
        self.store = state.store
        self.running: dict[Step, RunningStep] = {}
        self.waiting: set[str] = set()  # keys of steps that another run makes
        self.completed: set[Step] = set()
        self.failed: dict[Step, Outcome] = {}
        self.held_up: list[Step] = []
        self.planned: dict[Step, PlannedStep] = {}
        self.stale = True  # There are results that the plan does not know.

    def execute(self) -> None:
        """Run all steps that can run; the others then wait for a failed step."""
        while self.stale or self.running:
            if self.stale and self.workers.free(1):  # Planning takes time: first all that is ready has started.
                self._plan()
            self.waiting.clear()
            for planned in self.planned.values():
                if planned.status == "to run" and planned.key and self.workers.free(1):
                    self._start(planned)
            if self.running or self.waiting:
                self._wait()
        pending = (p.step for p in self.planned.values() if p.status != "current")
        self.held_up = [step for step in pending if step not in self.failed]

    def _plan(self) -> None:
        planned = self.state.plan(self.state.spec.forced.difference(self.completed, self.failed))
        self.planned = {p.step: p for p in planned}
        self.stale = False
        self.display.plan(planned)
        for p in (p for p in planned if p.status == "to run" and p.step in self.completed - self.failed.keys()):
            error = f"{p.reasons[0]}, although it was made in this run: is the disk failing?"
            self._fail(p.step, p.key, Outcome(error=error))

    def _start(self, planned: PlannedStep) -> None:
        """Start a step if its cores and its lock are free."""
        step = planned.step
        code = self.state.code(step.stage)
        cores = max(code.threads, code.cores)
        if step in self.running or step in self.failed or step in self.completed or not self.workers.free(cores):
            return
        try:
            step_lock = lock(self.store.locks / f"{planned.key}.lock")
        except TimeoutError:
            self.waiting.add(planned.key)
            return self.display.report_once(f"{step}: waiting: another run is making it")
        self.store.forget([planned.key])
        if self.store.get(planned.key) is not None and "forced" not in planned.reasons:
            step_lock.release()  # Another run has made it meanwhile.
            self.stale = True
        else:
            self.display.start(step)
            task = self._task(planned, code)
            future = self.workers.submit(cores, code.threads, run_step, task)
            self.running[step] = RunningStep(step, task, step_lock, future)

    def _task(self, planned: PlannedStep, code: StageCode) -> Task:
        step = planned.step
        stage = self.state.spec.pipeline.stages[step.stage]
        inputs = self.state.inputs[step]
        temporary = self.folder / str(step).replace("/", "-")
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
        outputs = {each.item: self.planned[each].output for each in spec.steps_of(name)}
        return make_view(self.store, outputs, stage.gather)

    def _log_above(self, step: Step, path: Path) -> Path:
        """Write the logs of the current results of all stages above, whichever run made them."""
        above = set(self.state.spec.pipeline.needed([step.stage])) - {step.stage}
        entries = (self.store.entry(p.key) for p in self.planned.values() if p.step.stage in above)
        write_text(path, "".join(json_line(event) for entry in entries if entry for event in entry.events()))
        return path

    def _wait(self) -> None:
        """Wait for outcomes or events; the plan is stale if there are outcomes, or another run makes a step."""
        futures = {work.future: step for step, work in self.running.items()}
        finished = wait(futures, timeout=POLL, return_when=FIRST_COMPLETED).done if futures else set()
        if not futures:
            time.sleep(POLL)
        for work in self.running.values():
            self._read_events(work)
        for future in finished:
            self._collect(self.running.pop(futures[future]))
        self.store.forget(self.waiting)
        self.stale |= bool(finished or self.waiting)

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
                    self.display.warnings.append((work.step, event["warning"]))
                else:
                    self.display.progress(work.step, event["done"], event["total"], event["text"])

    def _collect(self, work: RunningStep) -> None:
        step = work.step
        try:
            outcome = work.future.result()
        except Exception as error:  # of the executor: `run_step` raises nothing
            expected = isinstance(error, InputError)
            outcome = Outcome(error=str(error) if expected else f"{DIED} ({type(error).__name__})")
        work.lock.release()
        if outcome.error is not None:
            return self._fail(step, work.task.key, outcome)
        if self.store.get(work.task.key) not in (None, outcome.output):
            self.display.report(f"warning: {step}: the same inputs gave another result than before")
        self.store.forget([work.task.key])
        self.completed.add(step)
        self.display.finish(step, outcome.seconds)
        if entry := self.store.entry(work.task.key):
            append_text(self.state.results.log, "".join(map(json_line, entry.events())))

    def _fail(self, step: Step, key: str, outcome: Outcome) -> None:
        self.failed[step] = outcome
        self.display.fail(step, outcome.error or "", outcome.traceback)
        event = {"event": "failed", "stage": step.stage, "photo": step.item or None, "text": outcome.error, "key": key}
        append_text(self.state.results.log, json_line(event | {"traceback": outcome.traceback}))


def json_line(event: dict) -> str:
    """Return an event as a line of a log."""
    return json.dumps(event, sort_keys=True) + "\n"
