"""People who walk through a room, drawn as silhouettes into the masks of a ring of cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scripts.synthetic.capture import write_calibration
from tests.io.conftest import write_picture
from tests.model.figures import BODY
from tests.model.ring import ring_of_cameras
from tk.model.body.gait_poses import walking_pose

RIG = ring_of_cameras(4, 160, 120)


def stroll(x: np.ndarray, stride: int, y: np.ndarray | float = 0.0) -> np.ndarray:
    """Return poses (F, D) of the average body at places (F,) on the floor, metres, with strides of so many frames."""
    poses = np.array([walking_pose(BODY.skeleton, i / stride % 1) for i in range(len(x))])
    poses[:, 0], poses[:, 1], poses[:, 2] = x, y, 0.95
    return poses


def write_masks(folder: Path, masks: np.ndarray) -> None:
    """Write a capture of grey images with masks (F, C, H, W)."""
    for frame, own in enumerate(masks):
        for camera, mask in zip(RIG, own, strict=True):
            write_picture(folder / "images" / camera.name / f"{frame:06d}.png", np.full((*mask.shape, 3), 90, np.uint8))
            write_picture(folder / "masks" / camera.name / f"{frame:06d}.png", mask)
    write_calibration(RIG, folder / "calibration.toml")
    volume = "[volume]\ncenter = [0.0, 0.0, 1.0]\nsize = [2.6, 2.6, 2.4]\n"
    (folder / "capture.toml").write_text(f"fps = 15.0\n{volume}")
