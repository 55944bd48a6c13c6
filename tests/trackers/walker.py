"""Somebody who walks on the spot, and what the tests of both trackers of contours ask of him."""

from __future__ import annotations

import numpy as np

from tests.model.figures import draw_silhouettes
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.body.gait_poses import walking_pose
from tk.model.cameras.camera import Rig
from tk.trackers.contour_tracker import ContourTracker
from tk.trackers.protocol import Estimate, Frame

STATURE = 1.75
BODY = build_cone_body(BodyDimensions.from_stature(STATURE))
NAMES = BODY.skeleton.names
EMPTY = np.zeros((0,), np.uint8)


def walk(count: int, first: float = 0.0) -> np.ndarray:
    """(count, D) a stride at 30 Hz, on the spot."""
    poses = np.array([walking_pose(BODY.skeleton, first + i / 34) for i in range(count)])
    poses[:, :3] = [0.05, -0.04, 0.93]
    poses[:, NAMES.index("torso_yaw")] = 0.7
    return poses


def observe(masks: np.ndarray, index: int = 0, images: np.ndarray = EMPTY) -> Frame:
    return Frame(index, images, masks)


def errors(estimate: Estimate, pose: np.ndarray) -> np.ndarray:
    """(15,) metres."""
    return np.linalg.norm(estimate.joints - BODY.skeleton.joints(pose), axis=1)


def find_again_elsewhere(tracker: ContourTracker, rig: Rig, poses: np.ndarray, close_m: float) -> None:
    """Whoever was at the first of the poses (N, D) goes, and comes back half a metre away, turned by 2 rad."""
    here = draw_silhouettes(BODY, rig, poses[:1])[0]
    tracker.step(observe(here))
    tracker.step(observe(np.zeros_like(here), 1))
    away = poses.copy()
    away[:, 0] += 0.45
    away[:, NAMES.index("torso_yaw")] += 2.0
    estimates = [tracker.step(observe(m, i)) for i, m in enumerate(draw_silhouettes(BODY, rig, away), 2)]
    assert "recovered" in [e.status for e in estimates]
    assert estimates[-1].status in ("recovered", "tracked")
    assert errors(estimates[-1], away[-1]).mean() < close_m
