"""Run a batch on Dask: on a new cluster on this machine, or on an existing scheduler."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import queue
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from tk.batch.jobs import DONE, FAILED, RECORDS, Job, Outcome, described, make_jobs
from tk.batch.summary import write_summary
from tk.batch.work import TOPIC, work
from tk.errors import ConfigError, ResultError, TkError, WorkerError
from tk.run.task import RecordingOptions
from tk.system.files import locked
from tk.system.machine import cores

#: seconds to wait for a scheduler's answer; a remote one may be slow, an absent one never answers
_PATIENCE_S = 8.0
#: killed workers after which a capture is not tried again: it probably needs too much memory
_KILLED_AT_MOST = 3


class BatchReporter(Protocol):
    """Receives the progress of a batch."""

    def note(self, text: str) -> None:
        """Receive a line for the user."""
        ...

    def progress(self, name: str, done: int, total: int) -> None:
        """Receive that a capture has ``done`` of its ``total`` frames."""
        ...

    def finished(self, name: str, outcome: Outcome, done: int, total: int) -> None:
        """Receive the outcome of a capture; ``done`` of the ``total`` captures have ended."""
        ...


def run_batch(
    captures: Sequence[Path],
    folder: Path,
    options: RecordingOptions,
    reporter: BatchReporter,
    workers: int | None = None,
    scheduler: str | None = None,
    pictures: bool = False,
    dashboard: bool = False,
) -> Mapping[str, Outcome]:
    """Track captures, each in a worker process, into ``folder``: `NAME.h5`, `summary.csv`, `summary.html`.

    The same call continues an interrupted batch: finished captures stay, interrupted ones continue after their last
    frame, failed ones are tried again. A capture that fails does not stop the others.

    Args:
        captures: their folders. Workers on other machines need them, and ``folder``, under the same paths.
        folder: output folder; it is created if missing.
        options: options of `tk track`, for all captures.
        reporter: receives the progress.
        workers: processes on this machine, which share its cores; half the number of cores by default.
        scheduler: address of a Dask scheduler to use instead of new processes on this machine.
        pictures: write an overlay video and a report next to each result.
        dashboard: serve Dask's page about workers and tasks, and report its address.

    Returns:
        The outcome of each capture, by its name.

    Raises:
        ConfigError: Dask is not installed, the scheduler does not answer, a capture is given twice, or the file of the
            body cannot be read.
        ResultError: the folder cannot be written, or contains results with other options.
        WorkerError: the scheduler has stopped.
    """
    if workers is not None and scheduler is not None:
        raise ConfigError("workers: a scheduler has its own; give workers or a scheduler, not both")
    if workers is not None and not 1 <= workers <= 1000:
        raise ConfigError(f"workers = {workers}: choose from 1 to 1000")
    described(options)  # fails early if the body cannot be read
    _require_dask(dashboard)
    # a shell's recordings/* names notes and tables beside the captures, too
    files = [path for path in captures if path.is_file()]
    if files and len(files) < len(captures):
        reporter.note(f"left out, because they are files, not captures: {', '.join(map(str, files))}")
        captures = [path for path in captures if path not in files]
    with _locked(folder):
        jobs = make_jobs(captures, folder, options, pictures)
        outcomes = {job.name: job.read() for job in jobs}
        waiting = [job for job in jobs if outcomes[job.name].state != DONE or not job.output.exists()]
        if len(waiting) < len(jobs):
            reporter.note(f"{len(jobs) - len(waiting)} of {len(jobs)} captures are finished already")
        for job in waiting:
            outcomes[job.name] = Outcome()
        write_summary(folder, jobs, outcomes)
        if waiting:
            with _cluster(workers, scheduler, len(waiting), dashboard) as client:
                _report_workers(client, reporter, len(waiting))
                if dashboard:
                    reporter.note(f"dashboard: {client.dashboard_link}")
                for name, outcome in _finished(client, waiting, reporter, scheduler):
                    outcomes[name] = outcome
                    ended = sum(o.state in (DONE, FAILED) for o in outcomes.values())
                    reporter.finished(name, outcome, ended, len(jobs))
                    write_summary(folder, jobs, outcomes)
        return outcomes


def exit_code(outcomes: Mapping[str, Outcome]) -> int:
    """Return the exit code of a batch.

    0: all captures are tracked; 3: some are mostly lost; 2: some failed because of their
    input; 1: some failed because of a defect or a killed worker.
    """
    failed = [outcome for outcome in outcomes.values() if outcome.failed]
    if failed:
        return 1 if any(outcome.trace for outcome in failed) else 2
    return 3 if any(outcome.mostly_lost for outcome in outcomes.values()) else 0


def _require_dask(dashboard: bool) -> None:
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise ConfigError("tk batch needs Dask: pip install 'tk-mocap[cluster]'") from None
    if dashboard and find_spec("bokeh") is None:
        raise ConfigError("the dashboard needs Bokeh: pip install bokeh")


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Create the folder of a batch, and lock it against other batches."""
    try:
        (folder / RECORDS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"{folder}: cannot be created: {error.strerror or error}") from None
    busy = f"{folder}: another tk batch uses it; wait for its end, or choose another"
    with locked(folder / RECORDS, ResultError(busy)):
        yield


