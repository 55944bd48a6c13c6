"""Initialisation without a known pose, on silhouettes rendered from the tracker's own body."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.model.figures import draw_silhouettes
from tests.model.landmarks import landmarks_of
from tests.model.ring import ring_of_cameras
from tk.errors import CaptureError
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.body_points import LANDMARKS
from tk.model.body.cone_body import build_cone_body
from tk.model.body.gait_poses import neutral_pose, standing_pose, walking_pose
from tk.model.body.skeleton import JOINTS, shoulder_angles
from tk.model.setup import InitPose, Subject
from tk.optim.gauss_newton import BatchSolution
from tk.settings import SilhouetteSettings
from tk.trackers.hypotheses import DROPPED, TrajectoryHypothesis, walking
from tk.trackers.initialisation import find_in, find_person, stature_of
from tk.trackers.protocol import Frame
from tk.trackers.region import RegionTracker
from tk.trackers.silhouette import SilhouetteTracker

STATURE = 1.75
RIG = ring_of_cameras(3, width=200, height=250)
BODY = build_cone_body(BodyDimensions.from_stature(STATURE))
SKELETON = BODY.skeleton


def placed(pose: np.ndarray, yaw: float, **angles: float) -> np.ndarray:
    """A pose (D,) at its place, turned; further angles in degrees."""
    result = pose.copy()
    result[:3] = [0.05, -0.04, 0.93]
    result[SKELETON.index("torso_yaw")] = yaw
    for name, degrees in angles.items():
        result[SKELETON.index(name)] = np.radians(degrees)
    return result


def arms(pose: np.ndarray, left: tuple[float, float, float], right: tuple[float, float, float]) -> np.ndarray:
    """With upper arms in these directions: forwards, outwards, up."""
    result = pose.copy()
    for side, direction in (("l", left), ("r", right)):
        yaw, pitch = shoulder_angles(np.array(direction) / np.linalg.norm(direction))
        result[SKELETON.index(f"shoulder_{side}_yaw")] = yaw
        result[SKELETON.index(f"shoulder_{side}_pitch")] = pitch
    return result


def tracker_of(stature: float = STATURE) -> SilhouetteTracker:
    tracker = SilhouetteTracker(RIG, "z", SilhouetteSettings())
    tracker.take_body(build_cone_body(BodyDimensions.from_stature(stature)))
    return tracker


def found(poses: np.ndarray) -> np.ndarray:
    """Return (F, 15, 3) joints of the person found in silhouettes of poses (F, D)."""
    tracker = tracker_of()
    frames = [Frame(i, np.zeros(0, np.uint8), m) for i, m in enumerate(draw_silhouettes(BODY, RIG, poses))]
    poses = find_person(tracker, [tracker.see(frame) for frame in frames])[0].poses
    return tracker.world.points_out(SKELETON.joints(poses))


def error(joints: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(F,) mean distance, metres."""
    return np.linalg.norm(joints - [SKELETON.joints(p) for p in poses], axis=2).mean(axis=1)


@pytest.mark.parametrize("yaw", [0.3, 4.4])
def test_heading_of_a_t_pose_is_found_from_the_feet(yaw: float) -> None:
    """Arms level and straight, legs straight, standing still: only the feet differ."""
    t_pose = arms(standing_pose(SKELETON), (0, 1, 0), (0, 1, 0))
    poses = np.array([placed(t_pose, yaw)] * 2)
    joints = found(poses)
    assert error(joints, poses).max() < 0.03
    left = joints[:, JOINTS.index("shoulder_l")] - joints[:, JOINTS.index("shoulder_r")]
    expected = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    assert (left @ expected > 0.25).all()


@pytest.mark.parametrize("name", ["arms at 45°", "crouching", "one arm up, one forwards"])
def test_person_is_found_in_pose(name: str) -> None:
    standing = standing_pose(SKELETON)
    bent = {"hip_l_pitch": -85.0, "hip_r_pitch": -85.0, "knee_l_flexion": 110.0, "knee_r_flexion": 110.0}
    pose = {
        "arms at 45°": placed(arms(standing, (0, 1, -1), (0, 1, -1)), 1.0),
        "crouching": placed(arms(standing, (1, 0.3, -0.3), (1, 0.3, -0.3)), 2.5, **bent),
        "one arm up, one forwards": placed(arms(standing, (0.2, 0.2, 1), (1, 0.2, 0)), 5.0),
    }[name]
    poses = np.array([pose, pose])
    assert error(found(poses), poses).max() < 0.04


