"""Landmarks as a term of the cost: derivatives, the choice between poses, whose landmarks they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.model.figures import draw_silhouettes
from tests.model.landmarks import body_points, landmarks_of, mirrored
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, NAMES, STATURE, walk
from tk.kernels.mask_values import OTHERS
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.body_points import POINTS
from tk.model.body.cone_body import build_cone_body
from tk.model.body.limb_candidates import limbs_of, turned
from tk.model.body.skeleton import JOINTS
from tk.model.cameras.camera import Camera, Rig
from tk.model.cues.landmarks import (
    DEPTH_M,
    DEPTH_SHARE,
    EXCHANGED,
    INDEPENDENT,
    LANDMARKS,
    OFFSET_M,
    SEEN_M,
    LandmarkCue,
    of_person,
    propose,
)
from tk.model.setup import AVERAGE_STATURE_M

RIG = ring_of_cameras(4, 160, 200)
POSE = walk(9)[8]
SEEN = landmarks_of(RIG, BODY, POSE)
NOISY = landmarks_of(RIG, BODY, POSE, 0.03)
TURNED = turned(POSE, limbs_of(BODY))


def far(pose: np.ndarray) -> float:
    """Largest distance of a pose's joints from those of :data:`POSE`, metres."""
    return float(np.linalg.norm(BODY.skeleton.joints(pose) - BODY.skeleton.joints(POSE), axis=1).max())


# --- the normal equations -----------------------------------------------------------------------------------------


def marginal_cost(pose: np.ndarray, seen: np.ndarray) -> float:
    """Negative logarithm of the density of certain landmarks whose offsets are integrated out, nats."""
    points, size = body_points(BODY, pose), STATURE / AVERAGE_STATURE_M
    rows, away = [], []
    for v, camera in enumerate(RIG):
        q = camera.to_camera(points)
        away.append(camera.undistort(seen[v, :, :2]) * q[:, 2:] - q[:, :2])
        rows.append(camera.rotation[:2] - (q[:, :2] / q[:, 2:])[..., None] * camera.rotation[2])
    P, r = np.concatenate(rows, axis=1), np.concatenate(away, axis=1)  # (L, 2 V, 3), (L, 2 V)
    covariance = size**2 * (SEEN_M**2 * np.eye(r.shape[1]) + OFFSET_M**2 * P @ P.swapaxes(1, 2))
    cost = (r * np.linalg.solve(covariance, r[..., None])[..., 0]).sum()
    for bone in BONES if np.isfinite(seen[..., 3]).all() else ():
        start, end = (LANDMARKS.index(name) for name in bone)
        A = np.array([sight(camera, seen[v]) for v, camera in enumerate(RIG)])  # (V, 3)
        share = DEPTH_SHARE[bone[0].endswith("_l") == bone[1].endswith("_l")]
        r = size * (seen[:, end, 3] - seen[:, start, 3]) - share * A @ (points[end] - points[start])
        cost += r @ np.linalg.solve(size**2 * (DEPTH_M**2 * np.eye(len(r)) + 2 * (share * OFFSET_M) ** 2 * A @ A.T), r)
    return float(0.5 * INDEPENDENT * cost)


BONES = [("shoulder_l", "shoulder_r"), ("hip_l", "hip_r")] + [
    (a + side, b + side)
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
    for side in ("_l", "_r")
]


def sight(camera: Camera, seen: np.ndarray) -> np.ndarray:
    """Direction from a camera to the middle of a person's landmarks (L, 4)."""
    ray = np.append(camera.undistort(seen[:, :2]).mean(axis=0), 1.0)
    return np.asarray(camera.rotation.T @ ray / np.linalg.norm(ray))


@pytest.mark.parametrize("with_depth", [False, True])
def test_gradient_is_that_of_the_cost_with_offsets_integrated_out(with_depth: bool) -> None:
    seen = landmarks_of(RIG, BODY, POSE, 0.002, visibility=1.0, with_depth=with_depth)
    near = POSE + np.random.default_rng(2).normal(0.0, 0.003, len(POSE))
    found = LandmarkCue(RIG, BODY, seen).normal(near[None])
    gradient = found.matrix[0] @ near - found.linear[0]
    step = 1e-5 * np.eye(len(POSE))
    expected = [(marginal_cost(near + row, seen) - marginal_cost(near - row, seen)) / 2e-5 for row in step]
    np.testing.assert_allclose(gradient, expected, atol=0.02 * np.abs(expected).max())


