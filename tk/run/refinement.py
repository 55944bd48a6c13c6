"""Refinement of cameras and time offsets by the poses of a tracked person."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.mask_store import MaskStore
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.agreement import LATE_FRAMES, CameraAgreement, camera_agreement
from tk.model.cameras.bundle import TrackedPoses, choose_frames
from tk.model.cameras.camera import Rig
from tk.model.cameras.refinement import SCALES, Refined, RefinementSettings, refine_cameras
from tk.model.masks.silhouettes import Views
from tk.run.delays import whole_delays
from tk.trackers.protocol import TwoPassTracker

Float = NDArray[np.float64]

# Frames of a refinement, and of a check of the cameras' agreement, at most and at least. On dance with turned cameras
# 16, 24 and 40 frames give the same joints within 0.02 cm. Fewer than eight show little motion; these
# recordings are longer, so the least number changes nothing on them.
FRAMES, FEWEST = 20, 8
# Refined cameras are used if they reduce the contours' distance to less than this share. One of five cameras turned by
# the least angle that counts as inconsistent, 0.06° or 0.8 px, reduces a distance of 1.4 px to 0.96 of it. On dance
# with turned cameras the share is 0.87.
_WORTHWHILE = 0.98
# Largest number of refinements while the whole frames of the videos' delays still change.
_SHIFTS = 3


def refine_rig(
    body: ConeBody,
    rig: Rig,
    store: MaskStore,
    tracked: TrackedPoses,
    how: RefinementSettings | None = None,
    late: NDArray[np.int64] | None = None,
) -> Refined | None:
    """Refine cameras by the poses of frames whose masks are in the store; None if too few are usable.

    Body, cameras and poses, and the returned cameras, are in a world in which z is up. If a video is late by whole
    frames, the refinement is repeated with its other frames until less than half a frame of delay remains.
    """
    how = how or RefinementSettings()
    masks = lru_cache(16)(store.get)
    late = np.zeros(len(rig), np.int64) if late is None else late
    done: Refined | None = None
    for _ in range(_SHIFTS):
        chosen = choose_frames(masks, Views(rig), body.skeleton, tracked, FRAMES, SCALES, True, late)
        if len(chosen) < FEWEST:
            break
        before = None if done is None else done.before_px
        done = refine_cameras(body, rig, chosen, how)
        done = replace(
            done,
            offset_frames=done.offset_frames + late,
            before_px=done.before_px if before is None else before,
        )
        whole = np.round(done.offset_frames).astype(np.int64)
        if (whole == late).all():
            break
        late = whole
    return done


def compare_cameras(tracker: TwoPassTracker, store: MaskStore, tracked: TrackedPoses) -> CameraAgreement | None:
    """Return how the cameras differ about the tracked person; None if too few frames are usable. Arguments as of
    :func:`refine_if_inconsistent`."""
    tracked = replace(tracked, poses=tracker.world.poses_in(tracked.poses))
    masks = lru_cache(16)(store.get)
    chosen = choose_frames(masks, tracker.views, tracker.body.skeleton, tracked, FRAMES, 1, False)
    return camera_agreement(tracker.body, tracker.world.rig, chosen) if len(chosen) >= FEWEST else None


@dataclass(frozen=True)
class BetterCameras:
    """Refined cameras of a tracked person.

    Attributes:
        tracker: with these cameras and the same body.
        offset_frames: (C,) delay of each camera, frames.
        message: what was refined, for the user.
    """

    tracker: TwoPassTracker
    offset_frames: Float
    message: str


def refine_if_inconsistent(
    tracker: TwoPassTracker, agreement: CameraAgreement, store: MaskStore, tracked: TrackedPoses
) -> BetterCameras | None:
    """Refine the cameras if they disagree about the tracked person; None if they agree, or refinement does not help.

    Args:
        tracker: after the first pass over the frames.
        agreement: of :func:`compare_cameras`.
        store: the frames' masks.
        tracked: poses in the capture's world.
    """
    world = tracker.world
    tracked = replace(tracked, poses=world.poses_in(tracked.poses))
    late = whole_delays(tracker.body, world.rig, lru_cache(16)(store.get), tracked)
    if not (late.any() or agreement.inconsistent.any() or agreement.late.any()):
        return None
    done = refine_rig(tracker.body, world.rig, store, tracked, late=late)
    if done is None:
        return None
    before, after = float(np.mean(done.before_px)), float(np.mean(done.after_px))
    if not (late.any() or after < _WORTHWHILE * before):
        return None
    names, worst = world.rig.names, int(np.argmax(done.turn_deg))
    delays = [f"{name} is {n:+.2f} frames late" for name, n in zip(names, done.offset_frames, strict=True)
              if abs(n) > LATE_FRAMES]  # fmt: skip
    message = (
        f"the cameras disagreed and are refined from {done.frame_count} frames: contours {before:.2f} px off, now "
        f"{after:.2f}; {', '.join([f'{names[worst]} is turned most, by {done.turn_deg[worst]:.2f}°', *delays])} "
        "(refine = false keeps them)"
    )
    return BetterCameras(tracker.with_cameras(world.rig_out(done.rig)), done.offset_frames, message)
