"""What needs all frames of a result: camera refinement and the second pass, angles, and a smoothed copy."""

from __future__ import annotations

import logging
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.mask_store import MaskStore, MaskStores
from tk.io.results.data import Result, UsedCameras, Value
from tk.io.results.reader import read_result
from tk.io.results.revision import revise_result
from tk.io.results.status import Status
from tk.kernels.projection import pack_cameras
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.bundle import TrackedPoses
from tk.model.masks.image_health import described
from tk.model.motion.derived import derive
from tk.model.motion.smoothing import smooth
from tk.run.identity import COLUMNS, EXCHANGED, UNCLEAR, Contact, doubtful, exchange_masks, exchanged, report
from tk.run.people import Member
from tk.run.plan import Plan
from tk.run.prefetch import open_observations
from tk.run.refinement import compare_cameras, refine_if_inconsistent, retimed
from tk.trackers.protocol import Estimate, Observation, TwoPassTracker, two_pass
from tk.trackers.region import UNKNOWN_AFTER
from tk.trackers.residual import contradicted

_LOG = logging.getLogger(__name__)
Float = NDArray[np.float64]
Note = Callable[[str], None]

#: entry in `/model` of a result after the second pass
REFINED = "refined"
# Differences of cameras that a result file rounds, in the units of a calibration; a refinement changes more.
_ROUNDED = 1e-7
# A joint keeps its sigma of the first pass where that exceeds the sigma of the second pass by this factor. With 1, 5 %
# more of walk's joints are within one sigma, where 12 % too many are; 4 changes such shares by less than 1 %. Without
# the rule, joints more than 15 cm off with a sigma below 5 cm rise from 0 to 0.1 % (dance, three cameras) and from 1.0
# to 1.1 % (walk, two).
_LESS_SURE = 2.0


def finish(
    output: Path,
    plan: Plan,
    people: Sequence[Member],
    contacts: Sequence[Contact],
    masks: MaskStores | None,
    note: Note,
    within: Callable[[float], None],
    finished: Container[int] = (),
) -> None:
    """Write what needs all frames, see :func:`_finish`, for the people who are not ``finished``, after people who were
    mixed up are exchanged. Person 0 decides whether the cameras are refined. ``within`` receives the share of a long
    stage that is done."""
    cameras = UsedCameras(plan.setup.rig, np.array(plan.source.time_offset_s))
    if finished:  # the first pass of a finished person is gone
        contacts = [replace(c, outcome=UNCLEAR) if c.outcome == EXCHANGED else c for c in contacts]
    found = read_result(output).people
    results = exchanged(found, contacts)
    for contact in contacts:
        if contact.outcome == EXCHANGED and masks is not None:
            exchange_masks(contact, [masks[number] for number in contact.people])
    for line in report(contacts):
        note(line)
    for member in people:
        if member.number in finished:
            stored = read_result(output).cameras or cameras
            used = stored.rig.recorded().reduced(plan.setup.rig.reductions)
            if not np.allclose(pack_cameras(used), pack_cameras(plan.setup.rig), rtol=_ROUNDED, atol=_ROUNDED):
                cameras = replace(stored, rig=used)
            continue
        store, result = None if masks is None else masks[member.number], results[member.number]
        changed = [] if result is found[member.number] else list(COLUMNS)
        alone = len(people) == 1
        cameras = _finish(output, plan, member, result, changed, contacts, store, note, cameras, alone, within)


