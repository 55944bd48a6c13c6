"""A rig with known projections in the format of each tool, and tiny videos whose images encode their camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.io.conftest import CENTER, look_at, picture, read_tag, write_video
from tk.io.captures.calibration import camera_table
from tk.io.captures.capture import Capture, open_capture
from tk.io.importers import Imported, Wanted, import_project
from tk.model.cameras.camera import Camera, Rig

WIDTH, HEIGHT = 320, 240
FRAMES = 3

#: a rotation of the world: z up becomes y down, as in the Panoptic Studio
Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def make_rig(distorted: bool = True, world: np.ndarray | None = None) -> Rig:
    """Return four different cameras 2.5 to 3.7 m from (0, 0, 1); ``world`` (3, 3) rotates the world."""
    turn = np.eye(3) if world is None else world
    cameras = []
    for index in range(4):
        angle = 0.4 + 1.45 * index
        center = CENTER + np.array([np.cos(angle), np.sin(angle), 0.25 + 0.1 * index]) * (2.5 + 0.4 * index)
        rotation, _ = look_at(center, CENTER + 0.1 * np.array([index, 1.0, -index]))
        rotation = rotation @ turn.T
        matrix = np.array([[290.0 + 7 * index, 0.0, 161.3 - index], [0.0, 287.0 + 9 * index, 117.9 + index], [0, 0, 1]])
        distortions = np.array([-0.11 + 0.01 * index, 0.06, 0.0011, -0.0007 * index, 0.0]) * distorted
        cameras.append(
            Camera(f"cam{index + 1}", WIDTH, HEIGHT, matrix, distortions, rotation, -rotation @ turn @ center)
        )
    return Rig(tuple(cameras))


def points(world: np.ndarray | None = None) -> np.ndarray:
    """Return points (40, 3) near the person, metres."""
    around = CENTER + np.random.default_rng(5).uniform(-0.6, 0.6, (40, 3))
    return around if world is None else around @ world.T


def write_clips(folder: Path, names: list[str], size: tuple[int, int] = (WIDTH, HEIGHT), suffix: str = ".mp4") -> None:
    """Write a video of three frames for each name; its images encode the index of the name."""
    for index, name in enumerate(names):
        write_video(folder / f"{name}{suffix}", [picture(index, k, size) for k in range(FRAMES)])


def rodrigues(camera: Camera) -> list[float]:
    return cv2.Rodrigues(camera.rotation)[0].ravel().tolist()


def tables(rig: Rig, unit_m: float = 1.0) -> dict[str, dict[str, Any]]:
    """Return the tables of a TOML calibration by the cameras' names."""
    return {
        camera.name: camera_table(camera) | {"translation": (camera.translation / unit_m).tolist()} for camera in rig
    }


@dataclass(frozen=True)
class Checked:
    """A successful import."""

    imported: Imported
    capture: Capture

    def note(self, *parts: str) -> str:
        """Return the one note that contains all these parts."""
        (found,) = [note for note in self.imported.notes if all(part in note for part in parts)]
        return found


class Import:
    """Imports a folder and compares the capture with the true rig."""

    def __init__(self, output: Path) -> None:
        self.output = output

    def __call__(
        self,
        folder: Path,
        rig: Rig,
        world: np.ndarray | None = None,
        unit: str | None = None,
        trial: str | None = None,
        order: list[int] | None = None,
        scale: str | None = None,
        tolerance_px: float = 0.01,
    ) -> Checked:
        """Check that every camera of ``rig`` exists, projects within a tolerance, and has its own video (``order``)."""
        imported = import_project(folder, self.output, Wanted(unit, trial, scale))
        capture = open_capture(imported.path)
        assert imported.cameras == len(capture.rig) == len(rig)
        assert all("\n" not in note for note in imported.notes)
        p_world = points(world)
        for camera, true in zip(capture.rig, rig, strict=True):
            assert (camera.width, camera.height) == (true.width, true.height)
            expected, _ = true.project(p_world)
            assert np.isfinite(expected).all()
            np.testing.assert_allclose(camera.project(p_world)[0], expected, atol=tolerance_px, rtol=0)
        with capture.frames() as frames:
            seen = [[read_tag(image)[0] for image in frame.images[:, :HEIGHT, :WIDTH]] for frame in frames]
        assert seen == [order or list(range(len(rig)))] * FRAMES
        assert (capture.volume.lower < p_world.mean(axis=0)).all() and (
            capture.volume.upper > p_world.mean(axis=0)
        ).all()
        return Checked(imported, capture)


@pytest.fixture
def check(tmp_path: Path) -> Import:
    return Import(tmp_path / "imported")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return an empty project folder."""
    made = tmp_path / "project"
    made.mkdir()
    return made


def renamed(rig: Rig, *names: str) -> Rig:
    return Rig(tuple(replace(camera, name=name) for camera, name in zip(rig, names, strict=True)))


def projection_matrix(camera: Camera) -> np.ndarray:
    """Return (3, 4) K [R | t], without lens distortion."""
    return np.asarray(camera.matrix @ np.column_stack([camera.rotation, camera.translation]))
