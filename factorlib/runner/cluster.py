"""Steps on a Dask cluster: each is a task with keys and paths, its result lands in the store, which all workers see.

The cluster is that of a scheduler that is running, or one of this machine that lives as long as the run.  A task is handed
to a child process of its worker (`factorlib.runner.host`), so that bits do not depend on how workers were started.  A task
whose worker or child dies is tried again, on its own: nothing else is lost.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from factorlib.errors import InputError
from factorlib.runner.blocks import CORES, TRIES, Site, params_at, started_by, step_at
from factorlib.runner.executors import machine_cores
from factorlib.runner.pipeline import ADDRESS
from factorlib.runner.project import LIBRARY
from factorlib.runner.stop import whole
from factorlib.runner.worker import check_params, run_step
from factorlib.wholefile import write_text

AHEAD = 2  # steps are handed out for so many times the cores, so that no worker waits for the next
FRESH = 1.0  # seconds for which the scheduler is not asked again who its workers are
PATIENCE = 10  # seconds to reach a scheduler, and for steps to end that are cancelled
QUIET = {  # what Dask does by itself between tasks: without these, a worker that waits takes 4 % of a core
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
}
AT = {run_step: step_at, check_params: params_at}  # what a child calls in place of it


class Cluster:
    """The executors of a Dask cluster, with the interface of `factorlib.runner.executors.Pools`.

    scheduler: its address; None for a cluster of this machine's cores
    run: folder of the run, in the store
    """

    def __init__(self, scheduler: str | None, run: Path, say: Callable[[str], None]):
        if find_spec("distributed") is None:
            raise InputError(
                "Dask is not installed", key="executor", cure="make setup EXTRAS=dask, or pip install 'factorlib[dask]'"
            )
        self.site = Site(run, run / "mark")
        write_text(self.site.mark, "")
        self._executors: dict[int | None, Executor] = {}
        self._known: tuple[float, dict[str, int]] = (-FRESH, {})
        self._busy: dict[Future, int] = {}
        self._ends = contextlib.ExitStack()
        with whole(), contextlib.ExitStack() as ends:
            self.client = ends.enter_context(_client(scheduler))
            self._ends = ends.pop_all()
        try:
            self._check(scheduler, say)
        except BaseException:
            self._ends.close()
            raise

    @property
    def cores(self) -> int:
        """Those of all workers that are there now; 1 where none is."""
        return max(1, sum(self._declared().values()))

    def free(self, cores: int) -> bool:
        """Whether a step of `cores` cores may be handed out now."""
        busy = sum(self._busy.values())
        return busy == 0 or busy + cores <= AHEAD * self.cores

    def submit(self, cores: int, threads: int, function: Callable, argument: Any) -> Future:
        """Hand out `function(argument)`; one that takes more cores than threads hands out blocks itself, and holds no core meanwhile."""
        from factorlib.runner.host import hosted

        spreads = cores > threads
        executor = self._executor(None if spreads else min(threads, max(self._declared().values(), default=threads)))
        with whole():
            future = _known(executor.submit(hosted, self.site.run, threads, spreads, AT[function], self.site, argument))
            self._busy[future] = cores
            return future

    def done(self, future: Future) -> None:
        """Take note that a future is finished."""
        del self._busy[future]

    def close(self, kill: bool = False) -> None:
        """Leave the cluster; `kill`: tasks that are not finished are cancelled, and their processes killed."""
        for executor in self._executors.values():
            executor.shutdown(wait=not kill)
        if kill:
            with contextlib.suppress(Exception):  # of a cluster that is gone
                self._wait_until_nothing_runs()
        self._ends.close()

    def _executor(self, cores: int | None) -> Executor:
        if cores not in self._executors:
            resources = {} if cores is None else {"resources": {CORES: cores}}
            self._executors[cores] = self.client.get_executor(pure=False, retries=TRIES - 1, **resources)
        return self._executors[cores]

    def _declared(self) -> dict[str, int]:
        """The cores that each worker declares, by its address, as the scheduler said not long ago."""
        asked, known = self._known
        if time.monotonic() - asked >= FRESH:
            workers = self.client.scheduler_info(n_workers=-1)["workers"]
            known = {address: int(facts["resources"].get(CORES, 0)) for address, facts in workers.items()}
            self._known = time.monotonic(), known
        return known

    def _check(self, scheduler: str | None, say: Callable[[str], None]) -> None:
        """Wait for a worker; InputError where any of those that are there cannot do what it must."""
        if not self._declared():
            say(f"waiting: no worker yet at {scheduler}; {started_by(str(scheduler))}")
            while not self._declared():
                time.sleep(FRESH)
        if lacking := [address for address, cores in self._declared().items() if not cores]:
            cure = f"{started_by(str(scheduler))}\n  or let it declare them: dask worker --nthreads 8 --resources {CORES}=8"
            raise InputError(f"the worker {lacking[0]} does not say how many cores it has", key="scheduler", cure=cure)
        for found in self.client.run(_fault, self.site).values():
            if found is not None:
                raise found

    def _wait_until_nothing_runs(self) -> None:
        from factorlib.runner.host import busy

        end = time.monotonic() + PATIENCE
        while time.monotonic() < end and any(self.client.run(busy, self.site.run).values()):
            time.sleep(0.1)


def _fault(site: Site) -> InputError | None:
    """What is wrong with a worker."""
    try:
        site.check()
        return None
    except InputError as error:
        return error


@contextlib.contextmanager
def _client(scheduler: str | None) -> Iterator[Any]:
    import dask
    from distributed import Client, LocalCluster
    from distributed.deploy.utils import nprocesses_nthreads

    for name in ("distributed", "distributed.client", "distributed.core", "distributed.comm"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what they say of a lost connection is in the outcome
    if scheduler is None:
        workers, threads = nprocesses_nthreads(machine_cores())
        with (
            dask.config.set(
                dask.config.merge(dask.config.config, dask.config.collect_env(QUIET))
            ),  # `set` replaces whole branches
            LocalCluster(
                workers,
                threads,
                host="127.0.0.1",
                dashboard_address=None,
                memory_limit=0,
                resources={CORES: threads},
                silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            yield client
        return
    try:
        with ThreadPoolExecutor(1) as beside:  # a notebook runs an event loop in this thread already
            beside.submit(asyncio.run, _answered(scheduler)).result()
        client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
    except (
        Exception
    ) as error:  # what answers there may be anything: garbage, an HTTP server, a protocol that is not installed
        cure = "start one: dask scheduler --port 8786; or leave the scheduler out, for a cluster of this machine"
        said = str(error) or f"nothing in {PATIENCE} s"
        raise InputError(f"no Dask scheduler answers at {scheduler} ({said})", key="scheduler", cure=cure) from error
    with client:
        yield client


async def _answered(scheduler: str) -> None:
    """Ask what listens there who it is; TimeoutError where it says nothing in time, for which a client would wait without end."""
    from distributed.core import rpc
    from distributed.security import Security

    remote = rpc(scheduler, timeout=PATIENCE, connection_args=Security().get_connection_args("client"))
    try:
        await asyncio.wait_for(remote.identity(), PATIENCE)
    finally:
        await remote.close_rpc()


def _known(asked: Future) -> Future:
    """A future with what Dask says of dead workers in the words of `concurrent.futures`."""
    answer: Future = Future()

    def take_over(asked: Future) -> None:
        """The outcome, once it is there."""
        if asked.cancelled():
            answer.set_exception(BrokenProcessPool("the task was cancelled"))
        elif (error := asked.exception()) is None:
            answer.set_result(asked.result())
        else:
            died = type(error).__name__ in ("KilledWorker", "Unwanted")
            answer.set_exception(BrokenProcessPool(str(error)) if died else error)

    asked.add_done_callback(take_over)
    return answer


def start_worker(scheduler: str, cores: int | None, more: list[str]) -> None:
    """Become a worker of the cluster at `scheduler` with so many cores (default: this machine's), started as steps need it."""
    if find_spec("distributed") is None:
        raise InputError(
            "Dask is not installed", key="worker", cure="make setup EXTRAS=dask, or pip install 'factorlib[dask]'"
        )
    if not ADDRESS.fullmatch(scheduler):
        raise InputError(
            f"{scheduler!r} is no address", key="worker", cure="write tcp://<host>:<port>, as tcp://10.0.0.1:8786"
        )
    count = str(cores or machine_cores())
    options = [
        "--nthreads",
        count,
        "--nworkers",
        "1",
        "--resources",
        f"{CORES}={count}",
        "--memory-limit",
        "0",
        "--no-dashboard",
    ]
    path = os.pathsep.join([str(LIBRARY), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "distributed.cli.dask_worker", scheduler, *options, *more]
    os.execve(sys.executable, command, {**QUIET, **os.environ, "PYTHONPATH": path})