def _finish(
    output: Path,
    plan: Plan,
    member: Member,
    result: Result,
    changed: Sequence[str],
    contacts: Sequence[Contact],
    masks: MaskStore | None,
    note: Note,
    cameras: UsedCameras,
    alone: bool,
    within: Callable[[float], None],
) -> UsedCameras:
    """Write what needs all frames of a person: the second pass; segments, feet and angles; the smoothed copy; cameras.

    The second pass uses ``masks``; None: no second pass. Its body is fitted to frames of the whole recording unless
    that began with the initialisation pose, and its cameras are refined if they disagree and ``settings.refine`` is
    True. The result is replaced in one step; if this function is interrupted, the result of the first pass stays.
    ``changed`` are columns of the result that differ from the file. Returns the cameras that were used; persons after
    the first take those that are given.
    """
    tracker, subject, fps = member.tracker, member.subject, plan.setup.fps
    if not tracker.has_segments:
        return cameras
    poses = result.pose.copy()
    lost = ~result.has_pose
    unclear = ~lost & doubtful(result, contacts)
    columns: dict[str, NDArray[Any]] = {name: getattr(result, COLUMNS[name]) for name in changed}
    model: Mapping[str, Value] | None = None
    again = two_pass(tracker)
    missing = [] if masks is None else [int(f) for f in result.frames if int(f) not in masks]
    if again is not None and missing and not alone:
        note(f"person {member.number}: the second pass is omitted, because an earlier run kept no masks of each person")
    elif again is not None and masks is not None:
        assert result.residual is not None
        if missing:  # frames that an earlier run has tracked
            with open_observations(plan.setup, plan.source, plan.settings, lambda _: None) as observations:
                for observation, _ in observations.frames(min(missing), max(missing) + 1):
                    masks.put(observation.index, again.cleaned(again.without_foreign(observation).masks))
        _LOG.info("second pass: comparing the cameras")
        tracked = TrackedPoses(result.frames, poses.copy(), ~lost)
        agreement = compare_cameras(again, masks, tracked)
        if apart := "" if agreement is None else agreement.contradiction:
            note(f"{apart}: all frames are suspect")
            unclear = ~lost
        if member.number:
            late = np.round((cameras.time_offset_s - plan.source.time_offset_s) * fps).astype(np.int64)
            again, masks = again.with_cameras(cameras.rig), retimed(masks, result.frames, late)
        elif agreement is not None and plan.settings.refine and not apart:
            refined = refine_if_inconsistent(again, agreement, masks, tracked, note)
            if refined is not None:
                again, masks, offsets = refined
                cameras = UsedCameras(again.rig, cameras.time_offset_s + offsets / fps)
                if np.round(offsets).any() and alone:
                    note("tracking again: the images of the first pass were not synchronised")
                    present = result.status != Status.ABSENT
                    found = _track_again(plan, again, cameras, masks, result.frames[present], poses[present], within)
                    rows = np.flatnonzero(present & np.isin(result.frames, list(found)))
                    estimates = [found[int(frame)] for frame in result.frames[rows]]
                    poses[rows] = [e.pose for e in estimates]
                    lost[rows] = [e.status == "lost" for e in estimates]
                    columns |= _replaced(result, rows, estimates)
        _LOG.info("second pass")
        assert result.sigma is not None
        before = columns.get("joints/sigma", result.sigma)
        poses, columns["residual"], precise = again.second_pass(
            masks.sequence(result.frames),
            poses,
            lost,
            columns.get("residual", result.residual),
            subject.height_m,
            # in the initialisation pose every limb is visible; other first poses may hide limbs, and so may others
            keep_body=subject.body is not None or (alone and subject.init is None and subject.in_init_pose),
            report=within,
        )
        # a much larger sigma of the first pass, or NaN: it tracked several poses, or did not find a limb
        columns["joints/sigma"] = np.where(before <= _LESS_SURE * precise, precise, before)
        tracker = again
        model = {**tracker.model(), REFINED: 1}
    sigma, residual = columns.get("joints/sigma", result.sigma), columns.get("residual", result.residual)
    if sigma is not None and residual is not None:
        suspect = ~lost
        suspect[suspect] = contradicted(residual[suspect], plan.settings.region.false_alarm)
        unclear &= ~lost  # tracking again may have lost frames
        unknown = ~lost & np.isnan(sigma).all(axis=1)
        if model is not None:  # without a second pass, no frame depends on later ones
            unknown = ~lost & high_residual(unknown)
        status = columns.get("status", result.status)
        status = np.where(status == Status.SUSPECT, np.uint8(Status.TRACKED), status)
        columns["status"] = np.where(suspect | unclear, np.uint8(Status.SUSPECT), status)
        columns["joints/sigma"] = np.where((suspect | unclear | unknown)[:, None], np.nan, sigma)
        report_unknown(result.frames[unknown & ~suspect & ~unclear], note)
        report_suspect(result.frames[suspect], note)
    _LOG.info("angles, feet, and the smoothed copy")
    # poses of the first pass stay as they are
    kept = ("pose", "joints/position") if model is None and not changed else ()
    body = tracker.body.standing(plan.setup.up)
    columns |= {name: values for name, values in _columns(body, poses).items() if name not in kept}
    filtered = smooth(body.skeleton, poses, ~lost, fps)
    smoothed = {**_columns(body, filtered.poses), "bridged": filtered.bridged}
    revise_result(output, columns, smoothed=smoothed, model=model, cameras=cameras.recorded(), person=member.number)
    return cameras


