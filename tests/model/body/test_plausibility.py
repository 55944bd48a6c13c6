"""What cannot be true of a person."""

from __future__ import annotations

import numpy as np
import pytest

from tk.errors import CaptureError
from tk.model.body import gait_poses as gait
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.plausibility import Plausibility, check_extent, check_stature
from tk.model.body.skeleton import build_skeleton

SKELETON = build_skeleton(BodyDimensions.from_stature(1.75), "z")


def joints(x: float = 0.0, z: float = 0.95, yaw_deg: float = 0.0, phase: float = 0.0) -> np.ndarray:
    pose = gait.walking_pose(SKELETON, phase % 1)
    pose[:3] = x, 0.0, z
    pose[SKELETON.index("torso_yaw")] = np.radians(yaw_deg)
    return SKELETON.joints(pose)


def test_walking_turning_jumping_and_sprinting_are_possible() -> None:
    judge = Plausibility(15.0)
    for i in range(30):
        height = 0.95 + 0.5 * max(0.0, np.sin(i / 3))
        assert judge.judge(i, joints(0.5 * i, height, 40.0 * i, i / 10)) is None, i


@pytest.mark.parametrize(
    ("then", "reason"), [(joints(x=3.0), "JUMPS"), (joints() * np.nan, "NO_NUMBERS")], ids=["a jump", "NaN"]
)
def test_impossible_pose_has_a_reason(then: np.ndarray, reason: str) -> None:
    judge = Plausibility(15.0)
    assert judge.judge(0, joints()) is None
    told = judge.judge(1, then)
    assert told == reason
    assert judge.judge(2, joints()) is None, "it was the estimate that was wrong, not what came before"


def test_after_a_loss_the_person_may_be_anywhere() -> None:
    judge = Plausibility(60.0)
    judge.judge(0, joints())
    judge.forget()
    assert judge.judge(1, joints(x=5.0)) is None


def test_state_is_restored() -> None:
    judge, again = Plausibility(15.0), Plausibility(15.0)
    judge.judge(4, joints())
    again.state = judge.state
    for told in (joints(x=3.0), joints(x=0.1)):
        assert again.judge(5, told) == judge.judge(5, told)


def test_impossible_sizes_are_refused() -> None:
    for stature in (1.05, 1.5, 2.2):
        check_stature(stature)
    for stature in (0.9, 2.4):
        with pytest.raises(CaptureError, match=r"measures .* scale of calibration.toml .* \[subject\] height"):
            check_stature(stature)
    for extent in (1.1, 1.75, 2.4, float("nan")):
        check_extent(extent, 1.75)
    for extent in (0.9, 3.0):
        with pytest.raises(CaptureError, match=r"measures .* capture.toml says 1.75 m"):
            check_extent(extent, 1.75)
