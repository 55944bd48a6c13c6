"""What a window shows of a result, whichever way it is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.io.results.data import STATUS_MEANING
from tk.io.results.writer import Result, read_joints
from tk.model.cameras.camera import Rig
from tk.render.figure import Figure, figure_of
from tk.render.scene import Stage
from tk.view import shapes

Float = NDArray[np.float64]

SIZE = (1280, 860)
BACKGROUND = (0.11, 0.12, 0.135)
WIRE = (0.62, 0.68, 0.78)
_FLOOR, _BONE = (0.32, 0.34, 0.37), (0.95, 0.95, 0.95)
FIELD_OF_VIEW_DEG = 40.0
_ELEVATION_DEG = 14.0


@dataclass(frozen=True)
class Contents:
    """A result, its cameras where they are known, and the true joints (F, 15, 3) where there are some."""

    result: Result
    rig: Rig | None
    truth: Float | None

    @cached_property
    def figure(self) -> Figure:
        return figure_of(self.result)

    @cached_property
    def stage(self) -> Stage:
        return Stage.of(self.result, self.figure)

    @property
    def names(self) -> list[str]:
        """What can be shown and hidden."""
        there = {
            "body": bool(self.figure.solids),
            "joints": True,
            "hull": self.result.hull is not None,
            "truth": self.truth is not None,
            "cameras": self.rig is not None,
            "floor": True,
        }
        return [name for name, is_there in there.items() if is_there]

    def geometry(self, name: str, row: int) -> dict[str, Any]:
        """Open3D's geometries of what goes by one of :attr:`names`, in a frame, in their colours; none is empty."""
        figure, found = self.figure, dict[str, Any]()
        if name == "body":
            found["body"] = shapes.body_mesh(figure, row)
        elif name == "joints":
            joints = figure.joints[row]
            found["bones"] = shapes.skeleton_lines(joints).paint_uniform_color(_BONE)
            found["joints"] = shapes.joint_spheres(joints, None if figure.sigma is None else figure.sigma[row])
        elif name == "hull" and self.result.hull is not None:
            found["hull"] = shapes.hull_cloud(self.result.hull[row])
        elif name == "truth" and self.truth is not None:
            found["truth"] = shapes.truth_spheres(self.truth[row])
        elif name == "cameras" and self.rig is not None:
            found["cameras"] = shapes.camera_lines(self.rig).paint_uniform_color(WIRE)
        elif name == "floor":
            found["floor"] = shapes.floor_lines(self.stage).paint_uniform_color(_FLOOR)
        return {name: geometry for name, geometry in found.items() if not geometry.is_empty()}

    @property
    def eye(self) -> Float:
        """(3,) a place aside and a little above, all that moves and some of the room in sight; metres."""
        stage = self.stage
        elevation = np.radians(_ELEVATION_DEG)
        distance = 1.25 * stage.radius / np.sin(np.radians(FIELD_OF_VIEW_DEG / 2))
        aside = np.cos(elevation) * self.level + np.sin(elevation) * stage.axes[:, 2]
        return np.asarray(stage.middle + distance * aside)

    @property
    def level(self) -> Float:
        """(3,) the horizontal direction from the middle to :attr:`eye`."""
        return np.asarray(self.stage.axes @ np.array([np.cos(0.6), np.sin(0.6), 0.0]))

    def line(self, row: int) -> str:
        """What there is to say of a frame."""
        result = self.result
        parts = [f"frame {result.frames[row]}", f"{result.time[row]:.2f} s", STATUS_MEANING[result.status[row]]]
        error = result.silhouette_error
        if error is not None and np.isfinite(error[row]).any():
            parts.append(f"E_S {100 * np.nanmean(error[row]):.1f} %")
        if result.sigma is not None and np.isfinite(result.sigma[row]).any():
            parts.append(f"median sigma {100 * np.nanmedian(result.sigma[row]):.1f} cm")
        return "    ".join(parts)


def truth_of(result: Result, path: Path) -> Float | None:
    """(F, 15, 3) the true joints of a file in the result's frames; NaN where it has none, None without the file."""
    if not path.exists():
        return None
    truth = read_joints(path)
    places = np.full((len(result), *truth.positions.shape[1:]), np.nan)
    _, mine, theirs = np.intersect1d(result.frames, truth.frames, return_indices=True)
    places[mine] = truth.positions[theirs]
    return places
