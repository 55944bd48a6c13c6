"""The loop of a run: start or restore the trackers, step them through the source, write their estimates."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.errors import CaptureError, ResultError, TkError
from tk.io.captures.mask_store import MaskStores
from tk.io.results.codec import decode, encode
from tk.io.results.data import HullPoints, Value
from tk.io.results.reader import as_damage_error, read_result
from tk.io.results.status import Status
from tk.io.results.writer import ResultWriter
from tk.model.body.body_fit import INFORMATIVE_FRAMES
from tk.people.people import People, PeopleState
from tk.people.person import Answer
from tk.run.offline import REFINED
from tk.run.plan import Plan
from tk.run.prefetch import Observed
from tk.run.segmentation import landmark_asker, sources_of_masks
from tk.threads import one_thread
from tk.trackers.protocol import Estimate, Frame, shows_person, two_pass

_LOG = logging.getLogger(__name__)
Row = dict[str, ArrayLike]

# Seconds between two writes to the file; frames finished within this time are written and reported together. A shorter
# time costs more writes; a longer one loses more frames when the process is killed.
WRITE_EVERY_S = 0.5

# Most bytes of the frames that are held at the start, unless the body needs more: of eight 4K cameras 12 frames.
_OPENING_BYTES = 4_000_000_000

_ORIGIN = "run/"


@dataclass(frozen=True)
class RunState:
    """What a resumed run needs: the people, and the notes for the user until now."""

    people: PeopleState
    said: list[str]


@dataclass
class Output:
    """The result file of a run.

    Attributes:
        done: number of frames that an earlier run has finished.
        origin: what must agree with the earlier run.
        said: the notes for the user until now, those of the earlier run included once it is restored.
    """

    writer: ResultWriter
    done: int
    origin: Mapping[str, str]
    said: list[str]

    def check(self) -> None:
        """Raise ResultError if the earlier run had other inputs or settings."""
        for name, value in self.origin.items():
            found = self.writer.state.get(_ORIGIN + name)
            if found != value:
                raise ResultError(
                    f"{self.writer.path}: was made differently: {name}: {found}, not {value}",
                    hint="start again with --force instead of --resume",
                )

    def check_open(self) -> None:
        """Raise ResultError if no frames can be added, because the second pass has changed the earlier ones."""
        if any(REFINED in model for model in self.writer.models):
            raise ResultError(
                f"{self.writer.path}: a second pass has gone over its frames, so no more can be added; only a causal "
                "result can be continued",
                hint="start again with --force instead of --resume",
            )


class Loop:
    """Steps the trackers of a run through its source, and writes their estimates.

    Attributes:
        written: number of frames in the file that this loop has added, even if the run is interrupted.
        people: who is tracked.
    """

    def __init__(
        self,
        plan: Plan,
        note: Callable[[str], None],
        output: Output | None = None,
        masks: MaskStores | None = None,
    ) -> None:
        self.plan, self.output, self.masks, self._note = plan, output, masks, note
        self.written = 0
        self._held: list[tuple[Row, dict[int, Row]]] = []  # of frames that are not in the file yet
        task = plan.task
        self.people = People(task.setup, task.settings, task.options.people, plan.tracker, note)
        self._ask = landmark_asker(task)

    def estimates(self) -> Iterator[tuple[Estimate, ...]]:
        """Start or restore the trackers, step them to the end and yield the estimates of all people in each frame; they
        are in the file already, except those before the first person, which are written with that person's first frame.

        Raises:
            TkError: bad input, or nobody is found.
        """
        plan, output = self.plan, self.output
        done = output.done if output else 0
        if output and done:
            output.check()
        if plan.stop is not None and plan.begin + done >= plan.stop:
            return
        if output and done:
            output.check_open()
            self._restore(output)
            yield from self._step_through(self._with_network(plan.observations.frames(plan.begin + done, plan.stop)))
            return
        # The body is fitted to the same frames however few are asked for, so that --resume may extend a run.
        count = self._opening_frames()
        stop = None if plan.stop is None else plan.stop + count
        observations = self._with_network(plan.observations.frames(plan.first, stop))
        _LOG.info("reading the first frames and learning what the scene looks like")
        plan.tracker.prepare(with_landmarks=bool(sources_of_masks(plan.task.source)))
        yield from self._step_through(self._started(observations, count))
        if not self.people.written:
            raise CaptureError(f"{plan.task.source.where}: nobody could be tracked: {self.people.refusal}")

    def _with_network(self, observations: Iterator[Observed]) -> Iterator[Observed]:
        """Yield the observations, with a network that may be asked for landmarks if there is one."""
        for observation, laps in observations:
            if self._ask is not None and observation.images.size:
                observation = replace(observation, ask=partial(self._ask, observation.images))
            yield observation, laps

    def _started(self, observations: Iterator[Observed], count: int) -> Iterator[Observed]:
        """Yield the observations; start the trackers before the first frame with somebody in the volume is yielded.

        Args:
            observations: from the first frame on.
            count: number of frames that the body is fitted to.
        """
        opening: list[Observed] = []
        observations = _fill(opening, observations, 1)
        if opening:
            with one_thread():  # while the others are made
                self.people.anticipate(opening[0][0])
        observations = _fill(opening, observations, count)
        source, stop = self.plan.task.source, self.plan.stop
        while opening and (stop is None or opening[0][0].index < stop):
            try:
                with one_thread():
                    if self.people.start([o for o, _ in opening], source.has_masks):
                        break
            except CaptureError as error:
                every = np.ones(len(self.plan.task.setup.rig), np.bool_)
                reasons = "; ".join([str(error), *source.damaged(opening[-1][0].index + 1, every)])
                raise CaptureError(f"{source.where}: {reasons}", error.hint) from None
            yield opening.pop(0)
            observations = _fill(opening, observations, count)
        opening.reverse()
        while opening:
            yield opening.pop()  # images are large
        yield from observations

    def _opening_frames(self) -> int:
        """Return the number of frames that the body is fitted to: fewer where the images are large."""
        task, count = self.plan.task, self.plan.tracker.opening_frames
        rig = task.setup.rig
        held = 5 * len(rig) * math.prod(rig.frame_shape)  # bytes of a frame: image, mask and uncertain pixels
        fewer = min(count, max(_OPENING_BYTES // held, INFORMATIVE_FRAMES))
        if fewer < count:
            self._note(
                f"{task.source.where}: the images are large; the body is fitted to {fewer} frames instead of {count}"
            )
        return fewer

    def restore_unfinished(self, path: Path) -> bool:
        """Restore the trackers if all frames are written but the result is not finished; return whether that is so.

        Without segments, a result has no trace of its end, which adds notes only: they are written once more.
        """
        output, tracker = self.output, self.plan.tracker
        if output is None or not output.done:
            return False
        one_pass = self.plan.task.options.causal or not tracker.has_second_pass
        results = zip(output.writer.models, read_result(path).people, strict=True)
        if all(r.smoothed is not None and (one_pass or REFINED in model) for model, r in results):
            return False
        self._restore(output)
        return True

    def _restore(self, output: Output) -> None:
        with as_damage_error(output.writer.path, "the state of the run"):
            state = decode(RunState, output.writer.state)
            self.people.resume(output.writer.models, state.people)
        output.said[:] = dict.fromkeys([*state.said, *output.said])  # this run has repeated those about its inputs

    def _step_through(self, observations: Iterator[Observed]) -> Iterator[tuple[Estimate, ...]]:
        """Step the trackers to the end; estimates are yielded when they are in the file."""
        output, stop = self.output, self.plan.stop
        finished: list[tuple[Estimate, ...]] = []
        # when the file was last written (the first frame at once), and how long it took after the frame before
        written, writing = -np.inf, 0.0
        try:
            for observation, laps in observations:
                if stop is not None and observation.index >= stop:
                    break
                started = time.perf_counter()
                estimates = self._step(observation)
                if estimates is None:
                    continue
                stepped = time.perf_counter()
                total = laps["wait"] + writing + stepped - started
                due = not output or stepped - written > WRITE_EVERY_S
                if output:
                    rows = {e.person: _row(e, self.plan.task.options.store_hull) for e in estimates}
                    self._held.append((_run_row(estimates, {**laps, "total": total}), rows))
                    if self.people.written:
                        self._write(output, due)
                finished.append(tuple(replace(e, timing={**laps, **e.timing, "total": total}) for e in estimates))
                writing = time.perf_counter() - stepped
                if due:
                    written = stepped + writing
                    yield from finished
                    finished.clear()
        except TkError:  # frames before the broken one count; the state may be that of a part of its step
            if output and self.written:
                output.writer.flush()
            yield from finished
            raise
        if output and self.written:
            output.writer.flush(self._state(output))
        yield from finished

    def _write(self, output: Output, flush: bool) -> None:
        """Pass on the frames that are not in the file yet, and the bodies of people whose trackers have just started;
        with ``flush``, and at first, the state, too, which takes longer than the rows of a frame."""
        models = output.writer.models
        for person in self.people.written:
            if person.number >= len(models) or not models[person.number]:
                output.writer.write_model(person.tracker.model(), person=person.number)
        *earlier, last = self._held
        for before in earlier:
            output.writer.append(*before, flush=False)
        state = self._state(output) if flush or not self.written else None
        output.writer.append(*last, state, flush=flush)
        self.written += len(self._held)
        self._held.clear()

    def _step(self, observation: Frame) -> tuple[Estimate, ...] | None:
        """Step all trackers; return the estimates of the people in the result, None before the first frame to be
        written."""
        with one_thread():
            answers = self.people.step(observation)
        if observation.index < self.plan.begin:
            return None
        found = []
        for number, answer in answers.items():
            estimate = answer.estimate
            if self.masks is not None:
                self.masks[number].put(observation.index, *self._kept(answer))
            whole = replace(estimate.light, frame=observation.index, time=observation.time, person=number)
            whole = replace(whole, mask_source=observation.sources)
            if whole.landmarks is not None:
                seen = self.plan.task.setup.rig.recorded_pixels(whole.landmarks)
                whole = replace(whole, landmarks=seen)
            found.append(whole)
        return tuple(found)

    def _kept(self, answer: Answer) -> tuple[NDArray[np.uint8], NDArray[np.uint16] | None]:
        """Return the cleaned masks (C, H, W) of a frame, also of cameras that disagree: they may be refined; and what
        the masks show, (C, h, w), in the cameras that were used."""
        tracker, estimate = two_pass(self.plan.tracker), answer.estimate
        assert tracker is not None
        taken = tracker.cleaned(answer.used.masks) if estimate.masks is None else estimate.masks
        out = shows_person(answer.share.masks) & ~shows_person(answer.used.masks)
        if out.any():
            taken = taken.copy()
            taken[out] = tracker.cleaned(answer.share.masks[out])
        return taken, estimate.colors

    def _state(self, output: Output) -> Mapping[str, Value]:
        origin = {_ORIGIN + name: value for name, value in output.origin.items()}
        return {**encode(RunState(self.people.state(), output.said)), **origin}


def _fill(taken: list[Observed], observations: Iterator[Observed], count: int) -> Iterator[Observed]:
    """Take observations until there are ``count``, and return the others. If one after the first cannot be read, the
    others raise the error."""
    try:
        taken.extend(islice(observations, count - len(taken)))
    except TkError as error:
        if not taken:
            raise
        return _raising(error)
    return observations


def _raising(error: TkError) -> Iterator[Observed]:
    raise error
    yield


def _run_row(estimates: Sequence[Estimate], laps: Mapping[str, float]) -> Row:
    """Return the row of the run in the result file; ``laps``: seconds by stage without those of the trackers."""
    first, seconds = estimates[0], dict(laps)
    for estimate in estimates:
        for stage, lap in estimate.timing.items():
            seconds[stage] = seconds.get(stage, 0.0) + lap
    return {"frames": first.frame, "time": first.time, **{f"timing/{stage}": lap for stage, lap in seconds.items()}}


def _row(estimate: Estimate, store_hull: bool) -> Row:
    """Return a person's row of the result file."""
    row: dict[str, ArrayLike | None] = {
        "pose": estimate.pose,
        "joints/position": estimate.joints,
        "joints/sigma": estimate.sigma,
        "residual": estimate.residual,
        "mask_source": estimate.mask_source,
        "landmarks": None if estimate.landmarks is None else estimate.landmarks[..., :3],
        "landmark_depth": None if estimate.landmarks is None else estimate.landmarks[..., 3],
        "evidence/reason": estimate.reason,
        "evidence/found": estimate.found,
        "evidence/origin": estimate.origin,
        "evidence/sigma": estimate.deviation,
        "evidence/modes": estimate.modes,
        "evidence/camera": estimate.cameras if estimate.residual is not None else None,
        "evidence/shift": estimate.shift if estimate.residual is not None else None,
        "status": int(Status[estimate.status.upper()]),
        "objective": estimate.objective,
        "iterations": estimate.iterations,
    }
    if store_hull and estimate.surface is not None:
        points = HullPoints.of(estimate.surface)
        row |= {"hull/positions": points.positions, "hull/colors": points.colors}
    return {path: value for path, value in row.items() if value is not None}
