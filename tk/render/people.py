"""Everybody in a result, and the place where they move: what overlays, 3D views, the window and the report draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.io.results.data import Result
from tk.io.results.status import STATUS_MEANING
from tk.model.cameras.up import up_vector
from tk.render.figure import Figure, figure_of

Float = NDArray[np.float64]

_SQUARE_M, _SQUARES = 0.5, 6  # side of the floor's squares, and their number on each side of the middle; appearance


@dataclass(frozen=True)
class People:
    """The people of a result, with the same frames."""

    results: tuple[Result, ...]

    @property
    def first(self) -> Result:
        return self.results[0]

    def __len__(self) -> int:
        return len(self.results)

    @cached_property
    def figures(self) -> tuple[Figure, ...]:
        return tuple(figure_of(person) for person in self.results)

    @cached_property
    def stage(self) -> Stage:
        return Stage.of(self)

    @cached_property
    def left_out(self) -> NDArray[np.bool_]:
        """(F, C) whether a camera was left out of a frame, of everybody who has a pose in it; False in frames without a
        pose. C is 0 if the result has no residual."""
        known = [(person.has_pose, out) for person in self.results if (out := person.excluded) is not None]
        if not known:
            return np.zeros((len(self.first), 0), np.bool_)
        out = np.all([out | ~posed[:, None] for posed, out in known], axis=0)
        return np.asarray(out & np.any([posed for posed, _ in known], axis=0)[:, None])

    def lost(self, row: int) -> bool:
        """Return whether anybody is lost in a frame."""
        return any(figure.lost(row) and figure.there(row) for figure in self.figures)

    def state(self, row: int) -> str:
        """Return everybody's status in a frame in words."""
        return ", ".join(STATUS_MEANING[person.status[row]] for person in self.results)

    def chosen(self, frames: Sequence[int], count: int | None = None) -> list[int]:
        """Return these frames, ascending; without any, ``count`` frames spread over the result, all by default."""
        known = self.first.frames.tolist()
        missing = sorted(set(frames) - set(known))
        if missing:
            raise ResultError(
                f"{self.first.path}: frame {missing[0]} is not in it; it has frames {min(known)} to {max(known)}"
            )
        spread = [known[i] for i in np.unique(np.linspace(0, len(known) - 1, count or len(known)).astype(int))]
        return sorted(set(frames)) or sorted(spread)


@dataclass(frozen=True)
class Stage:
    """Where people move."""

    axes: Float  # (3, 3) two horizontal directions and up, as columns; right-handed
    middle: Float  # (3,) centre of the motion, metres
    radius: float  # radius of a ball around `middle` that contains the motion, metres
    floor: float  # height of the floor along up, metres

    @staticmethod
    def of(people: People) -> Stage:
        """Return the stage of the frames that are not lost (all, if all are). The lowest feet stand on the floor."""
        up = up_vector(people.first.meta.up)
        good = [person.has_pose for person in people.results]
        if not any(rows.any() for rows in good):
            good = [~rows for rows in good]
        joints = [figure.joints for figure in people.figures]
        points = np.concatenate([places[rows].reshape(-1, 3) for places, rows in zip(joints, good, strict=True)])
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            raise ResultError(f"{people.first.path}: has no joints to draw")
        side = np.eye(3)[np.argmin(np.abs(up))]
        east = np.cross(side, up)
        east /= np.linalg.norm(east)
        low, high = points.min(axis=0), points.max(axis=0)
        middle = (low + high) / 2
        feet = [p if person.feet is None else person.feet for person, p in zip(people.results, joints, strict=True)]
        heights = np.concatenate([(places[rows] @ up).min(axis=1) for places, rows in zip(feet, good, strict=True)])
        heights = heights[np.isfinite(heights)]
        # the 10th percentile, because feet may be below the floor in single frames
        floor = float(np.percentile(heights, 10)) if len(heights) else float((points @ up).min())
        radius = float(np.linalg.norm(points - middle, axis=1).max()) + 0.15
        return Stage(np.column_stack([east, np.cross(up, east), up]), middle, radius, floor)

    @property
    def origin(self) -> Float:
        """(3,) point of the floor below or above :attr:`middle`, metres."""
        up = self.axes[:, 2]
        return np.asarray(self.middle + (self.floor - self.middle @ up) * up)

    def floor_lines(self) -> Float:
        """Return the ends (N, 2, 3) of the lines of the floor's squares, metres."""
        east, north, _ = self.axes.T
        reach = _SQUARE_M * _SQUARES
        return np.array(
            [
                [self.origin + k * across - reach * along, self.origin + k * across + reach * along]
                for k in np.linspace(-reach, reach, 2 * _SQUARES + 1)
                for along, across in ((east, north), (north, east))
            ]
        )
