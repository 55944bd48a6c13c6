"""A capture of red people in a room, seen by a ring of cameras, and a segmenter that finds red pixels.

They test the code around a segmentation network: the images that it receives, and the masks that are kept.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w

from scripts.synthetic.capture import write_calibration
from tests.model.ring import ring_of_cameras
from tk.model.cameras.camera import Camera, Rig

#: position of a person by frame: x, y in metres; None where the person is absent
Path2 = Callable[[int], tuple[float, float] | None]

WIDTH, HEIGHT = 96, 120
RIG = ring_of_cameras(4, WIDTH, HEIGHT)
VOLUME = {"center": [0.0, 0.0, 1.0], "size": [2.4, 2.4, 2.2]}

#: module of a package that brings the segmenter "red"; its entry point is written by :func:`install`
SEGMENTER = '''
import cv2
import numpy as np

from tk.model.masks.sightings import Sighting


class Red:
    """Segments all people."""

    def segment(self, image):
        return np.where(red(image) > 0, 0.9, 0.1).astype(np.float32)


class Finding:
    """Finds all people and segments the one in the middle."""

    def segment(self, image):
        _, parts = cv2.connectedComponents(red(image))
        middle = parts[parts.shape[0] // 2, parts.shape[1] // 2]
        return np.where((parts == middle) & (parts > 0), 0.9, 0.1).astype(np.float32)

    def find(self, image):
        _, _, stats, middles = cv2.connectedComponentsWithStats(red(image))
        people = [(x, y, height) for (x, y), (_, _, _, height, area) in zip(middles[1:], stats[1:]) if area > 20]
        return [Sighting((x, y), (x, y - 0.6 * height), 0.9) for x, y, height in people]


class Wrong:
    def segment(self, image):
        return np.full(image.shape[:2], 3.0, np.float32)


def red(picture):
    blue, green, red = (picture[..., k].astype(int) for k in range(3))
    return ((red > 150) & (green < 90) & (blue < 90)).astype(np.uint8)
'''


def person_mask(camera: Camera, at: tuple[float, float], height_m: float = 1.75) -> np.ndarray:
    """Return the mask (h, w), 0 or 255, of an upright capsule of 22 cm radius at a position."""
    mask = np.zeros((camera.height, camera.width), np.uint8)
    angles = np.linspace(0, 2 * np.pi, 24)
    rings = []
    for z in np.linspace(0, height_m, 12):
        radius = 0.22 * np.sqrt(max(1 - (2 * z / height_m - 1) ** 8, 0.02))
        rings.append(
            np.column_stack([at[0] + radius * np.cos(angles), at[1] + radius * np.sin(angles), np.full_like(angles, z)])
        )
    pixels, _ = camera.project(np.concatenate(rings))
    if np.isfinite(pixels).all():
        hull = cv2.convexHull(pixels.round().astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 255)
    return mask


def write_people(folder: Path, people: Sequence[Path2], frames: int = 20, rig: Rig = RIG) -> Path:
    """Write a capture without masks and background. The true masks go to ``truth/``: 255 for the first person, 128 for
    the others."""
    folder.mkdir(parents=True)
    write_calibration(rig, folder / "calibration.toml")
    settings = {"fps": 15.0, "volume": VOLUME, "init": {"pose": "any"}}
    (folder / "capture.toml").write_text(tomli_w.dumps(settings), encoding="utf-8")
    rng = np.random.default_rng(4)
    for camera in rig:
        small = rng.integers(60, 200, (camera.height // 10, camera.width // 10, 1), np.uint8).repeat(3, 2)
        room = cv2.resize(small, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
        for kind in ("images", "truth"):
            (folder / kind / camera.name).mkdir(parents=True)
        for k in range(frames):
            picture = cv2.add(room, rng.integers(0, 4, room.shape, np.uint8))
            true = np.zeros(room.shape[:2], np.uint8)
            for who, path in reversed(list(enumerate(people))):
                at = path(k)
                mask = np.zeros(room.shape[:2], np.uint8) if at is None else person_mask(camera, at)
                picture[mask > 0] = (40, 40, 200)
                true[mask > 0] = 128 if who else 255
            cv2.imwrite(str(folder / "truth" / camera.name / f"{k:06d}.png"), true)
            cv2.imwrite(str(folder / "images" / camera.name / f"{k:06d}.png"), picture)
    return folder


def truth(folder: Path, k: int, everybody: bool = False) -> np.ndarray:
    """Return the true masks (C, H, W) of a frame, bool: of the first person, or of everybody."""
    files = [folder / "truth" / name / f"{k:06d}.png" for name in RIG.names]
    masks = np.stack([cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files])
    return masks > 0 if everybody else masks == 255


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, **classes: str) -> None:
    """Install segmenters as a package would: names, and classes of :data:`SEGMENTER`."""
    folder.mkdir(parents=True)
    (folder / "redsegmenter.py").write_text(SEGMENTER, encoding="utf-8")
    info = folder / "redsegmenter-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: redsegmenter\nVersion: 1.0\n", encoding="utf-8")
    lines = "".join(f"{name} = redsegmenter:{cls}\n" for name, cls in classes.items())
    (info / "entry_points.txt").write_text(f"[tk.segmenters]\n{lines}", encoding="utf-8")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "redsegmenter", raising=False)
