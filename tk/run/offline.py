"""What needs all frames of a result: camera refinement and the second pass, angles, and a smoothed copy."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.mask_store import MaskStores
from tk.io.results.data import Result, UsedCameras
from tk.io.results.revision import Revision
from tk.io.results.status import Status
from tk.model.body.cone_body import ConeBody
from tk.model.body.plausibility import height_contradiction
from tk.model.cameras.bundle import TrackedPerson
from tk.model.cameras.camera import Rig
from tk.model.cues import landmarks
from tk.model.cues.cue import Measured, in_frames
from tk.model.motion.derived import derive
from tk.model.motion.smoothing import smooth
from tk.people.identity import COLUMNS, doubtful, report, unmixed, unmixed_masks
from tk.people.people import People
from tk.run.delays import COMPARED, retimed, retimed_measured
from tk.run.draft import Draft, held, without_absent
from tk.run.prefetch import open_observations
from tk.run.refinement import compare_cameras, refine_if_inconsistent
from tk.run.second_run import Run, explains_better, shown_again, step_without, track_again, track_back
from tk.run.task import Task
from tk.trackers.headings import both_headings, trajectory_cost, turned_pose
from tk.trackers.hypotheses import DROPPED
from tk.trackers.judgement import FrameEvidence, FrameJudge, depth_known, judge_frames
from tk.trackers.protocol import Estimate, two_pass
from tk.trackers.reason import Reason, known_sigma, report_frames, status_of
from tk.trackers.region import RegionTracker
from tk.trackers.residual import mean_error

_LOG = logging.getLogger(__name__)
Float = NDArray[np.float64]
Note = Callable[[str], None]

#: entry in `/model` of a result after the second pass
REFINED = "refined"


@dataclass(frozen=True)
class Finished:
    """What all frames of a run together give.

    Attributes:
        revisions: of each person's result, by number.
        cameras: the cameras of the recorded images, refined if they were; None if the tracker has no segments.
        status: of each person's frames, (F,).
    """

    revisions: Mapping[int, Revision]
    cameras: UsedCameras | None
    status: list[NDArray[np.uint8]]


def finish(
    found: Sequence[Result],
    task: Task,
    people: People,
    masks: MaskStores | None,
    note: Note,
    within: Callable[[float], None],
    film_again: Callable[[Sequence[float] | None], None] = lambda _: None,
) -> Finished:
    """Return what needs all frames, see :class:`_Finisher`, after people who were mixed up are exchanged.

    Args:
        found: each person's result of the first pass.
        task, people: of the run.
        masks: for the second pass; None: no second pass.
        note: receives lines for the user.
        within: receives the share of a long stage that is done.
        film_again: see :meth:`~tk.run.prefetch.Observations.film_again`.
    """
    written, contacts = people.written, people.contacts
    kept = [held(result) for result in found]
    results = unmixed(kept, contacts)
    for line in report(contacts):
        note(line)
    drafts = []
    for person in written:
        result = results[person.number]
        draft = Draft(person, result, person.tracker, ~result.has_pose, doubtful(result, contacts))
        if result is not kept[person.number]:
            columns = {dataset: getattr(result, name) for dataset, name in COLUMNS.items()}
            draft.columns = {dataset: values for dataset, values in columns.items() if values is not None}
        if masks is not None:
            draft.masks = unmixed_masks(person.number, contacts, masks, kept)
        drafts.append(draft)
    revisions, finisher = (
        {},
        _Finisher(task, people.alone, note, within, task.setup.rig, film_again, several=len(written) > 1),
    )
    if people.has_segments:
        finisher.second_pass([draft for draft in drafts if finisher.has_masks(draft)])
    for draft in drafts:
        number, reasons = draft.person.number, draft.current("evidence/reason")
        if people.has_segments:
            revisions[number] = without_absent(finisher.revision(draft), draft.result.status == Status.ABSENT)
            reasons = draft.current("evidence/reason")
        if reasons is not None:
            report_frames(draft.result.frames, reasons, finisher.about(draft))
    status = [
        np.asarray(revisions[person.person].columns["status"]) if person.person in revisions else person.status
        for person in found
    ]
    return Finished(revisions, finisher.cameras.recorded() if revisions else None, status)


@dataclass
class _Finisher:
    """Finishes people: cameras are compared and refined about all of them, then each has a second pass."""

    task: Task
    alone: bool  # whether nobody but the person in the result has been tracked
    note: Note
    within: Callable[[float], None]
    rig: Rig  # as used
    film_again: Callable[[Sequence[float] | None], None] = lambda _: None
    several: bool = False  # whether the result has several people
    late: NDArray[np.int64] = field(init=False)  # (C,) whole frames by which each video is late, as found
    offset_frames: Float = field(init=False)  # (C,) the same, not rounded

    def __post_init__(self) -> None:
        self.late, self.offset_frames = np.zeros(len(self.rig), np.int64), np.zeros(len(self.rig))

    @property
    def cameras(self) -> UsedCameras:
        """The cameras as used, and their delays."""
        offsets = np.array(self.task.source.time_offset_s) + self.offset_frames / self.task.setup.fps
        return UsedCameras(self.rig, offsets)

    def about(self, draft: Draft) -> Note:
        """Return what receives lines about a draft's person, who is named if the result has several."""
        return named(draft.person.number, self.note) if self.several else self.note

    def revision(self, draft: Draft) -> Revision:
        """Return what all frames of a person give: status and sigma; segments, feet and angles; the smoothed copy."""
        tracker, setup = draft.tracker, self.task.setup
        self._judge(draft)
        _LOG.info("angles, feet, and the smoothed copy")
        body, poses = tracker.body.standing(setup.up), draft.current("pose")
        # poses of the first pass stay as they are
        kept = () if "pose" in draft.columns else ("pose", "joints/position")
        seen = draft.result.has_landmarks
        columns = draft.columns | {name: v for name, v in _columns(body, poses, seen).items() if name not in kept}
        filtered = smooth(body.skeleton, poses, ~draft.lost, setup.fps)
        smoothed = {**_columns(body, filtered.poses, seen), "bridged": filtered.bridged}
        return Revision(columns, smoothed, {**tracker.model(), REFINED: 1} if draft.refined else None)

    def has_masks(self, draft: Draft) -> bool:
        """Return whether a person's masks of all frames are known. Those that an earlier run has used are made again if
        nobody else is tracked."""
        tracker, masks, result = two_pass(draft.tracker), draft.masks, draft.result
        if tracker is None or masks is None:
            return False
        absent = result.status == Status.ABSENT
        for frame in result.frames[absent].tolist():
            if frame not in masks:
                masks.put(frame, np.zeros((len(self.rig), *self.rig.frame_shape), np.uint8))
        missing = [frame for frame in result.frames[~absent].tolist() if frame not in masks]
        if missing and not self.alone:
            self.about(draft)("the second pass is omitted, because an earlier run kept no masks of each person")
            return False
        if missing:
            with open_observations(self.task, lambda _: None, tracker.image_step) as observations:
                for observation, _ in observations.frames(min(missing), max(missing) + 1):
                    masks.put(observation.index, *tracker.kept(observation))
        return True

    def second_pass(self, drafts: Sequence[Draft]) -> None:
        """Optimise the poses of drafts by what all frames show.

        A body is fitted to frames of the whole recording: only bent elbows and knees show where these are.
        """
        if not drafts:
            return
        for draft in drafts:
            if draft.person.subject.init is None:  # a given pose shows where the front is
                draft.tracker = self._with_true_heading(draft)
        self._refine_cameras(drafts)
        self.film_again(self.cameras.time_offset_s.tolist() if self.late.any() else None)
        for draft in drafts:
            self._find_lost(draft)
            (tracker, masks), subject = draft.tracker_and_masks, draft.person.subject
            _LOG.info("second pass")
            poses, residual, precise = tracker.second_pass(
                masks.sequence(draft.result.frames),
                draft.current("pose"),
                draft.lost,
                draft.current("residual"),
                subject.height_m,
                self._measured(draft, self.late),
                draft.current("evidence/modes"),
                masks.color_sequence(draft.result.frames, self._has_colors(draft)),
                keep_body=subject.body is not None,
                report=self.within,
            )
            # a joint that the first pass knew nothing about stays unknown
            sigma = np.where(draft.lost[:, None] | np.isnan(draft.current("evidence/sigma")), np.nan, precise)
            error = np.where(draft.lost, draft.current("objective"), mean_error(residual))
            draft.columns |= {"pose": poses, "residual": residual, "evidence/sigma": sigma, "objective": error}
            draft.refined = True
            if subject.body is None and subject.height_m is not None:
                reason = height_contradiction(tracker.body.dimensions.barefoot, subject.height_m)
                if reason:  # the opening has shown less of it
                    self.about(draft)(f"{reason}: all frames are suspect")
                    draft.unclear = np.ones_like(draft.lost)

    def _with_true_heading(self, draft: Draft) -> RegionTracker:
        """If the opposite heading is not improbable, by all frames, track the person again with it and its body; keep
        the more probable one in the draft. Return the tracker of the heading that is kept.

        Turned poses are worse than tracked ones. So they may refute the opposite heading, not confirm it.
        """
        (tracker, masks), height_m = draft.tracker_and_masks, draft.person.subject.height_m
        rows = np.flatnonzero(~draft.lost)
        if not len(rows) or self.task.source.frame_count is None:
            return tracker
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, COMPARED).round().astype(int))]
        poses, unused = draft.current("pose"), np.isnan(draft.current("residual")[..., 0])
        measured = self._measured(draft, self.late)

        def seen(rows: NDArray[np.int64]) -> tuple[list[NDArray[np.uint8]], Measured]:
            """Return the masks of frames, and what was measured in them, by the cameras that were used."""
            shown = [np.where(unused[row][:, None, None], 0, masks.get(int(draft.result.frames[row]))) for row in rows]
            return shown, in_frames(measured, rows, ~unused[rows])

        def cost(tracker: RegionTracker, poses: Float, one: Draft) -> float:
            """Return the cost of poses (F, D) after a second pass, of the frames that neither draft has lost."""
            residual, both = one.current("residual"), np.flatnonzero(~(draft.lost | one.lost))
            again = tracker.second_pass(
                masks.sequence(draft.result.frames),
                poses,
                one.lost,
                residual,
                height_m,
                measured,
                keep_body=True,
                report=self.within,
            )
            shown, known = seen(both)
            return trajectory_cost(tracker, shown, again[0][both], known)

        shown, known = seen(rows)
        headings = both_headings(tracker, shown, poses[rows], height_m, known)
        if not headings:
            return tracker
        present, opposite = headings
        _LOG.info("comparing both headings: which way the person faces is unclear")
        turned = np.array([turned_pose(tracker, pose) for pose in poses])
        least = cost(present, poses, draft)
        if cost(opposite, turned, draft) > least + DROPPED:
            return tracker
        _LOG.info("tracking with the opposite heading")
        opposite.start_at(turned[np.flatnonzero(draft.result.status != Status.ABSENT)[0]])
        again, yaw = self._tracked_by(opposite, draft, unused), tracker.body.skeleton.index("torso_yaw")
        found, both = again.current("pose"), ~(draft.lost | again.lost)
        if cost(opposite, found, again) >= least or np.median(np.cos(found[both, yaw] - poses[both, yaw])) > 0:
            return tracker  # or it may have found the other heading by itself
        draft.lost, draft.columns = again.lost, again.columns
        self.about(draft)("the person faces the other way than the first frames seemed to show: tracked again")
        return opposite

    def _find_lost(self, draft: Draft) -> None:
        """Find the person in lost frames from the frames after them."""
        frames = draft.result.frames
        present = np.flatnonzero(draft.result.status != Status.ABSENT)
        run = Run.of(draft.tracker_and_masks, frames, draft, present)
        found = track_back(run, self._landmarks(draft, self.late))
        if found:
            rows = np.flatnonzero(np.isin(frames, list(found)))
            draft.take(rows, [found[int(frame)] for frame in frames[rows]])

    def _tracked_by(self, tracker: RegionTracker, draft: Draft, unused: NDArray[np.bool_]) -> Draft:
        """Track the frames of a draft by a tracker that has been started, without the cameras (F, C) that are unused;
        return the draft of it."""
        masks, present = draft.tracker_and_masks[1], np.flatnonzero(draft.result.status != Status.ABSENT)
        numbers, source, cameras = draft.result.frames[present], self.task.source, unused.shape[1]
        judge = FrameJudge(tracker, cameras, self.task.setup.fps, self.task.settings.region.false_alarm)
        found: list[Estimate] = []
        with source.frames(int(numbers[0]), int(numbers[-1]) + 1) as images:
            frames = shown_again(images, numbers, masks, self._landmarks(draft, self.late))
            for frame, row in zip(frames, present.tolist(), strict=True):
                estimate = step_without(tracker, frame, unused[row], draft.current("evidence/camera")[row])
                found.append(judge.judge(frame.index, estimate).light)
                self.within(len(found) / len(present))
        again = draft.copy()
        again.take(present, found)
        return again

    def _refine_cameras(self, drafts: Sequence[Draft]) -> None:
        """Refine the cameras, and synchronise the masks, if the cameras disagree about the people and
        ``settings.refine`` is True.

        A camera that has been moved during the recording has no one place and is not compared.
        """
        _LOG.info("second pass: comparing the cameras")
        tracker = drafts[0].tracker_and_masks[0]
        world, people = tracker.world, [self._seen(draft) for draft in drafts]
        agreement = compare_cameras(people, tracker.views)
        if apart := "" if agreement is None else agreement.size_contradiction:
            self.note(f"{apart}: all frames are suspect")
            for draft in drafts:
                draft.unclear = np.ones_like(draft.lost)
        if agreement is None or apart or not self.task.settings.refine:
            return
        refined = refine_if_inconsistent(people, world.rig, agreement)
        if refined is None:
            return
        rig, late = world.rig_out(refined.rig), np.round(refined.offset_frames).astype(np.int64)
        found = [self._with_cameras(draft, rig, late) for draft in drafts]
        if any(done is None for done in found):
            _LOG.info("the first pass explains the images better than one with the refined cameras")
            return
        self.rig, self.late, self.offset_frames = rig, late, refined.offset_frames
        self.note(refined.message)
        for draft, done in zip(drafts, found, strict=True):
            assert done is not None
            changed, lines = done
            draft.tracker, draft.masks = changed.tracker, changed.masks
            draft.lost, draft.columns = changed.lost, changed.columns
            for line in lines:
                self.about(draft)(line)

    def _seen(self, draft: Draft) -> TrackedPerson:
        """Return what the cameras are compared by."""
        tracker, masks = draft.tracker_and_masks
        poses = tracker.world.poses_in(draft.current("pose"))
        compared = masks.without(draft.person.monitor.moved)
        return TrackedPerson(tracker.body, lru_cache(16)(compared.get), draft.result.frames, poses, ~draft.lost)

    def _measured(self, draft: Draft, late: NDArray[np.int64]) -> Measured:
        """Return what the first pass has measured in the frames of a draft, in pixels of the cameras in use,
        synchronised with videos that are late by whole frames (C,)."""
        found, depth = draft.current("landmarks"), draft.current("landmark_depth")
        if found is None or depth is None:
            return {}
        found = self.task.setup.rig.reduced_pixels(np.concatenate([found, depth[..., None]], axis=-1))
        return {landmarks.NAME: retimed_measured(found, draft.result.frames, late)}

    def _has_colors(self, draft: Draft) -> NDArray[np.bool_]:
        """Return (F,) the frames in which no camera is used whose colours the first pass left out."""
        then, now = draft.result.residual, draft.current("residual")
        assert then is not None
        seen = retimed_measured(then[..., :1, None], draft.result.frames, self.late)[..., 0, 0]
        return np.asarray(~(np.isfinite(now[..., 0]) & np.isnan(seen)).any(axis=1))

    def _landmarks(self, draft: Draft, late: NDArray[np.int64]) -> dict[int, Float]:
        """Return the landmarks (C, L, 4) of :meth:`_measured`, by frame, of frames that have any."""
        seen = self._measured(draft, late).get(landmarks.NAME, ())
        return {n: own for n, own in zip(draft.result.frames.tolist(), seen, strict=False) if np.isfinite(own).any()}

    def _with_cameras(self, draft: Draft, rig: Rig, late: NDArray[np.int64]) -> tuple[Draft, list[str]] | None:
        """Return a draft with other cameras, and without delays, (C,) frames, and lines for the user; None if the first
        pass explains the images better.

        If there are delays, all poses are optimised with the synchronised masks. The person is tracked again if that
        does not explain the images better, or if a camera was left out of many frames. With several people, the pixels
        of each are known with the delays only. A source that cannot be read again is not tracked again.
        """
        task, result, (tracker, masks) = self.task, draft.result, draft.tracker_and_masks
        now = tracker.with_cameras(rig), retimed(masks, result.frames, late)
        again = replace(draft.copy(), tracker=now[0], masks=now[1])
        present = np.flatnonzero(result.status != Status.ABSENT)
        first = Run.of(draft.tracker_and_masks, result.frames, draft, present)
        out, measured = first.left_out(), self._measured(draft, late)
        source = task.source.shifted((np.array(task.source.time_offset_s) + late / task.setup.fps).tolist())
        if source is None or source.frame_count is None or not (self.alone if late.any() else out.any()):
            return again, []
        if not out.any():
            pose, residual = draft.current("pose"), draft.current("residual")
            shown = now[1].sequence(result.frames)
            poses, residuals = now[0].following(shown, pose, draft.lost, residual, measured)
            moved = replace(again.copy(), columns=again.columns | {"pose": poses, "residual": residuals})
            if explains_better(Run.of(now, result.frames, moved, present), first):
                return moved, []
        _LOG.info("tracking again with the refined cameras")
        marked = self._landmarks(draft, late)
        done = track_again(first, now, source, task.setup, draft.person.subject, marked, self.within)
        if done is None:
            return None
        found, monitor = done
        rows = np.flatnonzero(np.isin(result.frames, list(found)))
        again.take(rows, [found[int(frame)] for frame in result.frames[rows]])
        if not explains_better(Run.of(now, result.frames, again, rows), first):
            return None
        lines = ["tracking again: the images of the first pass were not synchronised"] if late.any() else []
        if out.any():
            names = ", ".join(np.array(task.setup.rig.names)[out])
            lines.append(f"tracking again: with the refined cameras, {names} may be right")
            lines += [f"tracked again: {line}" for line in monitor.report() or ["no camera is left out"]]
        return again, lines

    def _judge(self, draft: Draft) -> None:
        """Give the frames of a draft the reasons, the status and the sigma that all frames together imply."""
        posed, residual, origin = ~draft.lost, draft.current("residual"), draft.current("evidence/origin")
        reasons = draft.current("evidence/reason")
        if draft.refined and residual is not None:  # without one, no frame depends on later ones
            found, begins = draft.current("evidence/found"), origin == Status.RECOVERED
            depth = depth_known(self.rig, draft.current("joints/position"), residual)
            evidence = FrameEvidence(found, posed, begins, residual, depth)
            reasons = judge_frames(evidence, self.task.settings.region.false_alarm, whole=True)
        reasons = np.where(posed & draft.unclear, np.uint8(Reason.UNCLEAR), reasons)
        draft.columns |= {"evidence/reason": reasons, "status": status_of(origin, reasons)}
        if (sigma := draft.current("evidence/sigma")) is not None:
            draft.columns["joints/sigma"] = known_sigma(sigma, reasons)


def named(person: int, note: Note) -> Note:
    """Return what receives lines about a person, by number, who is named in them."""
    return lambda line: note(f"person {person}: {line}")


def _columns(body: ConeBody, poses: NDArray[np.float64], landmarks: bool) -> dict[str, NDArray[np.floating]]:
    """Return the datasets of poses (F, D) of a body, and of what is derived from them; ``landmarks``: whether they were
    used."""
    derived = derive(body.skeleton, body.dimensions, poses, landmarks)
    columns: dict[str, NDArray[np.floating]] = {"pose": poses, "joints/position": derived.joints}
    columns["segments/rotation"] = derived.rotations
    columns["feet/position"] = derived.feet
    columns |= {f"angles/{joint}": values for joint, values in derived.angles.items()}
    return columns
