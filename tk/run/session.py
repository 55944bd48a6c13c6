"""A run: track a recording or another source, write the result frame by frame, and finish it."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.capture import Capture
from tk.io.captures.film import Film
from tk.io.captures.mask_store import MaskStores
from tk.io.results.files import check_result_path
from tk.io.results.reader import read_result
from tk.io.results.revision import revise_people
from tk.io.results.status import Status
from tk.io.results.writer import ResultWriter
from tk.run.loop import Loop, Output
from tk.run.offline import finish, named
from tk.run.plan import open_plan, recording_task
from tk.run.reporter import Reporter
from tk.run.task import RecordingOptions, Task
from tk.threads import one_thread
from tk.trackers.protocol import Estimate
from tk.trackers.reason import report_frames


@dataclass(frozen=True)
class Summary:
    """Outcome of a run.

    Attributes:
        status: (F,) status of the frames in the result, including those of earlier runs; of all people in turn.
        seconds: duration of this run.
        tracked_now: number of frames that this run added.
        interrupted: whether Ctrl-C stopped it.
        people: number of people in the result.
    """

    status: NDArray[np.uint8]
    seconds: float
    tracked_now: int
    interrupted: bool = False
    people: int = 1

    @property
    def frames(self) -> int:
        """Number of frames, summed over the people."""
        return len(self.status)

    @property
    def present(self) -> int:
        """Number of frames in which the person is present."""
        return int((self.status != Status.ABSENT).sum())

    @property
    def lost(self) -> int:
        """Number of frames in which the person is present, but not found."""
        return int((self.status == Status.LOST).sum())

    @property
    def suspect(self) -> int:
        """Number of frames with a pose that the residual contradicts."""
        return int((self.status == Status.SUSPECT).sum())

    @property
    def mostly_lost(self) -> bool:
        """Whether more than half of the frames in which the person is present are lost or suspect."""
        return 2 * (self.lost + self.suspect) > self.present


def track(
    capture: Capture,
    output: Path,
    options: RecordingOptions,
    reporter: Reporter,
    resume: bool = False,
    force: bool = False,
    film: Film | None = None,
) -> Summary:
    """Track a recording and write the result, see :func:`track_task`.

    Raises:
        TkError: bad input; every frame finished before it is in the file.
    """
    masks = Path(capture.masks) if capture.masks not in ("auto", "none", "median") else None
    inputs = [options.init_pose, capture.init_keypoints, options.body, masks]
    check_result_path(output, force, resume, inputs, capture.path)
    return track_task(recording_task(capture, options), output, reporter, resume, force, film)


def track_task(
    task: Task,
    output: Path,
    reporter: Reporter,
    resume: bool = False,
    force: bool = False,
    film: Film | None = None,
) -> Summary:
    """Track the people in a scene and write the result, frame by frame.

    People are found in the frame of the initialisation and tracked forwards; frames before ``task.options.frames`` are
    tracked but not written. Ctrl-C ends the run with all finished frames in the file, closed and ready for ``resume``.

    Args:
        task: the scene, the images, and the options.
        output: the result file.
        reporter: receives notes and progress.
        resume: continue where an earlier run of the same command stopped.
        force: replace an existing result.
        film: takes small images of the frames, unless an earlier run has tracked some of them.

    Raises:
        TkError: bad input; every frame finished before it is in the file.
    """
    check_result_path(output, force, resume)
    if resume and output.exists():
        film = None
    said: list[str] = []
    causal = task.options.causal

    def note(text: str) -> None:
        if text not in said:  # a resumed run repeats what it says about its inputs
            said.append(text)
        reporter.note(text)

    for text in task.notes:
        note(text)
    with open_plan(task, note, film) as plan:
        meta = plan.meta()
        writer, done = ResultWriter.resume(output, meta) if resume else (ResultWriter.create(output, meta), 0)
        second_pass = not causal and plan.tracker.has_second_pass
        stores = MaskStores(output, bool(done))
        if not (done or second_pass):
            stores.remove()  # of a stopped run; for a second pass, the first frame replaces them
        masks = stores if second_pass else None  # it needs those of all frames
        loop = Loop(plan, note, Output(writer, done, plan.origin(), said), masks)
        started = time.perf_counter()
        interrupted, status = False, list[NDArray[np.uint8]]()
        try:
            with writer:
                reporter.begin(plan.total, min(done, plan.total) if plan.total else done)
                for frame, estimates in enumerate(loop.estimates(), plan.begin + done):
                    reporter.advance(frame, estimates[0] if estimates else None)
            if loop.written or loop.restore_unfinished(output):
                damaged: Sequence[str] = ()  # images that may be the cause
                if (doubted := loop.people.doubted).any():
                    damaged = task.source.damaged(plan.begin + done + loop.written, doubted)
                for line in (*damaged, *loop.people.report()):
                    note(line)
                found = read_result(output).people
                with one_thread():
                    finished = finish(
                        found, task, loop.people, masks, note, reporter.within, plan.observations.film_again
                    )
                if said or finished.revisions:
                    revise_people(output, finished.revisions, finished.cameras, said or None)
                status = finished.status
            stores.remove()
        except KeyboardInterrupt:
            # caught outside the writer, which then keeps an older result if no frame is finished
            interrupted = True
        finally:
            if not done + loop.written:
                stores.remove()
        if not status and done + loop.written:  # nothing was left to do, or it was interrupted
            status = [person.status for person in read_result(output).people]
        whole = np.concatenate(status) if status else np.zeros(0, np.uint8)
        return Summary(whole, time.perf_counter() - started, loop.written, interrupted, max(len(status), 1))


def estimates(task: Task, note: Callable[[str], None] = lambda _: None) -> Iterator[Estimate]:
    """Track the people in a scene and yield their estimates, as the first pass finds them, frame by frame and in the
    order of the people's numbers. No file is written; ``note`` receives lines for the user.

    Raises:
        TkError: bad input.
    """
    for line in task.notes:
        note(line)
    with open_plan(task, note) as plan:
        loop = Loop(plan, note)
        found: defaultdict[int, dict[int, int]] = defaultdict(dict)  # reasons by frame, by person
        for estimate in chain.from_iterable(loop.estimates()):
            if estimate.reason:
                found[estimate.person][estimate.frame] = estimate.reason
            yield estimate
        for line in loop.people.report():
            note(line)
        for number, reasons in sorted(found.items()):
            about = note if len(loop.people.written) == 1 else named(number, note)
            report_frames(list(reasons), list(reasons.values()), about)