def test_score_is_that_with_offsets_integrated_out() -> None:
    """Of landmarks that are right; those far off in one image are not explained by an offset."""
    seen = landmarks_of(RIG, BODY, POSE, 0.01, visibility=1.0, with_depth=False)
    near = POSE + np.random.default_rng(2).normal(0.0, 0.01, len(POSE))
    poses = np.stack([POSE, near])
    cost, turns = LandmarkCue(RIG, BODY, seen).cost(poses), BODY.skeleton.by_landmarks
    cost -= 0.5 * (turns**-2.0 * poses**2).sum(axis=1)
    expected = marginal_cost(near, seen) - marginal_cost(POSE, seen)
    assert cost[1] - cost[0] == pytest.approx(expected, rel=0.1)


def test_landmark_far_off_in_one_image_counts_as_much_as_if_the_image_were_alone() -> None:
    """The offset is that of all images, so it cannot explain what one of them shows."""
    cost = []
    for views in ([0], [0, 1, 2, 3]):
        rig, seen = Rig(tuple(RIG[v] for v in views)), SEEN[views].copy()
        right = LandmarkCue(rig, BODY, seen).cost(POSE[None])[0]
        seen[0, LANDMARKS.index("wrist_l"), :2] += 40.0  # pixels, over a metre
        cost.append(LandmarkCue(rig, BODY, seen).cost(POSE[None])[0] - right)
    assert cost[1] == pytest.approx(cost[0], rel=0.3)


def test_depth_shows_whether_a_forearm_points_at_the_camera_or_away_from_it() -> None:
    """Two poses of an arm that look alike in the only image."""
    arm = [k for k, name in enumerate(NAMES) if name.startswith(("shoulder_l", "elbow_l"))]
    poses = np.tile(POSE, (2000, 1))
    poses[:, arm] += np.random.default_rng(5).uniform(-1.5, 1.5, (len(poses), len(arm)))
    points = BODY.skeleton.joints(BODY.skeleton.clip(poses))
    elbow, wrist = points[:, JOINTS.index("elbow_l")], points[:, JOINTS.index("wrist_l")]
    pixels = np.concatenate([RIG[0].project(elbow)[0], RIG[0].project(wrist)[0]], axis=1)
    depth = (wrist - elbow) @ RIG[0].rotation[2]
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    apart[np.abs(depth[:, None] - depth[None]) < 0.3] = np.inf
    pair = np.unravel_index(np.argmin(apart), apart.shape)
    both = BODY.skeleton.clip(poses)[list(pair)]
    for with_depth in (False, True):
        for right in (0, 1):
            seen = landmarks_of(RIG, BODY, both[right], with_depth=with_depth)
            seen[1:] = np.nan
            right_cost, other_cost = LandmarkCue(RIG, BODY, seen).cost(both)[[right, 1 - right]]
            assert (other_cost - right_cost > 1.5) == with_depth


def test_unknown_depth_changes_nothing_and_depth_moves_left_and_right_with_the_landmarks() -> None:
    seen = landmarks_of(RIG, BODY, POSE, 0.01, with_depth=True)
    exchanged, pose = mirrored(seen), POSE[None]
    own, other = (LandmarkCue(RIG, BODY, each).cost(pose)[0] for each in (seen, exchanged))
    # an exchange in all images costs its probability, and no more
    assert other - own < INDEPENDENT * 2 * len(RIG) * np.log((1 - EXCHANGED) / EXCHANGED) + 1e-6
    seen[..., 3] = np.nan
    rows = LandmarkCue(RIG, BODY, seen).rows(pose)
    assert not rows.information[..., len(LANDMARKS) :].any() and not rows.pull[..., len(LANDMARKS) :].any()


def test_head_turns_to_where_the_face_is_seen_and_is_straight_without_it() -> None:
    turn, pose = NAMES.index("neck_roll"), POSE.copy()
    pose[turn] = np.radians(50.0)
    seen = landmarks_of(RIG, BODY, pose, 0.01)
    assert propose(RIG, BODY, seen, POSE[:3])[0][turn] == pytest.approx(pose[turn], abs=np.radians(10))
    seen[:, [POINTS[name].segment == "head" for name in LANDMARKS]] = np.nan
    cue, precision = LandmarkCue(RIG, BODY, seen), BODY.skeleton.by_landmarks[turn] ** -2.0
    matrix = cue.normal(pose[None]).matrix[0, turn]
    np.testing.assert_array_equal(matrix, precision * (np.arange(len(pose)) == turn))
    straight, turned_head = cue.cost(np.stack([POSE, pose]))
    assert turned_head - straight == pytest.approx(0.5 * precision * pose[turn] ** 2)
    assert propose(RIG, BODY, seen, POSE[:3])[0][turn] == pytest.approx(0.0, abs=1e-3)


def test_matrix_is_symmetric_and_positive_semi_definite_even_of_wrong_landmarks() -> None:
    poses = walk(3) + np.random.default_rng(3).normal(0.0, 0.2, (3, len(POSE)))
    found = LandmarkCue(RIG, BODY, NOISY).normal(poses)
    assert found.linear.shape == poses.shape
    np.testing.assert_allclose(found.matrix, found.matrix.swapaxes(1, 2), rtol=1e-9, atol=1e-6)
    assert (np.linalg.eigvalsh(found.matrix) > -1e-6 * np.abs(found.matrix).max()).all()


