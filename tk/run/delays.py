"""Videos that are late by whole frames: how many, and masks without the delay."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.mask_store import MaskStore
from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.bundle import TrackedPoses
from tk.model.cameras.camera import Rig
from tk.model.cues.ray_costs import Evidence, RayGrid, residual_of
from tk.trackers.contour_finder import SCREEN_ROWS

# Whole frames of a video's delay that are tried before the refinement, whose edges reach some pixels only; and the
# frames in which they are tried. A video is late if its share of wrong pixels is above the median camera's by the
# first factor, and falls below the second without the delay. Two frames late at 15 Hz gave no delay without this.
LARGEST_DELAY, DELAY_FRAMES = 5, 12
_WORSE, _MENDED = 1.3, 0.8
# Least share of wrong pixels that is compared, a tenth of what correct cameras have: drawn masks have none.
_EXACT = 0.01


def whole_delays(
    body: ConeBody, rig: Rig, masks: Callable[[int], NDArray[np.uint8]], tracked: TrackedPoses
) -> NDArray[np.int64]:
    """Return (C,) whole frames by which each video is late. The body explains the masks of a late video worse than
    those of the others, and those of some frames earlier well. Body, cameras and poses are in a world
    in which z is up."""
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

    def wrong(n: int) -> NDArray[np.float64]:
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


def retimed_landmarks(
    landmarks: NDArray[np.float64] | None, frames: NDArray[np.int64], late: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    """Return the landmarks (F, C, L, 3) of frames (F,) of cameras that are late by whole frames (C,); NaN if a camera
    has no image."""
    if landmarks is None or not late.any():
        return landmarks
    result = np.full(landmarks.shape, np.nan)
    row = {frame: i for i, frame in enumerate(frames.tolist())}
    for c, n in enumerate(late.tolist()):
        for i, frame in enumerate(frames.tolist()):
            if frame - n in row:
                result[i, c] = landmarks[row[frame - n], c]
    return result
