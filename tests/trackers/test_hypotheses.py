"""Poses that are tracked side by side."""

from __future__ import annotations

import numpy as np
import pytest

from tests.trackers.walker import BODY, NAMES, walk
from tk.model.body.skeleton import JOINTS
from tk.trackers.hypotheses import RENEWAL, Hypothesis, disagreement, renewed

SKELETON = BODY.skeleton


@pytest.mark.parametrize("level", [-50.0, 0.0, 50.0])
def test_what_a_frame_shows_of_all_poses_decides_between_none(level: float) -> None:
    """A frame that all poses explain better or worse leaves the differences of their running means as they are."""
    poses = walk(2)
    alive = [Hypothesis(poses[0], poses[0], 50.0), Hypothesis(poses[1], poses[0], 53.0)]
    after = renewed(alive, poses, level + np.array([50.0, 53.0]))
    assert after[1].cost - after[0].cost == pytest.approx(3.0)
    likelier = renewed(alive, poses, level + np.array([53.0, 50.0]))
    assert likelier[1].cost - likelier[0].cost == pytest.approx(3.0 - 6.0 * RENEWAL)


def test_disagreement_is_the_expected_square_of_the_error_of_the_likeliest_pose() -> None:
    poses = np.repeat(walk(1), 2, axis=0)
    poses[1, NAMES.index("elbow_l_flexion")] += 1.0
    away = np.linalg.norm(np.subtract(*SKELETON.joints(poses)), axis=-1)
    for share in (0.5, 0.9):
        cost = -np.log([share, 1.0 - share])
        np.testing.assert_allclose(disagreement(SKELETON, poses, cost), (1.0 - share) * away**2 / 3, atol=1e-12)
    assert disagreement(SKELETON, poses, cost)[JOINTS.index("wrist_l")] > 0
