"""Videos that are late by whole frames: how many, and masks without the delay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.mask_store import MaskStore
from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.cameras.bundle import TrackedPerson
from tk.model.cameras.camera import Rig
from tk.model.cues.ray_costs import RayGrid, residual_of
from tk.trackers.contour_finder import COARSE_ROWS

# Frames of a recording in which delays, headings or runs are compared.
COMPARED = 12
# Whole frames of a video's delay that are tried before the refinement, whose edges reach some pixels only. A delay at
# the edge of the range is no optimum: the range is then doubled, at most to MOST frames, which takes some seconds.
REACH, MOST = 5, 80
# A video is late if its share of wrong pixels falls below this factor without the delay.
_MENDED = 0.8
# Least share of wrong pixels that is compared, a tenth of what correct cameras have: drawn masks have none.
_EXACT = 0.01


def whole_delays(people: Sequence[TrackedPerson], rig: Rig) -> NDArray[np.int64]:
    """Return (C,) whole frames by which each video is late; 0 if the recording is too short to find its delay.

    The bodies explain the masks of a late video worse than those of the others, and those of some frames earlier well.
    The cameras are in the world of the poses.
    """
    grid = RayGrid(rig, COARSE_ROWS)
    shares_of = [_shares_by_delay(person, grid, -(-COMPARED // len(people))) for person in people]
    late, unknown, reach = np.zeros(len(rig), np.int64), np.ones(len(rig), np.bool_), REACH
    while unknown.any() and reach <= MOST:
        shares = np.concatenate([of_delays(range(-reach, reach + 1)) for of_delays in shares_of], axis=1)
        if not shares.shape[1]:
            break
        best, mended = _best_delays(shares)
        inside = np.abs(best) < reach
        late[unknown & inside & mended] = best[unknown & inside & mended]
        unknown &= ~inside
        reach *= 2
    return late


def _shares_by_delay(person: TrackedPerson, grid: RayGrid, count: int) -> Callable[[range], NDArray[np.float64]]:
    """Return a function from N delays to the shares (N, R, C) of wrong pixels in R frames, at most ``count``, of which
    all masks with these delays are stored."""
    frames, stored = person.frames, set(person.frames.tolist())
    sampled = cache(lambda frame: grid.sample(person.masks(frame)).copy())

    @cache
    def body_in(i: int) -> NDArray[np.bool_]:
        return np.asarray(grid.render(person.body, person.poses[i][None]).label[0] > 0)

    def shares(delays: range) -> NDArray[np.float64]:
        rows = np.flatnonzero(person.usable & [all(frame - n in stored for n in delays) for frame in frames.tolist()])
        if len(rows):
            rows = rows[np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))]
        found = np.empty((len(delays), len(rows), len(grid.rig)))
        for k, n in enumerate(delays):
            for r, i in enumerate(rows.tolist()):
                seen = sampled(int(frames[i]) - n)
                found[k, r] = residual_of(body_in(i), seen >= PERSON, seen == OTHERS).sum(axis=1)
        return found

    return shares


def _best_delays(shares: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return (C,) the delay with the fewest wrong pixels of each camera, and (C,) whether it mends the camera.

    Args:
        shares: (2 N + 1, R, C) shares of wrong pixels with delays of -N to N frames; NaN where a camera shows nobody.
    """
    reach = len(shares) // 2
    # frames in which a camera shows somebody with every delay
    known = np.ma.array(shares, mask=np.broadcast_to(~np.isfinite(shares).all(axis=0), shares.shape))
    now = np.ma.maximum(known[reach], _EXACT)
    # A delay mends most frames. A camera that is turned at some time has frames of its old place within the largest
    # delay after the turn, but in the frames before, every delay is worse.
    change = np.ma.filled(np.ma.median(known / now, axis=1), 1.0)
    return np.argmin(change, axis=0) - reach, change.min(axis=0) < _MENDED


def retimed(store: MaskStore, frames: NDArray[np.int64], late: NDArray[np.int64]) -> MaskStore:
    """Return the masks of frames (F,), and what they show, of cameras that are late by whole frames (C,); empty if a
    camera has no image."""
    if not late.any():
        return store
    result, stored, colors = MaskStore(), lru_cache(16)(store.get), lru_cache(16)(store.colors)
    for frame in frames.tolist():
        shown = [(frame - n, c) for c, n in enumerate(late.tolist())]
        none = np.zeros_like(stored(frame)[0])
        layers = np.stack([stored(n)[c] if n in store else none for n, c in shown])
        known = [one[c] for n, c in shown if (one := colors(n)) is not None]
        result.put(frame, layers, np.stack(known) if len(known) == len(shown) else None)
    return result


def retimed_measured(
    measured: NDArray[np.float64], frames: NDArray[np.int64], late: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return what was measured (F, C, N, K) in frames (F,) by cameras that are late by whole frames (C,); NaN if a
    camera has no image."""
    if not late.any():
        return measured
    shown = frames[:, None] - late
    row = np.searchsorted(frames, shown).clip(max=len(frames) - 1)
    return np.where((frames[row] == shown)[..., None, None], measured[row, np.arange(len(late))], np.nan)