def high_residual(unknown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (F,) the frames of stretches with a high residual. The first pass makes sigma unknown, (F,), only after
    :data:`~tk.trackers.region.UNKNOWN_AFTER` of them."""
    return np.array([unknown[i : i + UNKNOWN_AFTER].any() for i in range(len(unknown))], np.bool_)


def report_unknown(frames: Sequence[int] | NDArray[np.int64], note: Callable[[str], None]) -> None:
    """Report frames (F,) that are not lost, but without a sigma of any joint."""
    if len(frames):
        which = described(int(frames[0]), int(frames[-1]), len(frames))
        note(f"the residual is high, and no better pose was found: σ is unknown, {which}")


def report_suspect(frames: Sequence[int] | NDArray[np.int64], note: Callable[[str], None]) -> None:
    """Report frames (F,) whose residual contradicts the pose; their sigma is unknown."""
    if len(frames):
        which = described(int(frames[0]), int(frames[-1]), len(frames))
        note(
            f"body and masks differ more than in correct recordings: suspect, {which}; likely causes: the calibration "
            "of another recording, moved cameras, or videos of different recordings (see tk inspect)"
        )


def _track_again(
    plan: Plan,
    tracker: TwoPassTracker,
    cameras: UsedCameras,
    masks: MaskStore,
    frames: NDArray[np.int64],
    poses: Float,
    within: Callable[[float], None],
) -> dict[int, Estimate]:
    """Return estimates, by frame, of the frames (F,) of which every synchronised camera has an image; none if the
    source cannot be read again.

    Tracking begins at the first pass's pose. ``masks``: the synchronised masks, which are not made again.
    """
    source = plan.source.shifted(cameras.time_offset_s.tolist())
    if source is None or source.frame_count is None:
        return {}
    begin = max(source.first_frame, int(frames[0]))
    stop = min(source.frame_count, int(frames[-1]) + 1)
    if begin >= stop:
        return {}
    tracker.start_at(poses[np.searchsorted(frames, begin)])
    found = {}
    with source.frames(begin, stop) as images:
        for frame in images:
            if frame.index in masks:
                observation = Observation(frame.index, frame.images, masks.get(frame.index), time=frame.time)
                found[frame.index] = replace(tracker.step(observation), masks=None, drawn=None)  # these are large
            within((frame.index + 1 - begin) / (stop - begin))
    return found


def _replaced(result: Result, rows: NDArray[np.int64], estimates: Sequence[Estimate]) -> dict[str, NDArray[Any]]:
    """Return the columns of a result with these rows replaced by other estimates."""
    assert result.sigma is not None and result.residual is not None
    columns = {
        "joints/sigma": result.sigma.copy(),
        "residual": result.residual.copy(),
        "objective": result.objective.copy(),
        "status": result.status.copy(),
    }
    for row, e in zip(rows, estimates, strict=True):
        columns["joints/sigma"][row], columns["residual"][row] = e.sigma, e.residual
        columns["objective"][row] = e.objective
        if result.status[row] != Status.INITIALISED:
            columns["status"][row] = Status[e.status.upper()]
    return columns


def _columns(body: ConeBody, poses: NDArray[np.float64]) -> dict[str, NDArray[np.floating]]:
    """Return the datasets of poses (F, D) of a body and of what is derived from them."""
    derived = derive(body.skeleton, body.dimensions, poses)
    columns: dict[str, NDArray[np.floating]] = {"pose": poses, "joints/position": derived.joints}
    columns["segments/rotation"] = derived.rotations
    columns["feet/position"] = derived.feet
    columns |= {f"angles/{joint}": values for joint, values in derived.angles.items()}
    return columns
