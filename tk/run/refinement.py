"""Refinement of cameras and time offsets by the poses of tracked people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.model.body.body_fit import INFORMATIVE_FRAMES
from tk.model.cameras.agreement import LATE_FRAMES, CameraAgreement, camera_agreement
from tk.model.cameras.bundle import TrackedPerson, bundle_frames
from tk.model.cameras.camera import Rig
from tk.model.cameras.people_bundle import Filmed
from tk.model.cameras.refinement import SCALES, Refined, RefinementSettings, refine_cameras
from tk.model.masks.silhouettes import Views
from tk.run.delays import whole_delays

Float = NDArray[np.float64]

# Frames of a refinement, and of a check of the cameras' agreement, at most.
FRAMES = 20
# Refined cameras are used if they reduce the contours' distance to less than this share. One of five cameras turned by
# the least angle that counts as inconsistent, 0.06° or 0.8 px, reduces a distance of 1.4 px to 0.96 of it.
_WORTHWHILE = 0.98
# Largest number of refinements while the whole frames of the videos' delays still change.
_SHIFTS = 3


def refine_rig(
    people: Sequence[TrackedPerson],
    rig: Rig,
    how: RefinementSettings | None = None,
    late: NDArray[np.int64] | None = None,
) -> Refined | None:
    """Refine cameras by the poses of people; None if too few frames are usable.

    The cameras, also those returned, are in the world of the poses. If a video is late by whole frames, the refinement
    is repeated with its other frames until less than half a frame of delay remains.
    """
    how = how or RefinementSettings()
    late = np.zeros(len(rig), np.int64) if late is None else late
    done: Refined | None = None
    begun_late = late
    for _ in range(_SHIFTS):
        chosen = _chosen(people, Views(rig), SCALES, True, late)
        if chosen is None:
            break
        first = done
        done = refine_cameras(chosen, rig, how, first, late - begun_late)
        done = replace(done, offset_frames=done.offset_frames + late)
        if first is not None:
            done = replace(done, before_px=first.before_px)
        whole = np.round(done.offset_frames).astype(np.int64)
        if (whole == late).all():
            break
        begun_late, late = late, whole
    return done


def _chosen(
    people: Sequence[TrackedPerson],
    views: Views,
    scales: int,
    cleaning: bool,
    late: NDArray[np.int64] | None = None,
) -> list[Filmed] | None:
    """Return frames of each person, an equal number of all if possible; None if there are too few."""
    count = max(FRAMES // max(len(people), 1), INFORMATIVE_FRAMES)
    found: list[Filmed] = [(p.body, bundle_frames(p, views, count, scales, cleaning, late)) for p in people]
    return found if sum(len(frames) for _, frames in found) >= INFORMATIVE_FRAMES else None


def compare_cameras(people: Sequence[TrackedPerson], views: Views) -> CameraAgreement | None:
    """Return how the cameras differ about tracked people; None if too few frames are usable."""
    chosen = _chosen(people, views, 1, False)
    return None if chosen is None else camera_agreement(chosen, views.rig)


@dataclass(frozen=True)
class BetterCameras:
    """Refined cameras.

    Attributes:
        rig: the cameras, in the world of the poses.
        offset_frames: (C,) delay of each camera, frames.
        message: what was refined, for the user.
    """

    rig: Rig
    offset_frames: Float
    message: str


def refine_if_inconsistent(
    people: Sequence[TrackedPerson], rig: Rig, agreement: CameraAgreement
) -> BetterCameras | None:
    """Refine the cameras if they disagree about tracked people; None if they agree, or refinement does not help.

    Args:
        people: after the first pass over the frames.
        rig: the cameras, in the world of the poses.
        agreement: of :func:`compare_cameras`.
    """
    late = whole_delays(people, rig)
    if not (late.any() or agreement.inconsistent.any() or agreement.late.any()):
        return None
    done = refine_rig(people, rig, late=late)
    if done is None:
        return None
    before, after = float(np.mean(done.before_px)), float(np.mean(done.after_px))
    if not (late.any() or after < _WORTHWHILE * before):
        return None
    names, worst = rig.names, int(np.argmax(done.turn_deg))
    delays = [f"{name} is {n:+.2f} frames late" for name, n in zip(names, done.offset_frames, strict=True)
              if abs(n) > LATE_FRAMES]  # fmt: skip
    message = (
        f"the cameras disagreed and are refined from {done.frame_count} frames: contours {before:.2f} px off, now "
        f"{after:.2f}; {', '.join([f'{names[worst]} is turned most, by {done.turn_deg[worst]:.2f}°', *delays])} "
        "(refine = false keeps them)"
    )
    return BetterCameras(done.rig, done.offset_frames, message)
