"""The way of the sound to cameras that are known: it comes from what moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Camera
from tk.model.cameras.common_view import closest_to_lines
from tk.synchronise.looks import Look
from tk.synchronise.person import rays_of
from tk.synchronise.ties import Tie, solve

Float = NDArray[np.float64]

#: speed of sound in air, m/s
SOUND_M_S = 343.0
#: seconds about a sound in which its source is searched for: several steps
_ABOUT_S = 2.0


def without_travel_time(ties: Sequence[Tie], cameras: Sequence[Camera], looks: Sequence[Look]) -> list[Tie]:
    """Return ties of sound as if it had been made at each camera.

    The source is where the rays of all cameras to what moves at that time meet, or to what moves at any time. Ties stay
    as they are if these rays are parallel.
    """
    clocks = solve(len(cameras), ties)
    centers = np.array([camera.center for camera in cameras])
    motion = [_motion(look, camera) for look, camera in zip(looks, cameras, strict=True)]
    found = []
    for tie in ties:
        common = clocks.common(tie.i, tie.own_i)
        rays = np.array(
            [
                _ray(moves, look.middles_s - (common - clocks.offsets_s[c]) / clocks.rates[c])
                for c, (look, moves) in enumerate(zip(looks, motion, strict=True))
            ]
        )
        seen = np.isfinite(rays).all(axis=1)
        source = closest_to_lines(centers[seen], rays[seen]) if seen.sum() > 1 else None
        if source is not None:
            travel_s = np.linalg.norm(centers - source, axis=1) / SOUND_M_S
            tie = replace(tie, own_i=tie.own_i - float(travel_s[tie.i]), own_j=tie.own_j - float(travel_s[tie.j]))
        found.append(tie)
    return found


def _motion(look: Look, camera: Camera) -> Float:
    """Return (N - 1, 3) viewing directions to what moves, summed over its pixels, world frame."""
    rays = rays_of(look, camera, False).reshape(-1, 3).astype(np.float32)
    return np.asarray(look.changes.reshape(len(look.changes), -1) @ rays, np.float64)


def _ray(moves: Float, away_s: Float) -> Float:
    """Return the direction (3,) to what moves about a time, else at any time; NaN if nothing moves or it is unknown."""
    near = moves[np.abs(away_s) < _ABOUT_S].sum(axis=0)
    ray = near if near.any() else moves.sum(axis=0)
    length = float(np.linalg.norm(ray))
    return ray / length if length > 0 and np.isfinite(away_s).all() else np.full(3, np.nan)
