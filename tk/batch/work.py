"""What a worker does with a job: track the capture, go on where an earlier attempt stopped, and say how it went."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.batch.jobs import BEGUN, DONE, FAILED, Job, Outcome
from tk.errors import ResultBusyError, TkError

#: topic of the workers' news for whoever runs the batch
TOPIC = "tk-batch"

_TELL_EVERY_S = 1.0
# an attempt whose worker lost the scheduler may go on for a while
_WAIT_S, _ASK_EVERY_S = 60.0, 2.0

# Taichi knows one user; a worker with several threads does its captures one by one
_ONE_AT_A_TIME = threading.Lock()


def work(job: Job) -> Outcome:
    """Track a capture in this process; whatever goes wrong is in the outcome, which is in the job's record, too."""
    with _ONE_AT_A_TIME:
        reporter = _Reporter(job.name, _teller())
        started = time.perf_counter()
        try:
            job.write(Outcome(BEGUN))
            outcome = _track(job, reporter)
        except TkError as error:
            outcome = Outcome(FAILED, failure=" ".join(str(error).split()))
        except Exception as error:
            what = f"a defect of tk: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
            outcome = Outcome(FAILED, failure=f"{what} (traceback in {job.record})", trace=traceback.format_exc())
        outcome = replace(outcome, seconds=time.perf_counter() - started, said=tuple(reporter.notes))
        try:
            job.write(outcome)
        except TkError as error:
            outcome = replace(outcome, state=FAILED, failure=str(error))
        return outcome


def _track(job: Job, reporter: _Reporter) -> Outcome:
    from tk.io.captures.capture import open_capture
    from tk.io.results.writer import Status, read_result
    from tk.report.after import write_video_and_report
    from tk.run import session  # the driver needs none of it

    options = job.options
    capture = open_capture(job.capture, options.cameras, options.masks)
    deadline = time.monotonic() + _WAIT_S
    while True:
        reporter.notes.clear()
        try:
            summary = session.track(
                capture, job.output, options.config, reporter, options.method, options.frames,
                resume=True, store_hull=options.store_hull, body=options.body, causal=options.causal,
            )  # fmt: skip
            break
        except ResultBusyError:
            if time.monotonic() > deadline:
                raise
            time.sleep(_ASK_EVERY_S)
    if job.pictures:
        write_video_and_report(capture, job.output, reporter.note)
    result = read_result(job.output)
    known = result.status != Status.LOST
    error_cm, limbs_cm = _errors(job, reporter.note)
    return Outcome(
        DONE,
        frames=summary.frames,
        lost=int((~known).sum()),
        tracked_now=summary.tracked_now,
        error_cm=error_cm,
        limbs_cm=limbs_cm,
        silhouette_error=_typical(np.mean, result.silhouette_error, known),
        sigma_cm=_typical(np.median, result.sigma, known, 100),
    )


def _errors(job: Job, note: Callable[[str], None]) -> tuple[float | None, float | None]:
    """The distances from the capture's truth, where it has one: of all joints, and of the limbs without offsets."""
    from tk.evaluation.joints import evaluate_files

    truth = job.capture / "truth.h5"
    if not truth.exists():
        return None, None
    try:
        found = evaluate_files(job.output, truth)
    except TkError as error:
        note(f"not compared with the truth: {error}")
        return None, None
    error_cm, limbs_cm = (float(score.mean_cm) for score in (found.raw.all, found.corrected.limbs))
    return (error_cm if np.isfinite(error_cm) else None), (limbs_cm if np.isfinite(limbs_cm) else None)


def _typical(
    typical: Callable[[Any], Any], values: NDArray[np.float64] | None, known: NDArray[np.bool_], scale: float = 1.0
) -> float | None:
    """A mean or median of the numbers (F, …) of known frames (F,); None where there is none."""
    if values is None:
        return None
    numbers = values[known]
    numbers = numbers[np.isfinite(numbers)]
    return scale * float(typical(numbers)) if numbers.size else None


class _Reporter:
    """Remembers notes, and tells now and then how far it is."""

    def __init__(self, name: str, tell: Callable[[dict[str, Any]], None]) -> None:
        self.notes: list[str] = []
        self._name, self._tell = name, tell
        self._done = self._total = 0
        self._told = 0.0

    def note(self, text: str) -> None:
        self.notes.append(text)

    def begin(self, total: int, done: int) -> None:
        self._total, self._done = total, done
        if done:
            self.note(f"{done} of {total} frames were there already")
        self._send()

    def advance(self, frame: int, estimate: object) -> None:
        self._done += 1
        if time.monotonic() - self._told > _TELL_EVERY_S or self._done == self._total:
            self._send()

    def _send(self) -> None:
        self._told = time.monotonic()
        self._tell({"name": self._name, "done": self._done, "total": self._total})


def _teller() -> Callable[[dict[str, Any]], None]:
    """Tells whoever runs the batch; nobody outside of a Dask worker."""
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:
        return lambda news: None
    return lambda news: worker.log_event(TOPIC, news)
