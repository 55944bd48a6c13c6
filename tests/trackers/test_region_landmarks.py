"""The region tracker with landmarks, on silhouettes rendered from its own body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.model.figures import draw_silhouettes
from tests.model.landmarks import landmarks_of
from tests.trackers.test_region import (
    CLOSE_M,
    MASKS,
    POSES,
    RIG,
    SETTINGS,
    SKELETON,
    tracker_at,
    with_arm,
)
from tests.trackers.walker import BODY, NAMES, errors, observe
from tk.kernels.silhouette import normal_equations
from tk.model.body.limb_candidates import exchanged_limbs, pairs, turned
from tk.model.body.skeleton import JOINTS
from tk.model.cues.cue import CONTOUR_INFORMATION
from tk.model.cues.landmarks import NAME, LandmarkCue
from tk.model.cues.landmarks import points as landmark_places
from tk.trackers.headings import both_headings, trajectory_cost, turned_pose
from tk.trackers.second_pass import NEAR_DEG


def seen_at(pose: np.ndarray, noise_m: float = 0.03) -> np.ndarray:
    """The landmarks (1, C, L, 3) of a network that is some centimetres off."""
    return landmarks_of(RIG, BODY, pose, noise_m)[None]


@pytest.mark.parametrize("wrong", ["turned", "legs"])
def test_landmarks_correct_left_and_right(wrong: str) -> None:
    """Silhouettes alone keep a person who was tracked back to front, or with exchanged legs."""
    pose = POSES[2]
    tracker = tracker_at(pose)
    mistaken = turned(pose, tracker.limbs) if wrong == "turned" else exchanged_limbs(pose, pairs(tracker.limbs))[1]
    for landmarks, right in ((None, False), (seen_at(pose), True)):
        tracker.start_at(mistaken)
        found = tracker.step(replace(observe(MASKS[2], 0), landmarks=landmarks))
        assert (errors(found, pose).max() < 2 * CLOSE_M) == right


def test_landmarks_pull_a_limb_that_silhouettes_do_not_show() -> None:
    """The forearm lies in front of the trunk in all images: only the landmarks show the hand."""
    pose = with_arm(POSES[0], "l", (0.6, 0.1, -1.0), 60.0)
    masks = draw_silhouettes(BODY, RIG, pose[None])[0]
    tracker = tracker_at(pose, masks)
    other = pose.copy()
    other[NAMES.index("elbow_l_flexion")] += np.radians(15)
    pull = {}
    for name, landmarks in (("none", None), ("right", seen_at(pose, 0.0)), ("other", seen_at(other, 0.0))):
        pyramid = tracker.pyramid(replace(observe(masks), landmarks=landmarks))
        start = tracker.world.poses_in(pose[None])
        pull[name] = tracker.settle(pyramid, start).states[0, NAMES.index("elbow_l_flexion")]
    assert abs(pull["right"] - pose[NAMES.index("elbow_l_flexion")]) < np.radians(6)
    assert pull["other"] > pull["right"] + np.radians(2)


def test_landmarks_turn_the_head_and_not_the_trunk() -> None:
    """The head stays turned in frames without landmarks; if there are none at all, it is straight."""
    turn, yaw = NAMES.index("neck_roll"), NAMES.index("torso_yaw")
    pose = POSES[0].copy()
    pose[turn] = np.radians(45.0)
    masks = draw_silhouettes(BODY, RIG, pose[None])[0]
    tracker, blind = tracker_at(POSES[0], masks), tracker_at(POSES[0], masks)
    found = [tracker.step(replace(observe(masks, i), landmarks=seen_at(pose, 0.01))).pose for i in range(2)]
    assert found[-1][turn] == pytest.approx(pose[turn], abs=np.radians(8))
    assert np.cos(found[-1][yaw] - pose[yaw]) > np.cos(np.radians(3))
    held = [tracker.step(observe(masks, i)).pose[turn] for i in range(2, 4)]
    np.testing.assert_allclose(held, found[-1][turn], atol=np.radians(3))
    assert blind.step(observe(masks)).pose[turn] == 0.0


def test_landmarks_that_nobody_is_seen_with_change_nothing() -> None:
    unseen = np.full_like(seen_at(POSES[0]), np.nan)
    elsewhere = POSES[0].copy()
    elsewhere[:2] += 1.2
    found = [
        tracker_at(POSES[0]).step(replace(observe(MASKS[0], 0), landmarks=landmarks))
        for landmarks in (None, unseen, seen_at(elsewhere), np.concatenate([unseen, unseen]))
    ]
    for other in found[1:]:
        np.testing.assert_array_equal(other.pose, found[0].pose)
        assert other.landmarks is None


@pytest.mark.parametrize("k", [0, 3])
def test_landmarks_that_the_silhouettes_deny_enlarge_sigma_and_do_not_move_the_arms(k: int) -> None:
    raised = with_arm(with_arm(POSES[k], "l", (0, 0.2, 1), 0.0), "r", (0, 0.2, 1), 0.0)
    plain, denied = (
        tracker_at(POSES[k]).step(replace(observe(MASKS[k], 0), landmarks=landmarks))
        for landmarks in (seen_at(POSES[k]), seen_at(raised))
    )
    assert errors(denied, POSES[k]).max() < 2 * CLOSE_M
    assert plain.sigma is not None and denied.sigma is not None
    for wrist in ("wrist_l", "wrist_r"):
        assert denied.sigma[JOINTS.index(wrist)] > 0.1 > plain.sigma[JOINTS.index(wrist)]


def test_for_sigma_landmarks_count_once_and_contours_not_along_themselves() -> None:
    """With displaced contours as unknowns; in a step landmarks have a weight in place of these."""
    tracker = tracker_at(POSES[0])
    pose = tracker.world.poses_in(POSES[:1])
    prior = tracker.prior(pose, NEAR_DEG)
    alone, marked = (
        tracker.pyramid(replace(observe(MASKS[0]), landmarks=landmarks)) for landmarks in (None, seen_at(POSES[0]))
    )
    cue = LandmarkCue(tracker.views.rig, tracker.body, marked.measured[NAME]).normal(pose).matrix
    for view_m, weight in ((0.0, LandmarkCue.weight), (0.003, 1.0)):
        by_landmarks = np.subtract(*(tracker.equations(seen, pose, prior, view_m)[0] for seen in (marked, alone)))
        np.testing.assert_allclose(by_landmarks, weight * cue, rtol=0, atol=1e-6 * weight * np.abs(cue).max())
    across = replace(tracker.line_search, tangential=0.0)
    contours = normal_equations(tracker.body.arrays, tracker.views.at(alone, 0), pose, across).hessian
    firm = tracker.equations(alone, pose, prior, 1e-7)[0] - CONTOUR_INFORMATION * prior.matrix
    np.testing.assert_allclose(firm, CONTOUR_INFORMATION * contours, rtol=0, atol=1e-4 * np.abs(firm).max())


def test_estimate_has_the_landmarks_of_its_person() -> None:
    beside = POSES[0].copy()
    beside[:2] += 0.6
    people = np.concatenate([seen_at(beside), seen_at(POSES[0])])
    found = tracker_at(POSES[0]).step(replace(observe(MASKS[0], 0), landmarks=people))
    np.testing.assert_array_equal(found.landmarks, people[1])


def test_second_pass_ignores_landmarks_of_excluded_cameras() -> None:
    tracker, residual = tracker_at(POSES[0]), np.zeros((3, 3, 2))
    residual[:, 2] = np.nan
    wrong = np.stack([exchanged_limbs(pose, pairs(tracker.limbs))[1] for pose in POSES[:3]])
    spoilt = np.stack([seen_at(pose)[0] for pose in POSES[:3]])
    spoilt[:, 2, :, :2] += 20.0
    plain = spoilt.copy()
    plain[:, 2] = np.nan
    lost = np.zeros(3, bool)
    found, same = (
        tracker.second_pass(MASKS[:3], wrong, lost, residual, None, {NAME: landmarks}, keep_body=True)[0]
        for landmarks in (spoilt, plain)
    )
    np.testing.assert_array_equal(found, same)


def test_second_pass_interpolates_the_turn_of_the_head_between_frames_with_landmarks() -> None:
    turn, first = NAMES.index("neck_roll"), POSES.copy()
    first[:, turn] = np.radians([0, 0, 0, 30, 30, 30])  # the first pass keeps the last turn
    landmarks = np.full((6, *seen_at(POSES[0])[0].shape), np.nan)
    for i in (1, 4):
        landmarks[i] = seen_at(first[i], 0.01)[0]
    tracker, marked = tracker_at(POSES[0]), {NAME: landmarks}
    poses, _, _ = tracker.second_pass(
        MASKS, first, np.zeros(6, bool), np.zeros((6, 3, 2)), None, marked, keep_body=True
    )
    found = np.degrees(poses[:, turn])
    np.testing.assert_allclose(found[[1, 4]], [0, 30], atol=8)
    np.testing.assert_allclose(found, np.interp(range(6), [1, 4], found[[1, 4]]), atol=1e-9)


def test_second_pass_corrects_legs_by_landmarks_of_all_cameras() -> None:
    """Legs that are exchanged in all frames: no other frame shows them right."""
    tracker = tracker_at(POSES[0], settings=replace(SETTINGS, search_every=0.1))
    wrong = np.stack([exchanged_limbs(pose, pairs(tracker.limbs))[1] for pose in POSES])
    marked = {NAME: np.stack([seen_at(pose)[0] for pose in POSES])}
    found, _, _ = tracker.second_pass(
        MASKS, wrong, np.zeros(6, bool), np.zeros((6, 3, 2)), None, marked, keep_body=True
    )
    off = np.linalg.norm(SKELETON.joints(found) - SKELETON.joints(POSES), axis=2).max(axis=1)
    assert (off < 3 * CLOSE_M).all()


def test_landmarks_decide_about_the_opposite_heading() -> None:
    """The masks show the person in both headings."""
    tracker = tracker_at(POSES[0])
    turned = turned_pose(tracker, POSES[0])
    masks = draw_silhouettes(BODY, RIG, np.stack([POSES[0], turned])).max(axis=0)
    assert len(both_headings(tracker, [masks], POSES[:1], None, {})) == 2
    assert both_headings(tracker, [masks], POSES[:1], None, {NAME: seen_at(POSES[0])}) == ()
    both = [trajectory_cost(tracker, [masks], pose[None], {NAME: seen_at(turned)}) for pose in (POSES[0], turned)]
    assert both[1] < both[0] - 10.0


class Network:
    """Answers with the landmarks of a pose, and counts how often it is asked."""

    def __init__(self, pose: np.ndarray) -> None:
        self.pose, self.asked = pose, 0
        self.expected = np.empty(0)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        self.asked, self.expected = self.asked + 1, points
        return seen_at(self.pose, 0.01)[0]


def test_network_is_asked_where_the_frame_leaves_a_limb_open() -> None:
    """The left arm is in front of the trunk in most images, where silhouettes fit other poses of it as well."""
    pose, wrist = with_arm(POSES[0], "l", (0.8, -0.2, -0.6), 70.0), JOINTS.index("wrist_l")
    masks = draw_silhouettes(BODY, RIG, pose[None])[0]
    network, found = Network(pose), {}
    for name, ask in (("silhouettes", None), ("network", network)):
        tracker = tracker_at(pose, masks, settings=replace(SETTINGS, search_every=0.2))
        found[name] = [tracker.step(replace(observe(masks, i), ask=ask)) for i in range(3)]
    assert network.asked == 1  # where the limbs are searched for
    shown = landmark_places(BODY, pose)
    assert np.linalg.norm(network.expected - shown, axis=1).max() < CLOSE_M
    before, after = (found[name][0].deviation for name in ("silhouettes", "network"))
    assert before is not None and after is not None and after[wrist] < before[wrist] / 4
    assert [e.landmarks is None for e in found["network"]] == [False, True, True]


def test_network_is_not_asked_where_the_frame_shows_all_limbs() -> None:
    """The silhouettes show both arms and both legs."""
    pose = with_arm(with_arm(POSES[0], "l", (0.0, 1.0, 0.0), 5.0), "r", (0.0, 1.0, 0.0), 5.0)
    masks, network = draw_silhouettes(BODY, RIG, pose[None])[0], Network(pose)
    tracker = tracker_at(pose, masks, settings=replace(SETTINGS, search_every=0.2))
    tracker.step(observe(masks, 0))
    found = [tracker.step(replace(observe(masks, i), ask=network)) for i in range(1, 4)]
    assert [int(e.iterations[1]) for e in found] == [0, 0, 1]  # the limbs were searched for
    assert network.asked == 0


def test_answer_about_somebody_else_is_not_used() -> None:
    pose = with_arm(POSES[0], "l", (0.8, -0.2, -0.6), 70.0)
    masks, elsewhere = draw_silhouettes(BODY, RIG, pose[None])[0], pose.copy()
    elsewhere[0] += 2.0
    tracker, other = (tracker_at(pose, masks, settings=replace(SETTINGS, search_every=0.2)) for _ in range(2))
    network = Network(elsewhere)
    found = tracker.step(replace(observe(masks, 0), ask=network))
    assert network.asked == 1 and found.landmarks is None
    np.testing.assert_array_equal(found.pose, other.step(observe(masks, 0)).pose)
