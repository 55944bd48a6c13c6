"""Footsteps: positions of the toes over time, for motions whose legs follow from the feet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

PUSH_DEG, PUSH_FRAMES = 22.0, 4.0


@dataclass(frozen=True)
class Step:
    """A foot leaves the floor at frame ``lifts`` and stands again at ``lands``: its toe tip at ``toe_m`` (x, y), the
    foot turned by ``heading_deg``; in between it is up to ``height_m`` above the floor."""

    lifts: float
    lands: float
    toe_m: tuple[float, float]
    heading_deg: float = 0.0
    height_m: float = 0.06


@dataclass(frozen=True)
class FootTrack:
    """``toe`` (T, 3) metres, ``heading`` (T,) radians, ``push`` (T,) radians by which the ankle lifts the heel."""

    toe: Float
    heading: Float
    push: Float


def foot_track(steps: Sequence[Step], frame: Float) -> FootTrack:
    """Return the track of one foot at (T,) frames. The foot stands at the first step until the second begins."""
    toe = np.tile(np.array([*steps[0].toe_m, 0.0]), (len(frame), 1))
    heading = np.full(len(frame), np.radians(steps[0].heading_deg))
    push = np.zeros(len(frame))
    for before, step in pairwise(steps):
        share = np.clip((frame - step.lifts) / (step.lands - step.lifts), 0.0, 1.0)
        eased = share**3 * (10 - 15 * share + 6 * share**2)  # no jerk where it lifts and lands
        toe[:, :2] += eased[:, None] * (np.array(step.toe_m) - np.array(before.toe_m))
        toe[:, 2] += step.height_m * np.sin(np.pi * share) ** 2
        heading += eased * np.radians(step.heading_deg - before.heading_deg)
        push += np.radians(PUSH_DEG) * np.exp(-(((frame - step.lifts) / PUSH_FRAMES) ** 2))
    return FootTrack(toe, heading, push)
