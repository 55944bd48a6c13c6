"""`tk refine`: cameras and time offsets from a tracked recording of a person."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ConfigError, ResultError
from tk.io.captures.calibration import write_calibration
from tk.io.captures.capture import Capture
from tk.io.captures.mask_store import MaskStore
from tk.io.results.writer import Status, read_result
from tk.kernels.line_search import SearchSettings
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.agreement import LATE_FRAMES, camera_agreement
from tk.model.cameras.bundle import gather
from tk.model.cameras.camera import Rig
from tk.model.cameras.refinement import Refined, RefinementSettings, refine_cameras
from tk.model.cameras.tracker_frame import TrackerFrame
from tk.model.masks.silhouettes import Views
from tk.run.prefetch import open_source
from tk.settings import Settings
from tk.threads import one_thread
from tk.trackers.bodies import body_and_poses
from tk.trackers.region import RegionTracker

Float = NDArray[np.float64]
Note = Callable[[str], None]

#: frames that take part, and the fewest that do
FRAMES, FEWEST = 40, 8
#: frames in which the agreement of the cameras is looked at
LOOKED_AT = 24
# A refinement that leaves more than this share of the contours' distance is not worth a change.
_WORTH = 0.95
# A video is read by whole frames; what is left of a delay is below one half. So often this is looked at again.
_SHIFTS = 3
# A delay with a larger standard deviation, in frames, is not told by this motion.
_TELLING_FRAMES = 0.25


@dataclass(frozen=True)
class Refinement:
    """Refined cameras, and what a person wants to know of them.

    Attributes:
        refined: the cameras, in their own world; its ``offset_frames`` hold the whole delay, whole frames included.
        names: of the cameras.
        frames: that took part.
    """

    refined: Refined
    names: tuple[str, ...]
    frames: int

    @property
    def warnings(self) -> list[str]:
        """What is not to be relied on, a line each."""
        r = self.refined
        lines = []
        if not r.settled:
            lines.append("the cameras still moved in the last round; refine again with the new calibration")
        vague = [name for name, told in zip(self.names, r.told, strict=True) if not told]
        if vague:
            lines.append(
                f"{', '.join(vague)}: the recording tells little of these cameras' places, which stay near the "
                "calibration; a person who walks about and turns tells more"
            )
        if (r.offset_sigma_frames > _TELLING_FRAMES).any():
            lines.append("the person moves too little to tell the time offsets; use --no-offsets, or faster motion")
        return lines

    def format_table(self) -> str:
        """A line a camera."""
        r = self.refined
        width = max(6, *(len(name) for name in self.names))
        lines = [f"{'camera':<{width}}  turned [deg]      moved [mm]     focal [%]      late [frames]  contours [px]"]
        for c, name in enumerate(self.names):
            pixels = f"{r.before_px[c]:5.2f} → {r.after_px[c]:.2f}"
            lines.append(
                f"{name:<{width}}  {r.turn_deg[c]:5.3f} ±{r.turn_sigma_deg[c]:6.3f}  {1000 * r.move_m[c]:6.1f} "
                f"±{1000 * r.move_sigma_m[c]:5.1f}  {100 * (r.focal[c] - 1):+5.2f} ±{100 * r.focal_sigma[c]:5.2f}  "
                f"{r.offset_frames[c]:+6.2f} ±{r.offset_sigma_frames[c]:5.2f}  {pixels}"
            )
        return "\n".join(lines)


@one_thread()
def refine_capture(
    capture: Capture,
    result: Path,
    output: Path,
    config: Settings,
    note: Note,
    how: RefinementSettings | None = None,
) -> Refinement:
    """Refine a capture's cameras by a result of tracking it, and write its calibration file anew.

    Raises:
        ConfigError: the result holds no body of contours.
        CaptureError, ResultError: capture and result do not belong together, or too few frames are tracked.
        CalibrationError: the new file cannot be written.
    """
    found = read_result(result)
    tracked = body_and_poses(found)
    if tracked is None:
        raise ConfigError(f"{result}: holds no body of contours; track with --method region")
    if not len(found.frames) or found.frames.max() >= capture.frame_count or found.meta.up != capture.up:
        raise ResultError(f"{result}: is no result of {capture.path}")
    if found.cameras is not None and found.cameras.rig.names != capture.rig.names:
        raise ResultError(
            f"{result}: was tracked with the cameras {', '.join(found.cameras.rig.names)}; give them with --cameras"
        )
    world, store = TrackerFrame.of(capture.rig, capture.up), MaskStore()
    with open_source(capture, config, note, keep_images=False) as source:
        for observation, _ in source.frames(int(found.frames.min()), int(found.frames.max()) + 1):
            store.put(observation.index, observation.masks)
    body, poses = tracked[0].standing("z"), world.poses_in(tracked[1])
    usable = found.status != Status.LOST
    done = refine_rig(body, world.rig, store, found.frames, poses, usable, how)
    if done is None:
        raise CaptureError(
            f"{result}: has too few tracked frames in a row to refine {capture.path} by; {FEWEST} are needed"
        )
    read = np.array(capture.late_frames) / capture.fps
    late = read + done.refined.offset_frames / capture.fps
    write_calibration(output, capture.calibration, world.rig_out(done.refined.rig), late.tolist())
    return done


def refine_rig(
    body: ConeBody,
    rig: Rig,
    store: MaskStore,
    frames: NDArray[np.int64],
    poses: Float,
    usable: NDArray[np.bool_],
    how: RefinementSettings | None = None,
) -> Refinement | None:
    """Refine cameras by poses (F, D) of frames (F,) whose masks are in the store; None where too few are usable.

    Body, cameras and poses, and the cameras that are returned, are those of a world in which z is up.
    A video that is late by whole frames is shown by its other frames, until less than one half is left.
    """
    how = how or RefinementSettings()
    masks = lru_cache(16)(store.get)
    late = np.zeros(len(rig), np.int64)
    done: Refined | None = None
    count = 0
    for _ in range(_SHIFTS):
        moments = gather(
            lambda frame, camera: masks(frame)[camera],
            Views(rig), frames, poses, usable, FRAMES, how.scales, True, late,
        )  # fmt: skip
        if len(moments) < FEWEST:
            break
        count = len(moments)
        before = None if done is None else done.before_px
        done = refine_cameras(body, rig, moments, SearchSettings(), how)
        done = replace(
            done,
            offset_frames=done.offset_frames + late,
            before_px=done.before_px if before is None else before,
        )
        whole = np.round(done.offset_frames).astype(np.int64)
        if (whole == late).all():
            break
        late = whole
    return None if done is None else Refinement(done, rig.names, count)


def refine_if_astray(
    tracker: RegionTracker,
    store: MaskStore,
    frames: NDArray[np.int64],
    poses: Float,
    usable: NDArray[np.bool_],
    note: Note,
) -> tuple[RegionTracker, MaskStore, Float] | None:
    """The cameras refined, where they disagree about what was tracked; None where they do not, or it does not help.

    Args:
        tracker: that has gone over the frames.
        store: the frames' masks.
        frames, poses, usable: (F,), (F, D), (F,) of :func:`refine_rig`, the poses in the capture's world.
        note: who hears what was found.

    Returns:
        A tracker with the refined cameras and the same body, the masks that belong together, and by how many frames
        each camera is late (C,).
    """
    world = tracker.world
    poses = world.poses_in(poses)
    masks = lru_cache(16)(store.get)
    moments = gather(
        lambda frame, camera: masks(frame)[camera],
        tracker.views,
        frames,
        poses,
        usable,
        LOOKED_AT,
        1,
        False,
    )
    if len(moments) < FEWEST:
        return None
    agreement = camera_agreement(tracker.body, world.rig, moments)
    if not (agreement.astray.any() or agreement.late.any()):
        return None
    done = refine_rig(tracker.body, world.rig, store, frames, poses, usable)
    if done is None:
        return None
    refined = done.refined
    before, after = float(np.mean(refined.before_px)), float(np.mean(refined.after_px))
    if not after < _WORTH * before:
        return None
    names, worst = world.rig.names, int(np.argmax(refined.turn_deg))
    told = [f"{name} is {n:+.2f} frames late" for name, n in zip(names, refined.offset_frames, strict=True)
            if abs(n) > LATE_FRAMES]  # fmt: skip
    note(
        f"the cameras disagreed and are refined from {done.frames} frames: contours {before:.2f} px off, now "
        f"{after:.2f}; {', '.join([f'{names[worst]} is turned most, by {refined.turn_deg[worst]:.2f}°', *told])} "
        "(refine = false leaves them)"
    )
    fresh = RegionTracker(world.rig_out(refined.rig), tracker.up, tracker.contours, tracker.config)
    fresh.take_body(tracker.body)
    fresh.colors.restore(tracker.colors.state())
    return fresh, retimed(store, frames, np.round(refined.offset_frames).astype(np.int64)), refined.offset_frames


def retimed(store: MaskStore, frames: NDArray[np.int64], late: NDArray[np.int64]) -> MaskStore:
    """The masks of frames (F,) of cameras that are late by whole frames (C,); nobody where a camera has no picture."""
    if not late.any():
        return store
    result = MaskStore()
    for frame in frames.tolist():
        own = store.get(frame)
        layers = [
            store.get(frame - n)[c] if frame - n in store else np.zeros_like(own[c])
            for c, n in enumerate(late.tolist())
        ]
        result.put(frame, np.stack(layers))
    return result
