"""Landmarks: whose they are, and when they contradict a pose."""

from __future__ import annotations

import numpy as np
import pytest

from tests.trackers.walker import BODY, walk
from tk.model.body.skeleton import JOINTS
from tk.model.cues.landmarks import LANDMARKS, ROWS, contradiction, of_person

JOINTS_M = BODY.skeleton.joints(walk(1)[0])
SWAPPED = np.arange(len(LANDMARKS)) ^ 1


def test_landmarks_are_joints_left_and_right_in_turn() -> None:
    assert [JOINTS[row] for row in ROWS] == list(LANDMARKS)
    assert [LANDMARKS[k].replace("_r", "_l") for k in SWAPPED] == [name.replace("_r", "_l") for name in LANDMARKS]


def test_the_nearest_person_is_chosen_and_nobody_far_away() -> None:
    here, beside = JOINTS_M[ROWS], JOINTS_M[ROWS] + [0.6, 0.0, 0.0]
    found = of_person(np.array([beside, here]), JOINTS_M)
    np.testing.assert_array_equal(found, here)
    assert of_person(beside[None], JOINTS_M) is None
    assert of_person(np.zeros((0, 12, 3)), JOINTS_M) is None


def test_a_person_of_whom_little_is_known_is_nobody() -> None:
    landmarks = JOINTS_M[ROWS].copy()
    landmarks[LANDMARKS.index("knee_l")] = np.nan
    assert of_person(landmarks[None], JOINTS_M) is not None
    landmarks[[LANDMARKS.index(name) for name in ("knee_r", "ankle_l")]] = np.nan
    assert of_person(landmarks[None], JOINTS_M) is None


@pytest.mark.parametrize("part", ["shoulder hip", "elbow wrist", "knee ankle"])
def test_exchanged_sides_contradict_whatever_the_other_parts_show(part: str) -> None:
    landmarks = JOINTS_M[ROWS] + np.random.default_rng(2).normal(0.0, 0.03, (12, 3))
    assert contradiction(landmarks, JOINTS_M) < 0.1
    rows = [k for k, name in enumerate(LANDMARKS) if name[:-2] in part.split()]
    landmarks[rows] = landmarks[SWAPPED[rows]]
    assert contradiction(landmarks, JOINTS_M) > 0.15
    both = contradiction(landmarks, np.stack([JOINTS_M, JOINTS_M + 1.0]))
    assert both.shape == (2,) and both[0] == contradiction(landmarks, JOINTS_M) and both[1] > 1.0
