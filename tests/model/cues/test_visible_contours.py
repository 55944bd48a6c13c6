from __future__ import annotations

import numpy as np

from tests.model.figures import BODY
from tests.model.ring import ring_of_cameras
from tk.model.body.gait_poses import neutral_pose
from tk.model.body.skeleton import JOINTS, shoulder_angles
from tk.model.cues.ray_costs import Evidence, RayGrid
from tk.model.cues.visible_contours import contour_shares

RIG = ring_of_cameras(4, width=240, height=320)
GRID = RayGrid(RIG, 54)


def shares(left_arm: tuple[float, float, float]) -> np.ndarray:
    """(4, 15) shares of a standing person whose left arm points forward, outward, up."""
    skeleton = BODY.skeleton
    pose = neutral_pose(skeleton)
    pose[2] = 0.92
    for side, direction in (("l", left_arm), ("r", (0.0, 1.0, 0.0))):
        angles = shoulder_angles(np.array(direction) / np.linalg.norm(direction))
        pose[[skeleton.index(f"shoulder_{side}_{name}") for name in ("yaw", "pitch")]] = angles
    evidence = Evidence.of(GRID, np.full((4, *RIG.frame_shape), 255, np.uint8))
    _, met = evidence.cast(BODY, pose[None])
    assert met is not None
    return contour_shares(BODY, GRID, met.label[0], skeleton.joints(pose))


def test_stretched_arm_shows_its_contours_and_hidden_arm_does_not() -> None:
    elbow, wrist = JOINTS.index("elbow_l"), JOINTS.index("wrist_l")
    stretched, forward = shares((0.0, 1.0, 0.0)), shares((1.0, -0.6, -0.3))
    assert ((stretched >= 0) & (stretched <= 1)).all()
    assert np.sort(stretched[:, wrist])[-2] > 0.9
    assert forward[:, [elbow, wrist]].min() < 0.2 < 0.6 < forward[:, wrist].max()


def test_head_is_visible_from_all_sides() -> None:
    assert (shares((0.0, 1.0, 0.0))[:, JOINTS.index("head_top")] > 0.9).all()


def test_camera_shows_no_joint_behind_it() -> None:
    label = np.full(GRID.rays.shape[:3], 1, np.uint8)
    label[:, ::2] = 0
    behind = np.repeat(RIG.centers[:1] - 2 * RIG[0].rotation[2], len(JOINTS), axis=0)
    found = contour_shares(BODY, GRID, label, behind)
    assert not found[0].any() and np.isfinite(found).all()
