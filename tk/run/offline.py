"""What needs all frames of a result: the second pass, cameras that disagree refined for it; angles; a smoothed copy."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.mask_store import MaskStore
from tk.io.results.writer import Result, Status, UsedCameras, Value, read_result, revise_result
from tk.model.body.cone_body import ConeBody
from tk.model.body.skeleton import join_pose, split_pose
from tk.model.masks.image_health import described
from tk.model.motion.derived import derive
from tk.model.motion.smoothing import smooth
from tk.run.plan import Plan
from tk.run.prefetch import open_source
from tk.run.refinement import refine_if_inconsistent
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.protocol import Estimate
from tk.trackers.region import RegionTracker

_LOG = logging.getLogger(__name__)
Float = NDArray[np.float64]

#: in `/model` of a result that a second pass has gone over
REFINED = "refined"
# A joint whose σ is larger than the second pass's by this factor keeps that of the first.
_LESS_SURE = 2.0


def finish(output: Path, plan: Plan, masks: MaskStore | None, note: Callable[[str], None]) -> None:
    """What needs all frames: the second pass; segments, feet and angles; the smoothed copy; cameras.

    The second pass, which ``masks`` are for (None: there is none), settles every frame anew, with the body fitted to
    frames of the whole recording where that did not begin with the initialisation pose; by refined cameras where they
    disagree, unless ``config.refine`` is False. The result is replaced in one step; if this does not end, the first
    pass's stays.
    """
    tracker = plan.tracker
    if not isinstance(tracker, ContourTracker):
        return
    result = read_result(output)
    none = np.zeros((len(result.frames), 0))
    waist = none if result.waist is None else result.waist
    ankles = none if result.ankles is None else result.ankles
    skeleton = tracker.body.skeleton
    poses = np.array([join_pose(skeleton, *row) for row in zip(result.pose, waist, ankles, strict=True)])
    lost = result.status == Status.LOST
    columns: dict[str, NDArray[Any]] = {}
    model: Mapping[str, Value] | None = None
    cameras = UsedCameras(plan.capture.rig, np.array(plan.capture.time_offset_s))
    if isinstance(tracker, RegionTracker) and masks is not None:
        _LOG.info("second pass")
        # the initialisation pose shows all of the body; what else a recording may begin with does not
        shown = plan.init is None and plan.capture.init_pose != "any"
        assert result.residual is not None
        missing = [int(f) for f in result.frames if int(f) not in masks]
        if missing:  # what an earlier run has tracked
            with open_source(plan.capture, plan.config, lambda _: None) as source:
                for observation, _ in source.frames(min(missing), max(missing) + 1):
                    masks.put(observation.index, tracker.cleaned(tracker.without_foreign(observation).masks))
        if plan.config.refine:
            refined = refine_if_inconsistent(tracker, masks, result.frames, poses, ~lost, note)
            if refined is not None:
                tracker, masks, offsets = refined
                cameras = UsedCameras(tracker.rig, cameras.time_offset_s + offsets / plan.capture.fps)
                if np.round(offsets).any():
                    note("tracking again: the first pass had the pictures out of step")
                    again = _track_again(plan, tracker, cameras, result.frames, poses)
                    rows = np.flatnonzero(np.isin(result.frames, list(again)))
                    told_again = [again[int(frame)] for frame in result.frames[rows]]
                    poses[rows] = [join_pose(skeleton, e.pose, e.waist, e.ankles) for e in told_again]
                    lost[rows] = [e.status == "lost" for e in told_again]
                    columns |= _replaced(result, rows, told_again)
        poses, columns["residual"], sigma = tracker.second_pass(
            masks.sequence(result.frames),
            poses,
            lost,
            columns.get("residual", result.residual),
            plan.capture.subject_height_m,
            keep_body=plan.body is not None or shown,
        )
        # where the first pass was much less sure, or NaN, it followed several poses, or none was found for a limb
        assert result.sigma is not None
        before = columns.get("joints/sigma", result.sigma)
        columns["joints/sigma"] = np.where(before <= _LESS_SURE * sigma, sigma, before)
        model = {**tracker.model(), REFINED: 1}
    sigma = columns.get("joints/sigma", result.sigma)
    if sigma is not None:
        tell_unknown(result.frames[np.isnan(sigma).all(axis=1) & ~lost], note)
    _LOG.info("angles, feet, and the smoothed copy")
    # the first pass's poses stand as they are
    told = ("pose", "waist", "ankles", "joints/position") if model is None else ()
    body = tracker.body.standing(plan.capture.up)
    columns |= {name: values for name, values in _columns(body, poses).items() if name not in told}
    filtered = smooth(body.skeleton, poses, ~lost, plan.capture.fps)
    smoothed = {**_columns(body, filtered.poses), "bridged": filtered.bridged}
    revise_result(output, columns, smoothed=smoothed, model=model, cameras=cameras)


def tell_unknown(frames: Sequence[int] | NDArray[np.int64], note: Callable[[str], None]) -> None:
    """Tell of frames (F,) that are not lost and of which no joint has a σ."""
    if len(frames):
        which = described(int(frames[0]), int(frames[-1]), len(frames))
        note(f"the person is explained far worse than usual, and not found elsewhere: σ is unknown, {which}")


def _track_again(
    plan: Plan, tracker: RegionTracker, cameras: UsedCameras, frames: NDArray[np.int64], poses: Float
) -> dict[int, Estimate]:
    """The estimates of those of the frames (F,) of which all cameras have a picture once they are in step, by frame.

    It begins at the pose that the first pass found there.
    """
    capture = replace(plan.capture, rig=cameras.rig, time_offset_s=tuple(cameras.time_offset_s.tolist()))
    begin = max(capture.first_frame, int(frames[0]))
    ends = [clip.frame_count + late for clip, late in zip(capture.clips, capture.late_frames, strict=True)]
    stop = min(*ends, int(frames[-1]) + 1)
    if begin >= stop:
        return {}
    start = tracker.world.poses_in(poses[np.searchsorted(frames, begin)][None])
    once = {"poses": start, "previous": start, "costs": np.zeros(1), "ages": np.ones(1, int)}
    nothing = {"usual": np.inf, "lost_for": 0, "stranded": 0, "in_vain": False}
    tracker.rewind({**tracker.state(), **once, **nothing, "jumped": np.zeros(1, bool)})
    with open_source(capture, plan.config, lambda _: None) as source:
        return {observation.index: tracker.step(observation) for observation, _ in source.frames(begin, stop)}


def _replaced(result: Result, rows: NDArray[np.int64], estimates: Sequence[Estimate]) -> dict[str, NDArray[Any]]:
    """What a result's first pass told of these rows, told by other estimates."""
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
    """The datasets that tell poses (F, D) of a body and what follows from them."""
    skeleton = body.skeleton
    paper, waist, ankles = (np.array(part) for part in zip(*(split_pose(skeleton, p) for p in poses), strict=True))
    derived = derive(skeleton, body.dimensions, poses)
    columns = {"pose": paper, "joints/position": derived.joints, "segments/rotation": derived.rotations}
    columns["feet/position"] = derived.feet
    columns |= {f"angles/{joint}": values for joint, values in derived.angles.items()}
    if skeleton.is_waist.any():
        columns["waist"] = waist
    if skeleton.is_ankle.any():
        columns["ankles"] = ankles
    return columns