def test_difficult_first_frame_is_reached_by_tracking_back_from_an_easy_one() -> None:
    """Bent over with an arm up and a leg lifted; then the person straightens up and walks."""
    lifted = {"torso_pitch": 50.0, "hip_l_pitch": -100.0, "knee_l_flexion": 70.0, "hip_r_pitch": -40.0}
    hard = placed(arms(standing_pose(SKELETON), (1, 0.4, 0.8), (-0.4, 0.6, 0.6)), 0.8, **lifted)
    easy = placed(walking_pose(SKELETON, 0.3), 0.8)
    poses = np.array([hard + k / 7 * (easy - hard) for k in range(8)])
    errors = error(found(poses), poses)
    assert errors[0] < 0.06 and errors[-1] < 0.04, errors


def test_hypothesis_whose_fitted_body_has_the_lower_cost_is_chosen(monkeypatch) -> None:
    """The arms change places; with the average body the wrong hypothesis comes first."""
    right = placed(arms(standing_pose(SKELETON), (1, 0.6, 0.3), (0.2, 1, -0.6)), 0.6)
    wrong = placed(arms(standing_pose(SKELETON), (0.2, 1, -0.6), (1, 0.6, 0.3)), 0.6)
    masks = draw_silhouettes(BODY, RIG, np.array([right] * 4))
    frames = [Frame(i, np.zeros(0, np.uint8), m) for i, m in enumerate(masks)]
    tracker = tracker_of()
    hypotheses = [
        TrajectoryHypothesis(tracker.world.poses_in(np.array([pose] * 4)), nats)
        for pose, nats in ((wrong, 20.0), (right, 21.0))
    ]
    monkeypatch.setattr("tk.trackers.contour_finder.find_person", lambda *_: hypotheses)
    pose = tracker.world.poses_out(tracker.find(frames, Subject(STATURE)))
    assert error(SKELETON.joints(pose)[None], right[None])[0] < 0.02


@pytest.mark.parametrize("stature", [1.2, 1.95])
def test_estimated_stature_hardly_depends_on_the_pose(stature: float) -> None:
    body = build_cone_body(BodyDimensions.from_stature(stature))
    standing = standing_pose(SKELETON)
    bowing = placed(standing, 1.0, hip_l_pitch=-45.0, hip_r_pitch=-45.0, torso_pitch=45.0)
    statures = []
    for pose in (placed(standing, 0.5), placed(neutral_pose(SKELETON), 0.5), bowing):
        pose = pose.copy()
        pose[2] *= stature / STATURE
        tracker = tracker_of()
        statures.append(stature_of(tracker, [tracker.pyramid(Frame(0, np.zeros(0, np.uint8), m))
                                             for m in draw_silhouettes(body, RIG, pose[None])]))  # fmt: skip
    np.testing.assert_allclose(statures, stature, rtol=0.09)


@pytest.mark.parametrize(("hull_m", "expected"), [(STATURE, STATURE), (2.3, None), (1.2, None)])
def test_lower_hull_corrects_the_stature_of_wide_clothes(monkeypatch, hull_m: float, expected: float | None) -> None:
    """Raised arms, or a bent body, leave the estimate from the silhouettes' area."""
    tracker = SilhouetteTracker(RIG, "z", SilhouetteSettings(adapt=False))
    bare = draw_silhouettes(BODY, RIG, placed(standing_pose(SKELETON), 0.5)[None])[0]
    masks = np.array([cv2.dilate(mask, np.ones((5, 5), np.uint8)) for mask in bare])
    frame = Frame(0, np.zeros(0, np.uint8), masks)
    apparent = stature_of(tracker, [tracker.pyramid(frame)])
    monkeypatch.setattr(
        "tk.trackers.contour_finder.find_person", lambda *_: [TrajectoryHypothesis(np.zeros((1, 1)), 0.1)]
    )
    tracker.find([frame], Subject(hull_m=hull_m))
    assert apparent > 1.1 * STATURE
    assert tracker.body.dimensions == BodyDimensions.from_stature(expected or apparent)


@pytest.mark.parametrize("elsewhere", [("wrist_l",), ("wrist_l", "wrist_r", "knee_r")])
@pytest.mark.parametrize("stature", [1.2, 1.95])
def test_landmarks_show_the_stature_of_somebody_who_sits_with_a_low_hull(
    stature: float, elsewhere: tuple[str, ...]
) -> None:
    """Some landmarks are a step higher in all images: one, or at an end of half of the limbs."""
    body = build_cone_body(BodyDimensions.from_stature(stature))
    bent = {f"{name}_{side}": angle for name, angle in (("hip", -90.0), ("knee", 90.0)) for side in "lr"}
    bent = {f"{limb}_{'pitch' if limb[:3] == 'hip' else 'flexion'}": angle for limb, angle in bent.items()}
    pose = placed(standing_pose(SKELETON), 1.0, **bent)
    seen = landmarks_of(RIG, body, pose, 0.015)
    higher = pose.copy()
    higher[2] += 0.6
    wrong = [LANDMARKS.index(name) for name in elsewhere]
    seen[:, wrong] = landmarks_of(RIG, body, higher, 0.015)[:, wrong]
    masks = draw_silhouettes(body, RIG, pose[None])[0]
    frame = Frame(0, np.zeros(0, np.uint8), masks, landmarks=seen[None])
    tracker = tracker_of()
    assert stature_of(tracker, [tracker.pyramid(frame)], 0.75 * stature) == pytest.approx(stature, rel=0.03)


