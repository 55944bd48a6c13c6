"""What the window shows of a result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.io.results.status import STATUS_MEANING
from tk.model.cameras.camera import Rig
from tk.render.palette import BONE, ELEVATION_DEG, FLOOR, WIRE, unit_rgb
from tk.render.people import People
from tk.render.scene import FIELD_OF_VIEW_DEG
from tk.view import shapes

Float = NDArray[np.float64]

# Appearance only; no measurement depends on these values.
SIZE = (1280, 860)  # pixels
_AZIMUTH = 0.6  # radians


@dataclass(frozen=True)
class Contents:
    """The people of a result, the cameras if they are known, and the ground truth (T, F, 15, 3) if there is one."""

    people: People
    rig: Rig | None
    truth: Float | None

    @property
    def names(self) -> list[str]:
        """Parts that can be shown and hidden."""
        there = {
            "body": any(figure.solids for figure in self.people.figures),
            "joints": True,
            "hull": self.people.first.hull is not None,
            "truth": self.truth is not None,
            "cameras": self.rig is not None,
            "floor": True,
        }
        return [name for name, is_there in there.items() if is_there]

    def geometry(self, name: str, row: int) -> list[Any]:
        """Return Open3D's coloured geometries of one of :attr:`names` in a frame, without empty ones."""
        found = list[Any]()
        if name == "body":
            found += [shapes.body_mesh(figure, row) for figure in self.people.figures]
        elif name == "joints":
            for figure in self.people.figures:
                joints = figure.joints[row]
                found.append(shapes.skeleton_lines(joints).paint_uniform_color(unit_rgb(BONE)))
                found.append(shapes.joint_spheres(joints, None if figure.sigma is None else figure.sigma[row]))
        elif name == "hull" and self.people.first.hull is not None:
            found.append(shapes.hull_cloud(self.people.first.hull[row]))
        elif name == "truth" and self.truth is not None:
            found.append(shapes.truth_spheres(self.truth[:, row].reshape(-1, 3)))
        elif name == "cameras" and self.rig is not None:
            found.append(shapes.camera_lines(self.rig).paint_uniform_color(unit_rgb(WIRE)))
        elif name == "floor":
            found.append(shapes.floor_lines(self.people.stage).paint_uniform_color(unit_rgb(FLOOR)))
        return [geometry for geometry in found if not geometry.is_empty()]

    @property
    def eye(self) -> Float:
        """(3,) position of the camera, metres, world frame: beside and above the motion, all of it in view."""
        stage = self.people.stage
        elevation = np.radians(ELEVATION_DEG)
        distance = 1.25 * stage.radius / np.sin(np.radians(FIELD_OF_VIEW_DEG / 2))
        horizontal = stage.axes @ np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0])
        direction = np.cos(elevation) * horizontal + np.sin(elevation) * stage.axes[:, 2]
        return np.asarray(stage.middle + distance * direction)

    def line(self, row: int) -> str:
        """Return a line about a frame: time, and each person's status, residual and uncertainty."""
        parts = [f"frame {self.people.first.frames[row]}", f"{self.people.first.time[row]:.2f} s"]
        for person in self.people.results:
            who = f"person {person.person} " if len(self.people) > 1 else ""
            parts.append(who + STATUS_MEANING[person.status[row]])
            error = person.silhouette_error
            if error is not None and np.isfinite(error[row]).any():
                parts.append(f"E_S {100 * np.nanmean(error[row]):.1f} %")
            if person.sigma is not None and np.isfinite(person.sigma[row]).any():
                parts.append(f"median sigma {100 * np.nanmedian(person.sigma[row]):.1f} cm")
        return "    ".join(parts)
