"""Do a job in a worker: track the capture, or continue an earlier attempt, and return the outcome."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tk.batch.jobs import BEGUN, DONE, FAILED, Job, Outcome
from tk.errors import ResultBusyError, TkError

if TYPE_CHECKING:
    from tk.io.results.data import JointTrack

#: Dask topic of the workers' progress
TOPIC = "tk-batch"

# seconds between two messages of progress; more messages would load the scheduler
_PERIOD_S = 1.0
# A worker that lost the scheduler may still write the result. Seconds to wait for it, and between two attempts.
_WAIT_S, _RETRY_S = 60.0, 2.0

# Movement of the limbs below which errors without offsets are not given, cm: a limb of 30 cm then turns by less than
# 10°, and the constant offset of its joint, which turns with it, changes by less than a fifth.
_MOVEMENT_CM = 5.0

# Taichi supports one thread of calls; a worker with several threads tracks its captures one by one
_ONE_AT_A_TIME = threading.Lock()


def work(job: Job) -> Outcome:
    """Track a capture in this process; return the outcome, also after errors, and write it to the job's record."""
    with _ONE_AT_A_TIME:
        reporter = _Reporter(job.name, _sender())
        started = time.perf_counter()
        try:
            job.write(Outcome(BEGUN))
            outcome = _track(job, reporter)
        except TkError as error:
            outcome = Outcome(FAILED, failure=error.line)
        except Exception as error:
            what = f"a defect of tk: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
            outcome = Outcome(FAILED, failure=f"{what} (traceback in {job.record})", trace=traceback.format_exc())
        outcome = replace(outcome, seconds=time.perf_counter() - started, notes=tuple(reporter.notes))
        try:
            job.write(outcome)
        except TkError as error:
            outcome = replace(outcome, state=FAILED, failure=str(error))
        return outcome


def _track(job: Job, reporter: _Reporter) -> Outcome:
    from tk.io.importers import open_recording
    from tk.io.results.reader import read_result
    from tk.report.after import film_for, write_video_and_report
    from tk.run import session  # heavy; the process that starts the batch does not need it

    options = job.options
    capture = open_recording(job.capture, options.cameras, options.masks, options.settings.resample)
    film = film_for(capture, job.output) if job.pictures else None
    deadline = time.monotonic() + _WAIT_S
    while True:
        reporter.notes.clear()
        try:
            summary = session.track(capture, job.output, options, reporter, resume=True, film=film)
            break
        except ResultBusyError:
            if time.monotonic() > deadline:
                raise
            time.sleep(_RETRY_S)
    if job.pictures:
        write_video_and_report(capture, job.output, reporter.note, film)
    people = read_result(job.output).people
    known = np.concatenate([person.has_pose for person in people])
    error_cm, limbs_cm = _errors(job, reporter.note)
    return Outcome(
        DONE,
        frames=summary.frames,
        lost=summary.lost,
        suspect=summary.suspect,
        present=summary.present,
        tracked_now=summary.tracked_now,
        error_cm=error_cm,
        limbs_cm=limbs_cm,
        silhouette_error=_typical(np.mean, [person.silhouette_error for person in people], known),
        sigma_cm=_typical(np.median, [person.sigma for person in people], known, 100),
    )


def _errors(job: Job, note: Callable[[str], None]) -> tuple[float | None, float | None]:
    """Return the mean distances from the ground truth, cm: of all joints, and of the limbs without offsets; of several
    people, the means of those who were found, without offsets of those whose limbs move."""
    from tk.evaluation.joints import evaluate
    from tk.evaluation.people import evaluate_people
    from tk.io.results.reader import read_people, read_truth

    truth = job.capture / "truth.h5"
    if not truth.exists():
        return None, None
    try:
        people, true = read_people(job.output), read_truth(truth)
        if len(people) == len(true) == 1:
            found = [(evaluate(people[0], true[0]), true[0])]
        else:
            scores = evaluate_people(people, true).people
            found = [(score.errors, true[score.person]) for score in scores if score.errors is not None]
    except TkError as error:
        note(f"no comparison with the ground truth: {error}")
        return None, None
    if not found:
        return None, None
    error_cm = float(np.mean([errors.raw.all.mean_cm for errors, _ in found]))
    moved_cm = np.array([_movement_cm(track, people[0].frames) for _, track in found])
    limbs_cm = np.array([errors.corrected.limbs.mean_cm for errors, _ in found])[moved_cm >= _MOVEMENT_CM]
    if not len(limbs_cm):
        note(
            f"no error without offsets: the limbs move by {moved_cm.max():.1f} cm about the trunk, less than "
            f"{_MOVEMENT_CM:g} cm, so constant offsets would explain nearly all of the error"
        )
    has_limbs = len(limbs_cm) and np.isfinite(limbs_cm).all()
    return (error_cm if np.isfinite(error_cm) else None), (float(limbs_cm.mean()) if has_limbs else None)


def _movement_cm(truth: JointTrack, tracked: NDArray[np.int64]) -> float:
    """Return how far a person's limb joints move about the trunk in the tracked frames: the largest root mean square
    of the joints, cm, by the ground truth."""
    from tk.evaluation.joints import trunk_axes
    from tk.model.body.joints import JOINTS, LIMB_JOINTS

    p_world = truth.positions[np.isin(truth.frames, tracked)]
    limbs = p_world[:, [JOINTS.index(name) for name in LIMB_JOINTS]] - p_world[:, None, JOINTS.index("pelvis")]
    in_trunk = np.einsum("fki,fjk->fji", trunk_axes(p_world), limbs)
    in_trunk = in_trunk[np.isfinite(in_trunk).all(axis=(1, 2))]
    return 100 * float(np.sqrt(in_trunk.var(axis=0).sum(axis=1).max())) if len(in_trunk) else 0.0


def _typical(
    typical: Callable[[Any], Any],
    values: Sequence[NDArray[np.float64] | None],
    known: NDArray[np.bool_],
    scale: float = 1.0,
) -> float | None:
    """Return the mean or median of finite values, by person (F, …), in known frames of all people; None without any."""
    arrays = [array for array in values if array is not None]
    if not arrays:
        return None
    numbers = np.concatenate(arrays)[known]
    numbers = numbers[np.isfinite(numbers)]
    return scale * float(typical(numbers)) if numbers.size else None


class _Reporter:
    """Collects notes, and sends the progress from time to time."""

    def __init__(self, name: str, send: Callable[[dict[str, Any]], None]) -> None:
        self.notes: list[str] = []
        self._name, self._send_message = name, send
        self._done = self._total = 0
        self._sent = 0.0

    def note(self, text: str) -> None:
        self.notes.append(text)

    def begin(self, total: int, done: int) -> None:
        self._total, self._done = total, done
        if done:
            self.note(f"{done} of {total} frames were finished already")
        self._send(begins=True)

    def advance(self, frame: int, estimate: object) -> None:
        self._done += 1
        if time.monotonic() - self._sent > _PERIOD_S or self._done == self._total:
            self._send()

    def within(self, share: float) -> None:
        pass

    def _send(self, begins: bool = False) -> None:
        self._sent = time.monotonic()
        self._send_message({"name": self._name, "done": self._done, "total": self._total, "begins": begins})


def _sender() -> Callable[[dict[str, Any]], None]:
    """Return a function that sends progress to the batch; outside a Dask worker it does nothing."""
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:
        return lambda message: None
    return lambda message: worker.log_event(TOPIC, message)