async def _check_scheduler(address: str) -> None:
    """Connect once to a Dask scheduler. A client that cannot connect would leave threads and wait for them.

    Raises:
        ConfigError: none answers there.
    """
    from distributed.comm import connect

    try:
        comm = await asyncio.wait_for(connect(address, timeout=_PATIENCE_S), _PATIENCE_S + 1)
    except Exception as error:  # something else may answer, and anything may follow from its answer
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigError(f"scheduler {address}: no Dask scheduler answers there: {reason}") from None
    await comm.close()


@contextlib.contextmanager
def _cluster(workers: int | None, scheduler: str | None, captures: int, dashboard: bool) -> Iterator[Any]:
    """Yield a client of the scheduler, or of a cluster on this machine that ends with the block."""
    import dask
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the outcomes contain what matters
    if scheduler is not None:
        asyncio.run(_check_scheduler(scheduler))
        with Client(scheduler, timeout=_PATIENCE_S, set_as_default=False) as client:
            yield client
        return
    count = min(workers or max(cores() // 2, 1), captures)
    threads = os.environ.get("TK_THREADS") or str(max(cores() // count, 1))
    settings = {
        "distributed.scheduler.allowed-failures": _KILLED_AT_MOST,
        "distributed.scheduler.worker-saturation": 1.0,  # no captures wait in a worker that may be killed
        "distributed.worker.profile.enabled": False,
    }
    with dask.config.set(settings):
        cluster = LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", memory_limit=None,
            dashboard_address=f"127.0.0.1:{_free_port()}" if dashboard else None, silence_logs=logging.CRITICAL,
            env={"TK_THREADS": threads},
        )  # fmt: skip
        with cluster, Client(cluster, set_as_default=False) as client:
            yield client


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def _report_workers(client: Any, reporter: BatchReporter, captures: int) -> None:
    found = client.scheduler_info(n_workers=-1)["workers"].values()
    threads = sum(worker["nthreads"] for worker in found)
    reporter.note(f"captures to track: {captures}; workers: {len(found)}")
    if not found:
        reporter.note("the scheduler has no workers yet; waiting for them")
    elif threads > len(found):
        reporter.note(
            f"{len(found)} workers have {threads} threads; a worker tracks one capture at a time: start workers "
            "of one thread, as many as there are captures to be tracked at once"
        )


def _finished(
    client: Any, jobs: Sequence[Job], reporter: BatchReporter, scheduler: str | None
) -> Iterator[tuple[str, Outcome]]:
    """Yield names and outcomes of the jobs as they end."""
    from distributed.comm import CommClosedError

    messages: queue.SimpleQueue[Any] = queue.SimpleQueue()
    client.subscribe_topic(TOPIC, lambda event: messages.put(event[1]))
    waiting: dict[str, Job] = {}
    for priority, job in enumerate(jobs):
        # impure: the scheduler must not return a stored outcome of an earlier run with the same name
        future = client.submit(work, job, key=f"tk-{job.name}-{os.urandom(6).hex()}", priority=-priority, pure=False)
        waiting[future.key] = job
        future.add_done_callback(messages.put)
    begun: set[str] = set()
    while waiting:
        item = messages.get()
        if isinstance(item, dict):
            name, done = str(item["name"]), int(item["done"])
            if item["begins"] and name in begun:
                reporter.note(f"{name}: its worker died (out of memory?); another one continues after {done} frames")
            begun |= {name} if item["begins"] else set()
            reporter.progress(name, done, int(item["total"]))
            continue
        job = waiting.pop(item.key)
        try:
            outcome = None if item.cancelled() else _outcome(item, job)
        except CommClosedError:
            outcome = None
        if outcome is None:
            raise WorkerError(
                f"{scheduler or 'the batch'}: the scheduler has stopped; the same command continues the batch"
            )
        yield job.name, outcome


def _outcome(future: Any, job: Job) -> Outcome:
    """Return the outcome of a job, or a failed one if its worker did not return."""
    from distributed.scheduler import KilledWorker

    error = future.exception()
    if error is None:
        outcome = future.result()
        assert isinstance(outcome, Outcome)
        return outcome
    if isinstance(error, KilledWorker):
        failure = f"its worker was killed {_KILLED_AT_MOST + 1} times (out of memory?); use fewer workers"
    else:
        failure = f"the worker failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
    outcome = Outcome(FAILED, failure=failure, trace=f"{type(error).__name__}: {error}")
    try:
        job.write(outcome)
    except TkError as unwritten:
        outcome = replace(outcome, failure=f"{failure}; {unwritten}")
    return outcome