def test_landmarks_of_several_frames_are_compared_with_their_own_poses() -> None:
    poses = walk(2)
    seen = np.stack([landmarks_of(RIG, BODY, pose, 0.02) for pose in poses])
    seen[1, 2] = np.nan
    both = LandmarkCue(RIG, BODY, seen)
    for k, pose in enumerate(poses):
        alone = LandmarkCue(RIG, BODY, seen[k])
        np.testing.assert_allclose(both.cost(poses)[k], alone.cost(pose[None])[0])
        for one, other in zip(both.normal(poses), alone.normal(pose[None]), strict=True):
            np.testing.assert_allclose(one[k], other[0], rtol=1e-9, atol=1e-6)
        raised = poses + 0.5 * (np.arange(poses.shape[1]) == NAMES.index("elbow_l_flexion"))
        assert both.variance(raised)[k].any()
        np.testing.assert_allclose(both.variance(raised)[k], alone.variance(raised[k][None])[0], rtol=1e-9)


def test_unknown_landmarks_say_nothing() -> None:
    nothing = LandmarkCue(RIG, BODY, np.full(SEEN.shape, np.nan))
    found = nothing.normal(POSE[None])
    assert not found.matrix.any() and not found.linear.any()
    assert np.ptp(nothing.cost(np.stack([POSE, TURNED]))) == 0.0


# --- the choice between poses -------------------------------------------------------------------------------------


def test_score_is_lowest_at_the_true_pose() -> None:
    rng = np.random.default_rng(4)
    others = POSE + rng.choice([-0.15, 0.15], (40, len(POSE)))
    score = LandmarkCue(RIG, BODY, NOISY).cost(np.concatenate([POSE[None], others]))
    assert (score[0] < score[1:] - 5.0).all()


@pytest.mark.parametrize("views", [[0, 1], [0, 1, 2, 3]])
def test_true_heading_is_preferred_to_the_opposite_one(views: list[int]) -> None:
    seen = NOISY.copy()
    seen[[v for v in range(len(RIG)) if v not in views]] = np.nan
    score = LandmarkCue(RIG, BODY, seen).cost(np.stack([POSE, TURNED]))
    assert score[1] - score[0] > 5.0


def test_exchanged_sides_in_one_image_cost_no_more_than_their_prior() -> None:
    poses = np.stack([POSE, TURNED])
    spoilt = NOISY.copy()
    spoilt[1] = mirrored(NOISY[1])
    right, wrong = (LandmarkCue(RIG, BODY, seen).cost(poses) for seen in (NOISY, spoilt))
    assert 0 < wrong[0] - right[0] <= 2 * INDEPENDENT * np.log((1 - EXCHANGED) / EXCHANGED) + 0.01
    assert wrong[1] - wrong[0] > 5.0  # the other images show the heading


@pytest.mark.parametrize("half", ["upper", "lower"])
def test_one_half_is_exchanged_without_the_other(half: str) -> None:
    spoilt = NOISY.copy()
    spoilt[1] = mirrored(NOISY[1], lower=half == "lower", upper=half == "upper")
    right, wrong = (LandmarkCue(RIG, BODY, seen).cost(POSE[None])[0] for seen in (NOISY, spoilt))
    assert 0 < wrong - right <= INDEPENDENT * np.log((1 - EXCHANGED) / EXCHANGED) + 0.01


def test_image_that_shows_somebody_else_has_bounded_cost_and_no_pull() -> None:
    scores, pulls = [], []
    for away_m in (0.5, 1.0, 5.0):
        spoilt = NOISY.copy()
        beside = POSE.copy()
        beside[:2] += away_m
        spoilt[0] = landmarks_of(RIG, BODY, beside)[0]
        found = LandmarkCue(RIG, BODY, spoilt)
        scores.append(found.cost(POSE[None])[0])
        pulls.append(found.normal(POSE[None]))
        settled = found.cost(np.stack([POSE, beside]))
        assert settled[0] < settled[1]
    assert scores[2] - scores[0] < 1.0
    without = NOISY.copy()
    without[0] = np.nan
    expected = LandmarkCue(RIG, BODY, without).normal(POSE[None])
    np.testing.assert_allclose(pulls[2].matrix, expected.matrix, atol=0.2 * np.abs(expected.matrix).max())


def test_hidden_landmarks_count_less() -> None:
    clear, hidden = (
        LandmarkCue(RIG, BODY, landmarks_of(RIG, BODY, POSE, visibility=visibility)).normal(POSE[None]).matrix[0]
        for visibility in (1.0, 0.1)
    )
    assert np.trace(hidden) < 0.3 * np.trace(clear)