def test_wrong_joints_of_a_given_pose_change_no_stature() -> None:
    """As a network's keypoints have them: some lie far from the person."""
    pose = placed(standing_pose(SKELETON), 0.4)
    masks = draw_silhouettes(BODY, RIG, pose[None])[0]
    joints = dict(zip(JOINTS, SKELETON.joints(pose), strict=True))
    for k, name in enumerate(("shoulder_r", "elbow_l", "ankle_l", "knee_r")):
        joints[name] = joints[name] + np.roll([0.9, -0.4, 0.2], k)
    tracker = SilhouetteTracker(RIG, "z", SilhouetteSettings(adapt=False))
    tracker.find([Frame(0, np.zeros(0, np.uint8), masks)], Subject(init=InitPose(joints, {}, 0)))
    assert tracker.body.dimensions.barefoot == pytest.approx(STATURE, rel=0.09)


@pytest.mark.parametrize("height", [1.25, 2.4])
def test_height_that_contradicts_the_silhouettes_is_refused(height: float) -> None:
    tracker = tracker_of()
    masks = draw_silhouettes(tracker.body, RIG, placed(standing_pose(SKELETON), 0.4)[None])[0]
    with pytest.raises(CaptureError, match=f"height of {height:.2f} m contradicts the silhouettes.*about 1.7.*masks"):
        tracker.find([Frame(0, np.zeros(0, np.uint8), masks)], Subject(height))


def test_empty_first_frame_is_refused() -> None:
    tracker = tracker_of()
    empty = Frame(7, np.zeros(0, np.uint8), np.zeros((3, 250, 200), np.uint8))
    with pytest.raises(CaptureError, match="0 of 3 masks of frame 7 show anybody, two are needed"):
        find_person(tracker, [tracker.see(empty)])


def test_masks_that_no_pose_explains_are_refused(monkeypatch) -> None:
    tracker = tracker_of()
    masks = draw_silhouettes(tracker.body, RIG, placed(standing_pose(SKELETON), 0.4)[None])[0]
    frame = Frame(7, np.zeros(0, np.uint8), masks)
    monkeypatch.setattr(tracker, "mean_residual", lambda _, poses, __: np.full(len(poses), 0.8))
    monkeypatch.setattr(tracker, "improved", lambda _, pose: pose)
    with pytest.raises(CaptureError, match="no pose of a person explains the masks: the best one leaves 80%"):
        find_person(tracker, [tracker.see(frame)])


def test_heading_as_before_is_preferred_where_silhouettes_are_ambiguous(monkeypatch) -> None:
    tracker = tracker_of()
    before, other = (placed(standing_pose(SKELETON), yaw) for yaw in (0.4, 0.4 + np.pi))
    seen = tracker.see(Frame(0, np.zeros(0, np.uint8), draw_silhouettes(BODY, RIG, before[None])[0]))
    monkeypatch.setattr(tracker, "settle", lambda _, starts, *__: BatchSolution(starts, np.zeros(1, np.int32)))
    yaw = SKELETON.index("torso_yaw")

    class Gains:
        def __init__(self, nats: float) -> None:
            self.nats = nats

        def cost(self, _, poses: np.ndarray) -> np.ndarray:
            return -self.nats * (np.cos(poses[:, yaw] - before[yaw]) < 0)

    for gain, turned in ((0.0, False), (DROPPED - 1.0, False), (DROPPED + 1.0, True)):
        monkeypatch.setattr(tracker, "evidence", lambda *_, gain=gain: Gains(gain))
        pose = tracker.best(seen, before, other[None])
        assert (np.cos(pose[yaw] - before[yaw]) < 0) == turned


