"""The motion term of the solver over time."""

from __future__ import annotations

import numpy as np
import pytest

from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import build_skeleton
from tk.model.motion.coupling import MotionTerm
from tk.optim.trajectory import Equations

SKELETON = build_skeleton(BodyDimensions.from_stature(1.75))
D, YAW, ELBOW = len(SKELETON.names), SKELETON.index("torso_yaw"), SKELETON.index("elbow_l_flexion")
PRECISION = 0.01**-2.0  # of a pose that is seen


def moving(count: int, speed: float = 0.1, seed: int = 1) -> np.ndarray:
    """Return poses (F, D) at a constant speed, which changes by some hundredths at random."""
    changes = np.random.default_rng(seed).normal(scale=0.02, size=(count, D))
    return np.cumsum(np.cumsum(changes, axis=0) + speed, axis=0)


def smoothed(poses: np.ndarray, frames: np.ndarray, unseen: tuple[int, ...] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Return what poses become, and their standard deviations, if all rows but ``unseen`` are seen exactly there."""
    equations = Equations(len(poses), D, 0)
    precision = np.where(np.isin(np.arange(len(poses)), unseen), 1e-6, PRECISION)
    equations.hessian += precision[:, None, None] * np.eye(D)
    MotionTerm(SKELETON, poses, frames).add(equations, poses, frames)
    reduced = equations.reduced()
    return poses + reduced.plain, np.sqrt(np.einsum("fdd->fd", reduced.chain.covariance))


def test_steady_motion_stays() -> None:
    poses = np.outer(np.arange(9.0), np.full(D, 0.2))
    np.testing.assert_allclose(smoothed(poses, np.arange(9))[0], poses, atol=1e-9)


def test_an_unseen_frame_follows_its_neighbours_and_is_less_sure() -> None:
    poses = moving(40)
    wrong = poses.copy()
    wrong[20, ELBOW] += 0.3
    found, deviation = smoothed(wrong, np.arange(40), (20,))
    before, after = abs(wrong[20, ELBOW] - poses[20, ELBOW]), abs(found[20, ELBOW] - poses[20, ELBOW])
    assert after < 0.5 * before
    assert deviation[20, ELBOW] > 2 * deviation[[10, 30], ELBOW].max()


def test_a_sudden_movement_is_kept() -> None:
    """A kick of a frame: the term holds a pose that is seen back by a small share of the movement only."""
    poses = moving(60)
    poses[30, ELBOW] += 0.8
    found = smoothed(poses, np.arange(60))[0]
    assert found[30, ELBOW] - poses[30, ELBOW] == pytest.approx(0.0, abs=0.02 * 0.8)


def test_nothing_passes_a_cut_or_a_lost_frame() -> None:
    poses, frames = moving(60), np.arange(60)
    apart = poses.copy()
    apart[30:] += 3.0  # a cut: everything is elsewhere
    alone = smoothed(poses[:30], frames[:30])[0]
    cut = smoothed(apart, frames)[0][:30] - apart[:30]
    assert np.abs(cut).max() < 0.01
    gap = smoothed(apart, np.r_[frames[:30], frames[30:] + 1])[0]
    np.testing.assert_allclose(gap[:29], alone[:29], atol=0.01)
    # what comes after a lost frame changes nothing before it, beside the measured change of speed
    moved = apart.copy()
    moved[31:] += 0.5
    other = smoothed(moved, np.r_[frames[:30], frames[30:] + 1])[0]
    np.testing.assert_allclose(other[:30], gap[:30], atol=1e-3)


def test_angles_turn_the_shorter_way_and_places_do_not() -> None:
    poses = moving(20, speed=0.3)
    turned = poses.copy()
    turned[10:, YAW] += 2 * np.pi
    np.testing.assert_allclose(
        smoothed(turned, np.arange(20))[0] - turned, smoothed(poses, np.arange(20))[0] - poses, atol=1e-9
    )


@pytest.mark.parametrize("frames", [[0], [0, 1], [0, 2, 4, 6]])
def test_frames_that_show_no_change_of_speed_are_not_coupled(frames: list[int]) -> None:
    equations, poses = Equations(len(frames), D, 0), moving(len(frames))
    numbers = np.array(frames)
    MotionTerm(SKELETON, poses, numbers).add(equations, poses, numbers)
    assert equations.coupling is None and not equations.hessian.any()