# --- proposals and contradictions ---------------------------------------------------------------------------------


@pytest.mark.parametrize("heading", ["true", "turned"])
def test_pose_of_the_landmarks_is_proposed(heading: str) -> None:
    pose = POSE if heading == "true" else TURNED
    found = propose(RIG, BODY, landmarks_of(RIG, BODY, pose, 0.02), pose[:3] + 0.2)[0]
    assert np.linalg.norm(BODY.skeleton.joints(found) - BODY.skeleton.joints(pose), axis=1).mean() < 0.05


def test_proposed_poses_are_sorted_and_ignore_an_image_that_shows_somebody_else() -> None:
    seen = landmarks_of(RIG, BODY, POSE, 0.02)
    seen[0, :, :2] += 80.0
    found = propose(RIG, BODY, seen, POSE[:3])
    assert np.linalg.norm(BODY.skeleton.joints(found[0]) - BODY.skeleton.joints(POSE), axis=1).mean() < 0.06
    scores = LandmarkCue(RIG, BODY, seen).cost(found)
    assert (np.diff(scores) >= 0).all()


@pytest.mark.parametrize("size", [0.85, 1.0, 1.15])
def test_landmarks_of_a_seated_person_propose_a_seated_pose(size: float) -> None:
    """Of a body that is too small or too large, too: its errors are a tenth of a metre, and many landmarks are wrong
    for it at first."""
    seated = POSE.copy()
    for side in ("l", "r"):
        seated[NAMES.index(f"hip_{side}_pitch")], seated[NAMES.index(f"knee_{side}_flexion")] = -1.8, 2.2
    body = build_cone_body(BodyDimensions.from_stature(size * STATURE))
    for seed in range(3):
        seen = landmarks_of(RIG, BODY, seated, 0.02, seed=seed)
        found = propose(RIG, body, seen, POSE[:3])[0]
        away = np.linalg.norm(body.skeleton.joints(found) - BODY.skeleton.joints(seated), axis=1)
        assert away.mean() < 0.02 + 0.25 * abs(size - 1.0)


def test_contradicted_joints_get_variance_and_others_none() -> None:
    assert LandmarkCue(RIG, BODY, NOISY).variance(POSE[None])[0].max() < 0.03**2
    raised = POSE.copy()
    raised[NAMES.index("elbow_l_flexion")] += 2.0
    variance = LandmarkCue(RIG, BODY, NOISY).variance(raised[None])[0]
    assert variance.shape == (len(JOINTS),)
    wrist = JOINTS.index("wrist_l")
    off = np.linalg.norm(BODY.skeleton.joints(raised)[wrist] - BODY.skeleton.joints(POSE)[wrist])
    assert 0.2 * off < np.sqrt(3 * variance[wrist]) < off
    assert np.delete(variance, wrist).max() < 0.03**2
    assert not LandmarkCue(RIG, BODY, np.full(SEEN.shape, np.nan)).variance(raised[None]).any()


# --- whose landmarks they are -------------------------------------------------------------------------------------


MASKS = draw_silhouettes(BODY, RIG, POSE[None])[0]


def test_landmarks_of_the_person_in_the_masks_are_chosen() -> None:
    beside = POSE.copy()
    beside[:2] += [0.5, 0.4]
    people = np.stack([landmarks_of(RIG, BODY, beside), SEEN])
    np.testing.assert_array_equal(of_person(people, MASKS), SEEN)
    assert of_person(people[:0], MASKS) is None and of_person(None, MASKS) is None
    far_away = POSE.copy()
    far_away[:2] += 1.5
    assert of_person(landmarks_of(RIG, BODY, far_away)[None], MASKS) is None


def test_small_skeleton_that_a_network_sees_in_a_head_is_refused() -> None:
    tiny = SEEN.copy()
    head = SEEN[:, [LANDMARKS.index("nose")], :2]
    tiny[..., :2] = head + 0.12 * (SEEN[..., :2] - SEEN[..., :2].mean(axis=1, keepdims=True))
    assert of_person(tiny[None], MASKS) is None


def test_images_without_the_person_have_no_landmarks() -> None:
    masks = MASKS.copy()
    masks[1] = 0
    masks[2] = np.where(masks[2] > 0, OTHERS, 0)
    found = of_person(SEEN[None], masks)
    assert found is not None
    assert np.isnan(found[[1, 2]]).all()
    np.testing.assert_array_equal(found[[0, 3]], SEEN[[0, 3]])
    assert of_person(SEEN[None], np.zeros_like(MASKS)) is None


def test_half_hidden_person_keeps_the_landmarks() -> None:
    lower = MASKS.copy()
    for mask in lower:
        _, y, _, height = cv2.boundingRect(mask)
        mask[y + height // 2 :] = 0
    np.testing.assert_array_equal(of_person(SEEN[None], lower), SEEN)
