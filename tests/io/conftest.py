"""Small generated captures: cameras in a ring of 3 m around (0, 0, 1); images encode their camera and frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w

WIDTH, HEIGHT = 64, 48
CENTER = np.array([0.0, 0.0, 1.0])


def look_at(center: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3,), world to camera, of a camera whose image has z up."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return rotation, -rotation @ center


def calibration_tables(count: int = 3, radius_m: float = 3.0) -> dict[str, Any]:
    """`calibration.toml` as a dictionary: cam1, cam2 … evenly around :data:`CENTER`."""
    tables: dict[str, Any] = {}
    for index in range(count):
        angle = 2 * np.pi * index / count
        center = CENTER + np.array([radius_m * np.cos(angle), radius_m * np.sin(angle), 0.5])
        rotation, translation = look_at(center, CENTER)
        tables[f"cam{index + 1}"] = {
            "name": f"cam{index + 1}",
            "size": [WIDTH, HEIGHT],
            "matrix": [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]],
            "distortions": [0.0, 0.0, 0.0, 0.0, 0.0],
            "rotation": cv2.Rodrigues(rotation)[0].ravel().tolist(),
            "translation": translation.tolist(),
            "fisheye": False,
        }
    return tables


def picture(camera: int, frame: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """Return an image of eight stripes, black or white: the bits of ``32 * camera + frame``. See :func:`read_tag`."""
    bits = [(32 * camera + frame) >> bit & 1 for bit in range(8)]
    row = np.repeat(np.array(bits, np.uint8) * 255, size[0] // 8)
    return np.ascontiguousarray(np.broadcast_to(row[None, :, None], (size[1], len(row), 3)))


def read_tag(image: np.ndarray) -> tuple[int, int]:
    """Return (camera, frame) of an image made by :func:`picture`, after lossy coding."""
    grey = image.mean(axis=(0, 2)).reshape(8, -1).mean(axis=1)
    return divmod(sum(1 << bit for bit in range(8) if grey[bit] > 127), 32)


def write_video(path: Path, pictures: list[np.ndarray], fps: float = 15.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    codec = "mp4v" if path.suffix in (".mp4", ".mov", ".mkv") else "MJPG"
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, (width, height))
    assert writer.isOpened()
    for image in pictures:
        writer.write(image)
    writer.release()


def write_picture(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_toml(path: Path, document: dict[str, Any]) -> None:
    path.write_text(tomli_w.dumps(document), encoding="utf-8")


MakeCapture = Callable[..., Path]


@pytest.fixture
def make_capture(tmp_path: Path) -> MakeCapture:
    """Return a function that writes a capture: ``make_capture(cameras=3, frames=12, settings={...} or None)``."""

    def make(cameras: int = 3, frames: int = 12, settings: dict[str, Any] | None = None, name: str = "cap") -> Path:
        folder = tmp_path / name
        folder.mkdir()
        write_toml(folder / "calibration.toml", calibration_tables(cameras))
        document = {"volume": {"center": CENTER.tolist(), "size": [1.0, 1.0, 1.0]}} if settings is None else settings
        if document:
            write_toml(folder / "capture.toml", document)
        for camera in range(cameras):
            fps = document.get("fps")  # the videos have the same, if it is a possible one
            rate = float(fps) if isinstance(fps, (int, float)) and 1 <= fps <= 1000 else 15.0
            video = folder / "videos" / f"cam{camera + 1}.mp4"
            write_video(video, [picture(camera, k) for k in range(frames)], rate)
        return folder

    return make
