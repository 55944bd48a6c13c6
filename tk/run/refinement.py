"""`tk refine`: refines cameras and time offsets by a tracked recording of a person."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tk.errors import CalibrationError, CaptureError, ConfigError, ResultError
from tk.io.captures.calibration import CALIBRATION, write_calibration
from tk.io.captures.capture import Capture
from tk.io.captures.mask_store import MaskStore
from tk.io.paths import check_output
from tk.io.results.reader import read_result
from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.agreement import LATE_FRAMES, CameraAgreement, camera_agreement
from tk.model.cameras.bundle import TrackedPoses, choose_frames
from tk.model.cameras.camera import Rig
from tk.model.cameras.refinement import SCALES, Refined, RefinementSettings, refine_cameras
from tk.model.cameras.tracker_frame import TrackerFrame
from tk.model.cues.ray_costs import Evidence, RayGrid, residual_of
from tk.model.masks.silhouettes import Views
from tk.run.plan import reduce_images
from tk.run.prefetch import open_observations
from tk.run.task import Task
from tk.settings import Settings
from tk.threads import one_thread
from tk.trackers.bodies import body_and_poses
from tk.trackers.contour_finder import SCREEN_ROWS
from tk.trackers.protocol import TwoPassTracker

Float = NDArray[np.float64]
Note = Callable[[str], None]

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
# A delay counts as unknown if its standard deviation exceeds this, frames.
_UNKNOWN_FRAMES = 0.25
# Whole frames of a video's delay that are tried before the refinement, whose edges reach some pixels only; and the
# frames in which they are tried. A video is late if its share of wrong pixels is above the median camera's by the
# first factor, and falls below the second without the delay. Two frames late at 15 Hz gave no delay without this.
LARGEST_DELAY, DELAY_FRAMES = 5, 12
_WORSE, _MENDED = 1.3, 0.8
# Least share of wrong pixels that is compared, a tenth of what correct cameras have: drawn masks have none.
_EXACT = 0.01


@dataclass(frozen=True)
class Refinement:
    """Refined cameras with a report.

    Attributes:
        refined: the cameras in the tracker's frame; ``offset_frames`` includes the whole frames of a delay.
        names: of the cameras.
        frames: number of frames used.
    """

    refined: Refined
    names: tuple[str, ...]
    frames: int

    @property
    def warnings(self) -> list[str]:
        """Warnings about unreliable numbers, one line each."""
        r = self.refined
        lines = []
        if not r.converged:
            lines.append("the cameras still moved in the last round; refine again with the new calibration")
        vague = [name for name, observed in zip(self.names, r.observed, strict=True) if not observed]
        if vague:
            lines.append(
                f"{', '.join(vague)}: the recording does not determine where these cameras are, so they stay near the "
                "calibration; record a person who walks about and turns"
            )
        if (r.offset_sigma_frames > _UNKNOWN_FRAMES).any():
            lines.append(
                "the person moves too little to estimate the time offsets; leave them out, or use faster motion"
            )
        return lines

    def format_table(self) -> str:
        """A table with one line a camera."""
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
    force: bool = False,
) -> Refinement:
    """Refine a capture's cameras by a result of tracking it, and write a new calibration file; ``force`` replaces one.

    Raises:
        ConfigError: the result has no cone body.
        CaptureError, ResultError: capture and result do not match, or too few frames are tracked.
        CalibrationError: the new file cannot be written.
    """
    check_output(output, CALIBRATION, force, [result], capture.path, CalibrationError)
    found = read_result(result)
    tracked = body_and_poses(found)
    if tracked is None:
        raise ConfigError(f"{result}: has no body with contours; track with the method region")
    if not len(found.frames) or found.frames.max() >= capture.frame_count or found.meta.up != capture.up:
        raise ResultError(f"{result}: is not a result of {capture.path}")
    if found.cameras is not None and found.cameras.rig.names != capture.rig.names:
        raise ResultError(
            f"{result}: was tracked with the cameras {', '.join(found.cameras.rig.names)}; open the same",
            hint="name them with --cameras",
        )
    source = reduce_images(capture, config.person_pixels)
    world, store = TrackerFrame.of(source.rig, source.up), MaskStore()
    with open_observations(Task.of(source, config), note, keep_images=False) as observations:
        for observation, _ in observations.frames(int(found.frames.min()), int(found.frames.max()) + 1):
            store.put(observation.index, observation.masks)
    poses = TrackedPoses(found.frames, world.poses_in(tracked[1]), found.has_pose)
    done = refine_rig(tracked[0].standing("z"), world.rig, store, poses, how)
    if done is None:
        raise CaptureError(
            f"{result}: has too few consecutive tracked frames to refine {capture.path}; {FEWEST} are needed"
        )
    read = np.array(capture.late_frames) / capture.fps
    late = read + done.refined.offset_frames / capture.fps
    write_calibration(output, capture.calibration, world.rig_out(done.refined.rig.recorded()), late.tolist())
    return done


def refine_rig(
    body: ConeBody,
    rig: Rig,
    store: MaskStore,
    tracked: TrackedPoses,
    how: RefinementSettings | None = None,
    late: NDArray[np.int64] | None = None,
) -> Refinement | None:
    """Refine cameras by the poses of frames whose masks are in the store; None if too few are usable.

    Body, cameras and poses, and the returned cameras, are in a world in which z is up. If a video is late by whole
    frames, the refinement is repeated with its other frames until less than half a frame of delay remains.
    """
    how = how or RefinementSettings()
    masks = lru_cache(16)(store.get)
    late = np.zeros(len(rig), np.int64) if late is None else late
    done: Refined | None = None
    count = 0
    for _ in range(_SHIFTS):
        chosen = choose_frames(masks, Views(rig), body.skeleton, tracked, FRAMES, SCALES, True, late)
        if len(chosen) < FEWEST:
            break
        count = len(chosen)
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
    return None if done is None else Refinement(done, rig.names, count)


def compare_cameras(tracker: TwoPassTracker, store: MaskStore, tracked: TrackedPoses) -> CameraAgreement | None:
    """Return how the cameras differ about the tracked person; None if too few frames are usable. Arguments as of
    :func:`refine_if_inconsistent`."""
    tracked = replace(tracked, poses=tracker.world.poses_in(tracked.poses))
    masks = lru_cache(16)(store.get)
    chosen = choose_frames(masks, tracker.views, tracker.body.skeleton, tracked, FRAMES, 1, False)
    return camera_agreement(tracker.body, tracker.world.rig, chosen) if len(chosen) >= FEWEST else None


def refine_if_inconsistent(
    tracker: TwoPassTracker,
    agreement: CameraAgreement,
    store: MaskStore,
    tracked: TrackedPoses,
    note: Note,
) -> tuple[TwoPassTracker, MaskStore, Float] | None:
    """Refine the cameras if they disagree about the tracked person; None if they agree, or refinement does not help.

    Args:
        tracker: after the first pass over the frames.
        agreement: of :func:`compare_cameras`.
        store: the frames' masks.
        tracked: poses in the capture's world.
        note: receives a message about the refined cameras.

    Returns:
        A tracker with the refined cameras and the same body, the synchronised masks, and the delay of each camera (C,),
        frames.
    """
    world = tracker.world
    tracked = replace(tracked, poses=world.poses_in(tracked.poses))
    late = whole_delays(tracker.body, world.rig, lru_cache(16)(store.get), tracked)
    if not (late.any() or agreement.inconsistent.any() or agreement.late.any()):
        return None
    done = refine_rig(tracker.body, world.rig, store, tracked, late=late)
    if done is None:
        return None
    refined = done.refined
    before, after = float(np.mean(refined.before_px)), float(np.mean(refined.after_px))
    if not (late.any() or after < _WORTHWHILE * before):
        return None
    names, worst = world.rig.names, int(np.argmax(refined.turn_deg))
    delays = [f"{name} is {n:+.2f} frames late" for name, n in zip(names, refined.offset_frames, strict=True)
            if abs(n) > LATE_FRAMES]  # fmt: skip
    note(
        f"the cameras disagreed and are refined from {done.frames} frames: contours {before:.2f} px off, now "
        f"{after:.2f}; {', '.join([f'{names[worst]} is turned most, by {refined.turn_deg[worst]:.2f}°', *delays])} "
        "(refine = false keeps them)"
    )
    synchronised = retimed(store, tracked.frames, np.round(refined.offset_frames).astype(np.int64))
    return tracker.with_cameras(world.rig_out(refined.rig)), synchronised, refined.offset_frames


def whole_delays(
    body: ConeBody, rig: Rig, masks: Callable[[int], NDArray[np.uint8]], tracked: TrackedPoses
) -> NDArray[np.int64]:
    """Return (C,) whole frames by which each video is late. The body explains the masks of a late video worse than
    those of the others, and those of some frames earlier well. Arguments as of :func:`refine_rig`."""
    frames, stored = tracked.frames, set(tracked.frames.tolist())
    shifts = range(-LARGEST_DELAY, LARGEST_DELAY + 1)
    rows = np.flatnonzero(tracked.usable & [all(frame - n in stored for n in shifts) for frame in frames.tolist()])
    if not len(rows):
        return np.zeros(len(rig), np.int64)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, DELAY_FRAMES).round().astype(int))]
    grid = RayGrid(rig, SCREEN_ROWS)
    sampled = cache(lambda frame: grid.sample(masks(frame)).copy())
    bodies = []
    for i in rows:
        _, met = Evidence.of(grid, masks(int(frames[i]))).cast(body, tracked.poses[i][None])
        bodies.append(met.label[0] > 0)

    def wrong(n: int) -> Float:
        """Return (R, C) the shares of wrong pixels with masks of n frames before; NaN where they show nobody."""
        both = zip(bodies, (sampled(int(frames[i]) - n) for i in rows), strict=True)
        return np.array([residual_of(drawn, m >= PERSON, m == OTHERS).sum(axis=1) for drawn, m in both])

    # frames in which a camera shows somebody with every delay
    shares = np.array([wrong(n) for n in shifts])
    shares = np.ma.array(shares, mask=np.broadcast_to(~np.isfinite(shares).all(axis=0), shares.shape))
    now = np.ma.maximum(shares[LARGEST_DELAY], _EXACT)
    # A delay mends most frames. A camera that is turned at some time has frames of its old place within the largest
    # delay after the turn, but in the frames before, every delay is worse.
    change = np.ma.filled(np.ma.median(shares / now, axis=1), 1.0)
    mean = np.ma.filled(now.mean(axis=0), 0.0)
    mended = (mean > _WORSE * np.median(mean)) & (change.min(axis=0) < _MENDED)
    return np.where(mended, np.array(shifts)[np.argmin(change, axis=0)], 0)


def retimed(store: MaskStore, frames: NDArray[np.int64], late: NDArray[np.int64]) -> MaskStore:
    """Return the masks of frames (F,) of cameras that are late by whole frames (C,); empty if a camera has no image."""
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