def test_people_walk_forwards() -> None:
    ahead = np.array([placed(walking_pose(SKELETON, 0.1 * k), 0.5) for k in range(10)])
    back = ahead.copy()
    ahead[:, :2] += np.linspace(0, 1.2, 10)[:, None] * [np.cos(0.5), np.sin(0.5)]
    back[:, :2] -= np.linspace(0, 1.2, 10)[:, None] * [np.cos(0.5), np.sin(0.5)]
    cost = walking(SKELETON, np.stack([ahead, back]))
    assert 1.5 < cost[1] - cost[0] < 3.0
    assert walking(SKELETON, np.repeat(ahead[:1], 5, axis=0)) == 0.0


def test_landmarks_tell_the_heading_that_silhouettes_leave_open() -> None:
    """The masks show the person in both headings."""
    facing = placed(standing_pose(SKELETON), 0.6)
    back = placed(standing_pose(SKELETON), 0.6 + np.pi)
    tracker = tracker_of()
    masks = draw_silhouettes(BODY, RIG, np.stack([facing, back])).max(axis=0)
    for pose in (facing, back):
        seen = landmarks_of(RIG, BODY, pose, 0.03)[None]
        frame = Frame(0, np.zeros(0, np.uint8), masks, landmarks=seen)
        pyramid = tracker.pyramid(frame)
        assert "landmarks" in pyramid.measured
        score = tracker.cost(pyramid, tracker.world.poses_in(np.stack([facing, back])))
        assert (score[0] < score[1]) == (pose is facing)


@pytest.mark.parametrize("opposite", [False, True])
def test_a_network_is_asked_for_the_heading_that_the_opening_leaves_open(opposite: bool) -> None:
    """The masks show the person in both headings; the first frame decides for the opening."""
    both = [placed(standing_pose(SKELETON), yaw) for yaw in (0.6, 0.6 + np.pi)]
    masks, asked = draw_silhouettes(BODY, RIG, np.stack(both)).max(axis=0), []

    def network(points: np.ndarray) -> np.ndarray:
        asked.append(points)
        return landmarks_of(RIG, BODY, both[opposite], 0.03)

    tracker = RegionTracker(RIG, "z", SilhouetteSettings(adapt=False))
    frames = [Frame(i, np.zeros((3, 0, 0, 3), np.uint8), masks, ask=network) for i in range(3)]
    tracker.start(frames, Subject(height_m=STATURE, in_init_pose=False))
    pose = tracker.world.poses_out(tracker.last_poses()[0][None])
    assert len(asked) == 1 and error(SKELETON.joints(pose), both[opposite][None])[0] < 0.06


def test_start_with_landmarks_begins_with_their_pose(monkeypatch) -> None:
    """A pose that no start by silhouettes reaches: seated, arms crossed, seen from behind."""
    seated = {"hip_l_pitch": -90.0, "hip_r_pitch": -90.0, "knee_l_flexion": 90.0, "knee_r_flexion": 90.0}
    pose = placed(arms(standing_pose(SKELETON), (1, 0.0, 0.1), (1, 0.0, -0.4)), 2.9, **seated)
    masks = draw_silhouettes(BODY, RIG, pose[None])[0]
    tracker = tracker_of()
    frame = Frame(0, np.zeros(0, np.uint8), masks, landmarks=landmarks_of(RIG, BODY, pose, 0.02)[None])
    far = placed(standing_pose(SKELETON), 6.0)
    monkeypatch.setattr("tk.trackers.proposals.anywhere.gait.gait_figures", lambda *_: np.array([far]))
    found = find_person(tracker, [tracker.see(frame)])[0].poses
    assert error(tracker.world.points_out(SKELETON.joints(found)), pose[None])[0] < 0.04


def test_a_search_in_the_first_frame_serves_the_opening_that_begins_with_it(monkeypatch) -> None:
    """Whether the search began before the other frames were there, the result is the same; for another opening, or for
    another subject, it begins again."""
    poses = np.array([placed(walking_pose(SKELETON, phase), 0.4) for phase in (0.0, 0.3)])
    masks = draw_silhouettes(BODY, RIG, poses)
    frames = [Frame(i, np.zeros(0, np.uint8), m) for i, m in enumerate(masks)]
    searched = []
    monkeypatch.setattr(
        "tk.trackers.contour_finder.find_in", lambda *args: searched.append(args[1].frame.index) or find_in(*args)
    )

    def found_after(anticipated: Frame, subject: Subject) -> np.ndarray:
        tracker = tracker_of()
        tracker.anticipate(anticipated, subject)
        return tracker.find(frames, Subject(STATURE))

    expected = tracker_of().find(frames, Subject(STATURE))
    assert searched == [0]
    for anticipated, subject, again in ((0, STATURE, []), (1, STATURE, [0]), (0, 1.6, [0])):
        searched.clear()
        np.testing.assert_array_equal(found_after(frames[anticipated], Subject(subject)), expected)
        assert searched == [anticipated, *again]
