"""The region tracker on silhouettes and images rendered from its own body."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.model.figures import draw_silhouettes, scaled
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, EMPTY, NAMES, STATURE, errors, find_again_elsewhere, observe, walk
from tk.errors import CaptureError
from tk.model.body.cone_body import COLOR_GROUPS, ConeBody, build_cone_body
from tk.model.body.gait_poses import standing_pose, walking_pose
from tk.model.body.joint_sigma import pose_variance
from tk.model.body.limb_candidates import Limb, exchanged_limbs, pairs
from tk.model.body.skeleton import JOINTS, shoulder_angles
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume
from tk.model.cues.ray_costs import Evidence, RayGrid
from tk.model.setup import InitPose, Setup, Subject
from tk.settings import RegionSettings, Settings, SilhouetteSettings
from tk.trackers import second_pass
from tk.trackers.judgement import UNKNOWN_AFTER
from tk.trackers.proposals import anywhere, limbs
from tk.trackers.proposals import exchanged as of_exchanged
from tk.trackers.reason import Reason
from tk.trackers.region import RegionTracker
from tk.trackers.residual import LEAST_SPREAD
from tk.trackers.silhouette import SilhouetteTracker

RIG = ring_of_cameras(3, width=160, height=200)
SKELETON = BODY.skeleton
# A pixel is 1.4 cm wide at the subject; a joint rests on dozens of edgels in three views.
CLOSE_M = 0.025
SETTINGS = SilhouetteSettings(adapt=False, search_every=0.0)


def with_arm(pose: np.ndarray, side: str, direction: tuple[float, float, float], elbow_deg: float) -> np.ndarray:
    """The pose with an arm pointing along (forward, outward, up)."""
    result = pose.copy()
    d = np.array(direction) / np.linalg.norm(direction)
    yaw, pitch = shoulder_angles(d)
    for name, value in (("yaw", yaw), ("pitch", pitch), ("roll", 0.0)):
        result[NAMES.index(f"shoulder_{side}_{name}")] = value
    result[NAMES.index(f"elbow_{side}_flexion")] = np.radians(elbow_deg)
    return result


POSES = walk(6)
MASKS = draw_silhouettes(BODY, RIG, POSES)


def init_of(pose: np.ndarray) -> InitPose:
    return InitPose({}, dict(zip(NAMES, pose, strict=True)), None, STATURE)


def tracker_at(
    pose: np.ndarray,
    masks: np.ndarray = MASKS[0],
    body: ConeBody = BODY,
    settings: SilhouetteSettings = SETTINGS,
    region_settings: RegionSettings | None = None,
    images: np.ndarray = EMPTY,
) -> RegionTracker:
    """A tracker of this body that starts near a pose."""
    tracker = RegionTracker(RIG, "z", settings, region_settings)
    tracker.start([observe(masks, 0, images)], Subject(init=init_of(pose), body=body))
    return tracker


def test_walk_is_tracked_and_a_resumed_run_is_the_same() -> None:
    tracker = tracker_at(POSES[0], settings=replace(SETTINGS, search_every=0.2))
    estimates = []
    for i, masks in enumerate(MASKS):
        estimates.append(tracker.step(observe(masks, i)))
        if i == 2:
            model = {name: np.copy(v) if isinstance(v, np.ndarray) else v for name, v in tracker.model().items()}
            state = tracker.state
    assert [e.status for e in estimates] == ["initialised"] + ["tracked"] * 5
    assert max(errors(e, p).mean() for e, p in zip(estimates, POSES, strict=True)) < CLOSE_M
    second = RegionTracker(RIG, "z", tracker.settings, tracker.region_settings)
    second.take_model(model)
    second.state = state
    for i in range(3, 6):
        again = second.step(observe(MASKS[i], i))
        for name in ("pose", "joints", "sigma", "residual", "objective", "status"):
            np.testing.assert_array_equal(getattr(again, name), getattr(estimates[i], name), err_msg=name)


def test_estimate_has_all_fields_of_the_contract() -> None:
    tracker = tracker_at(POSES[0])
    tracker.step(observe(MASKS[0]))
    estimate = tracker.step(observe(MASKS[1], 1))
    assert tracker.pose_names == SKELETON.names and len(tracker.pose_units) == len(estimate.pose) == 32
    np.testing.assert_allclose(SKELETON.joints(estimate.pose), estimate.joints, atol=1e-9)
    assert set(estimate.timing) == set(tracker.timing_stages) and len(estimate.iterations) == len(tracker.stages)
    assert estimate.residual is not None and estimate.residual.shape == (3, 2)
    assert (estimate.residual >= 0).all() and (estimate.residual < 0.15).all()


def test_sigma_is_larger_with_two_views_and_unknown_with_one() -> None:
    first = tracker_at(POSES[0]).step(observe(MASKS[0]))
    assert first.sigma is not None and first.sigma.shape == (15,)
    assert (first.sigma > 0).all() and (first.sigma < 0.2).all()
    masks = MASKS[0].copy()
    tracker = tracker_at(POSES[0])
    tracker.step(observe(MASKS[0]))
    masks[2] = 0
    two_views = tracker.step(observe(masks, 1))
    assert two_views.sigma is not None and two_views.sigma.mean() > 1.2 * first.sigma.mean()
    masks[1] = 0
    one_view = tracker.step(observe(masks, 2))
    assert one_view.sigma is not None and np.isnan(one_view.sigma).all()
    assert one_view.residual is not None and np.isnan(one_view.residual[:, 0]).tolist() == [False, True, True]


def test_limb_search_finds_an_arm_that_has_jumped() -> None:
    """From one frame to the next an arm is raised to the side: no contour is near."""
    raised = np.array([with_arm(pose, "l", (0.1, 1.0, 0.6), 15.0) for pose in POSES])
    masks = draw_silhouettes(BODY, RIG, raised)
    found = {}
    for every in (0, 1):
        # without the search the arm stays in its old pose
        config = RegionSettings(false_alarm=0.4 if every else 1e-9)
        tracker = tracker_at(POSES[0], settings=replace(SETTINGS, search_every=every / 15), region_settings=config)
        tracker.step(observe(MASKS[0]))
        for i in range(1, 4):
            found[every] = tracker.step(observe(masks[i], i))
    wrist = JOINTS.index("wrist_l")
    assert errors(found[0], raised[3])[wrist] > 0.25
    assert errors(found[1], raised[3])[wrist] < 0.06
    assert errors(found[1], raised[3]).mean() < 1.5 * CLOSE_M


def test_seed_draws_the_candidates_of_the_limb_search(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[float] = []
    candidates = Limb.candidates

    def watched(limb: Limb, pose: np.ndarray, near: int, rng: np.random.Generator) -> np.ndarray:
        drawn.append(float(rng.bit_generator.random_raw()))
        return candidates(limb, pose, near, rng)

    monkeypatch.setattr(Limb, "candidates", watched)
    every = []
    for seed in (0, 0, 1):
        tracker = tracker_at(POSES[0], settings=replace(SETTINGS, search_every=1 / 15))
        tracker.seed = seed
        drawn.clear()  # `tracker_at` searches with the default
        limbs.modes(tracker, tracker.see(observe(MASKS[0], 1)), tracker.last_poses()[0], tracker.limbs)
        every.append(tuple(drawn))
    assert every[0] == every[1] and not set(every[0]) & set(every[2])
    setup = Setup(RIG, Volume((0.0, 0.0, 1.0), (2.0, 2.0, 2.0)), "z", 15.0, (Subject(STATURE),))
    for kind in (RegionTracker, SilhouetteTracker):
        assert kind.of(setup, Settings(seed=5)).seed == 5


def test_high_residual_triggers_a_limb_search() -> None:
    raised = with_arm(POSES[1], "r", (0.1, 1.0, 0.5), 15.0)
    tracker = tracker_at(POSES[0])
    assert tracker.step(observe(MASKS[0])).iterations[1] == 0
    estimate = tracker.step(observe(draw_silhouettes(BODY, RIG, raised[None])[0], 1))
    assert estimate.iterations[1] == 1
    assert errors(estimate, raised)[JOINTS.index("wrist_r")] < 0.08


def with_surplus_area(masks: np.ndarray) -> np.ndarray:
    """Return masks (C, H, W) with surplus area of half the person's pixels."""
    masks = masks.copy()
    for mask in masks:
        rows, columns = np.nonzero(mask)
        across = int(0.5 * len(rows) / np.ptp(rows))
        mask[rows.min() : rows.max(), max(columns.min() - across, 0) : columns.min()] = 255
    return masks


def test_pose_with_a_high_residual_after_a_loss_is_refused_with_two_cameras_too() -> None:
    two = MASKS[0].copy()
    two[2] = 0
    tracker = tracker_at(POSES[0])
    shown = (two, np.zeros_like(two), with_surplus_area(MASKS[0]) * (two.any(axis=(1, 2))[:, None, None]), two)
    estimates = [tracker.step(observe(masks, i)) for i, masks in enumerate(shown)]
    reasons = [estimate.reason for estimate in estimates]
    assert reasons == [Reason.NONE, Reason.NOBODY, Reason.STILL_HIGH, Reason.NONE]
    assert [estimate.status for estimate in estimates] == ["initialised", "lost", "lost", "recovered"]
    assert estimates[2].sigma is not None and np.isnan(estimates[2].sigma).all()
    assert estimates[2].deviation is not None and np.isfinite(estimates[2].deviation).all()


def test_sigma_is_unknown_while_the_residual_stays_high() -> None:
    tracker, nonsense = tracker_at(POSES[0]), with_surplus_area(MASKS[0])
    estimates = [tracker.step(observe(masks)) for masks in (MASKS[0], *[nonsense] * UNKNOWN_AFTER, MASKS[0])]
    assert all(estimate.status != "lost" for estimate in estimates)
    known = [np.isfinite(estimate.sigma).any() for estimate in estimates if estimate.sigma is not None]
    assert known == [True] * UNKNOWN_AFTER + [False, True]


def test_run_resumed_after_a_jump_is_the_same() -> None:
    """After a jump the frame starts from poses with and without the motion."""
    further = [with_arm(POSES[1], "r", direction, 15.0) for direction in ((0.1, 1.0, 0.5), (0.1, 0.6, 1.0))]
    masks = draw_silhouettes(BODY, RIG, np.array(further))
    first = tracker_at(POSES[0])
    first.step(observe(MASKS[0]))
    jumped = first.step(observe(masks[0], 1))
    assert jumped.iterations[1] == 1 and any(h.jumped for h in first._alive)
    second = RegionTracker(RIG, "z", first.settings, first.region_settings)
    second.take_model(first.model())
    second.state = first.state
    a, b = (tracker.step(observe(masks[1], 2)) for tracker in (first, second))
    np.testing.assert_array_equal(a.joints, b.joints)
    assert errors(a, further[1])[JOINTS.index("wrist_r")] < 0.08


@pytest.mark.parametrize(
    ("forward_deg", "across_deg", "heading"),
    [(25.0, 12.0, 0.7), (25.0, 12.0, 2.1), (0.0, 24.0, 0.0), (15.0, 18.0, 1.5)],
)
def test_crossing_legs_are_not_swapped(forward_deg: float, across_deg: float, heading: float) -> None:
    """Each leg is then near the other one's pose, and neither can leave it alone."""
    spread = standing_pose(SKELETON)
    spread[:3], spread[NAMES.index("torso_yaw")] = POSES[0][:3], heading
    crossed = spread.copy()
    for side in "lr":
        spread[NAMES.index(f"hip_{side}_yaw")] = np.radians(across_deg)
        crossed[NAMES.index(f"hip_{side}_yaw")] = -np.radians(across_deg)
    spread[NAMES.index("hip_r_pitch")] = crossed[NAMES.index("hip_l_pitch")] = -np.radians(forward_deg)
    before, now = (SKELETON.clip(pose) for pose in (spread, crossed))
    masks = draw_silhouettes(BODY, RIG, np.array([before, now]))
    tracker = tracker_at(before, masks[0])
    tracker.step(observe(masks[0]))
    settled = tracker.settle(tracker.pyramid(observe(masks[1])), tracker.world.poses_in(before)[None]).states[0]
    assert SKELETON.apart(settled, SKELETON.joints(tracker.world.poses_in(now))) > 0.3  # a descent alone swaps them
    estimates = [tracker.step(observe(masks[1], i)) for i in (1, 2, 3, 4)]
    legs = [JOINTS.index(f"{joint}_{side}") for joint in ("knee", "ankle") for side in "lr"]
    assert errors(estimates[-2], now)[legs].max() < 0.06
    assert errors(estimates[-1], now).max() < 0.06


def test_person_is_lost_in_empty_frames_and_recovered_afterwards() -> None:
    tracker = tracker_at(POSES[0])
    first = tracker.step(observe(MASKS[0]))
    for index in (1, 2):
        lost = tracker.step(observe(np.zeros_like(MASKS[0]), index))
        assert lost.status == "lost" and np.isinf(lost.objective)
        np.testing.assert_array_equal(lost.joints, first.joints)
        assert lost.sigma is not None and np.isnan(lost.sigma).all()
        assert lost.residual is not None and np.isnan(lost.residual).all()
        assert set(lost.timing) == set(tracker.timing_stages)
    back = [tracker.step(observe(MASKS[k], 2 + k)) for k in (1, 2, 3)]  # the first pose may be refused
    assert next(e.status for e in back if e.status != "lost") == "recovered" and back[1].status != "lost"
    assert back[2].status == "tracked" and errors(back[2], POSES[3]).mean() < CLOSE_M


def test_person_who_returns_at_another_place_is_recovered() -> None:
    find_again_elsewhere(tracker_at(POSES[0]), RIG, POSES[:4], 2 * CLOSE_M)


def test_person_who_is_elsewhere_after_a_cut_is_found_again() -> None:
    tracker = tracker_at(POSES[0])
    for index in range(4):
        tracker.step(observe(MASKS[index], index))
    elsewhere = walk(6, 0.2)
    elsewhere[:, 0] += 0.7
    elsewhere[:, NAMES.index("torso_yaw")] += 2.0
    masks = draw_silhouettes(BODY, RIG, elsewhere)
    after = [tracker.step(observe(mask, index)) for index, mask in enumerate(masks, 4)]
    assert "recovered" in [estimate.status for estimate in after[:2]]
    for estimate, pose in zip(after, elsewhere, strict=True):
        assert estimate.status == "lost" or errors(estimate, pose).mean() < 2 * CLOSE_M
    assert after[-1].status == "tracked"


def test_person_is_searched_for_if_the_residual_stays_high(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrong heading, from which no limb search leads out, with a residual below the limit of a loss."""
    tracker = tracker_at(POSES[0])
    for _ in range(3):
        tracker.step(observe(MASKS[0]))
    state = tracker.state
    wrong = tracker.world.poses_in(POSES[0])
    wrong[SKELETON.index("torso_yaw")] += np.radians(105)
    searches, none = [], np.empty((0, len(wrong)))
    propose = anywhere.propose

    def watched(*arguments: Any) -> Any:
        searches.append(propose(*arguments))
        return searches[-1]

    monkeypatch.setattr(anywhere, "propose", watched)
    for module in (limbs, of_exchanged):
        monkeypatch.setattr(module, "propose", lambda *_: none)
    monkeypatch.setattr(tracker.residuals, "jumped", lambda _: False)  # as if it had risen slowly
    tracker.state = replace(state, alive=[replace(state.alive[0], pose=wrong, previous=wrong)])
    mean = tracker.state.residuals.mean
    estimates = [tracker.step(observe(MASKS[0])) for _ in range(4)]
    assert [e.status for e in estimates] == ["tracked"] * 4
    assert errors(estimates[1], POSES[0]).mean() > 2 * CLOSE_M
    assert len(searches) == 1 and errors(estimates[3], POSES[0]).mean() < 2 * CLOSE_M
    # residual and rendering are of the new pose
    person = tracker.coarse_grid.sample(estimates[3].masks) >= 128
    wrong_rays = np.count_nonzero(estimates[3].drawn != person, axis=(1, 2)) / np.count_nonzero(person, axis=(1, 2))
    np.testing.assert_allclose(estimates[3].residual.sum(axis=1), wrong_rays)
    assert wrong_rays.mean() < estimates[1].residual.sum(axis=1).mean() / 2
    assert (tracker.state.residuals.mean - mean).max() < 0.5 * LEAST_SPREAD


def test_person_is_found_without_a_given_pose() -> None:
    tracker = RegionTracker(RIG, "z", SETTINGS)
    tracker.start([observe(m, i) for i, m in enumerate(MASKS[:3])], Subject(STATURE))
    estimate = tracker.step(observe(MASKS[0]))
    assert estimate.status == "initialised" and errors(estimate, POSES[0]).mean() < CLOSE_M
    with pytest.raises(CaptureError, match="0 of 3 masks of frame 7 show anybody"):
        tracker.start([observe(np.zeros_like(MASKS[0]), 7)], Subject(STATURE))


# --- colours ----------------------------------------------------------------------------------------------------------

SHADES = {"torso": (200, 40, 30), "forearm": (110, 150, 225), "hand": (110, 150, 225), "head": (110, 150, 225)}
# two cameras 14° apart: both see the chest, and what is before it lies within the silhouette of both
FRONT = Rig(ring_of_cameras(24, width=160, height=200).cameras[:2])


def clothed(poses: np.ndarray) -> np.ndarray:
    """(F, V, H, W, 3) the body in clothes before grey: a blue shirt, bare forearms, dark trousers."""
    worn = np.array([(90, 90, 90), *(SHADES.get(COLOR_GROUPS[g], (45, 60, 40)) for g in BODY.color_group)], np.uint8)
    grid = RayGrid(FRONT, FRONT.frame_shape[0])
    nobody = np.zeros(grid.rays.shape[:3], np.uint8)
    _, met = Evidence.of(grid, nobody).cast(BODY, poses)
    assert met is not None
    return worn[met.label]


def crossing(count: int) -> np.ndarray:
    """(count, D) a forearm that swings from the side to before the chest."""
    pose = walking_pose(SKELETON, None)
    pose[:3] = [0.0, 0.0, 0.93]
    toward = FRONT[0].center + FRONT[1].center
    pose[NAMES.index("torso_yaw")] = np.arctan2(toward[1], toward[0])
    poses = []
    for share in np.linspace(0, 1, count):
        here = with_arm(pose, "l", (0.35, 0.1, -0.93), 90.0)
        here[NAMES.index("shoulder_l_roll")] = np.radians(-30.0 + 100.0 * share)
        poses.append(here)
    return np.array(poses)


def test_colors_locate_a_forearm_inside_the_silhouette() -> None:
    """Learned while the forearm sticks out, they tell where it is before the chest. No search finds it by chance, and a
    swing that ends well or badly by chance is one of five."""
    wrist = JOINTS.index("wrist_l")
    off: dict[bool, list[float]] = {True: [], False: []}
    for poses in map(crossing, range(8, 13)):
        images, masks = clothed(poses), draw_silhouettes(BODY, FRONT, poses)
        for colored in (True, False):
            tracker = RegionTracker(FRONT, "z", SETTINGS, RegionSettings(colors=colored))
            tracker.start([observe(masks[0], 0, images[0])], Subject(init=init_of(poses[0]), body=BODY))
            found = [tracker.step(observe(m, i, p)) for i, (m, p) in enumerate(zip(masks, images, strict=True))]
            off[colored] += [errors(e, p)[wrist] for e, p in zip(found[-3:], poses[-3:], strict=True)]
            assert tracker.colors.known == colored and (tracker.state.colors.counts is not None) == colored
    assert np.mean(off[True]) < 0.07 and np.mean(off[True]) < 0.6 * np.mean(off[False]), off


# --- the second pass --------------------------------------------------------------------------------------------------


def error_of(body: ConeBody, poses: np.ndarray, masks: np.ndarray) -> float:
    drawn = draw_silhouettes(body, RIG, poses)
    return float(np.mean([(d != m).sum() / (m > 0).sum() for d, m in zip(drawn, masks, strict=True)]))


def test_second_pass_corrects_a_wrong_body() -> None:
    """A first pass with a body that is too thin; the second fits it to all frames."""
    thin = build_cone_body(scaled(BODY.dimensions, thigh_radius=0.75, chest_half_width=0.85, upper_arm_radius=0.75))
    tracker = RegionTracker(RIG, "z", replace(SETTINGS, adapt=True))
    tracker.start([observe(MASKS[0])], Subject(STATURE, init=init_of(POSES[0]), body=thin))
    first = [tracker.step(observe(m, i)) for i, m in enumerate(MASKS)]
    poses = np.array([e.pose for e in first])
    error = np.array([e.residual for e in first])
    before = error_of(thin, poses, MASKS)
    lost = np.array([False] * 5 + [True])
    result, found, sigma = tracker.second_pass(MASKS, poses, lost, error, STATURE)
    assert error_of(tracker.body, result[:5], MASKS[:5]) < 0.8 * before
    assert found[:5].mean() < 0.8 * error[:5].mean()
    # a lost frame stays as it was
    np.testing.assert_array_equal(result[5], poses[5])
    np.testing.assert_array_equal(found[5], error[5])
    assert (sigma[:5] > 0).all() and (sigma[:5] < 0.1).all() and not sigma[5].any()
    assert tracker.body.dimensions.thigh_radius > thin.dimensions.thigh_radius
    off = [
        np.linalg.norm(tracker.body.skeleton.joints(p) - SKELETON.joints(q), axis=1).mean()
        for p, q in zip(result[:5], POSES[:5], strict=True)
    ]
    assert np.mean(off) < CLOSE_M


def test_second_pass_fits_the_body_if_the_opening_has_many_frames() -> None:
    frames = 80
    tracker = tracker_at(POSES[0], settings=replace(SETTINGS, adapt=True, init_frames=frames))
    masks, poses = (np.repeat(one[:1], frames, axis=0) for one in (MASKS, POSES))
    result, _, _ = tracker.second_pass(masks, poses, np.zeros(frames, bool), np.zeros((frames, 3, 2)), STATURE)
    off = np.linalg.norm(tracker.body.skeleton.joints(result) - SKELETON.joints(poses), axis=-1)
    assert off.mean() < CLOSE_M


def test_second_pass_corrects_the_frames_before_a_limb_was_found() -> None:
    raised = np.array([with_arm(pose, "l", (0.1, 1.0, 0.3), 15.0) for pose in POSES])
    masks = draw_silhouettes(BODY, RIG, raised)
    first = np.concatenate([POSES[:4], raised[4:]])  # until it is found again in frame 4 the arm hangs
    tracker, wrist = tracker_at(POSES[0]), JOINTS.index("wrist_l")

    def told(lost: np.ndarray) -> np.ndarray:
        poses, _, sigma = tracker.second_pass(masks, first, lost, np.zeros((6, 3, 2)), None, keep_body=True)
        assert np.isfinite(sigma).all()
        return np.linalg.norm(SKELETON.joints(poses) - SKELETON.joints(raised), axis=-1)[:, wrist]

    assert told(np.zeros(6, bool)).max() < 0.06
    # nothing passes over a frame that is lost
    assert (told(np.arange(6) == 1) > 0.25).tolist() == [True] * 2 + [False] * 4
    assert (told(np.arange(6) == 3) > 0.25).tolist() == [True] * 4 + [False] * 2


def test_sigma_is_large_if_two_poses_have_similar_costs() -> None:
    """The masks show an arm at both of its places; frames before and after tell of one each."""
    hanging = np.repeat(POSES[:1], 5, axis=0)
    raised = np.array([with_arm(pose, "l", (0.1, 1.0, 0.3), 15.0) for pose in hanging])
    half = draw_silhouettes(BODY, RIG, np.array([hanging[0], raised[0]])).max(axis=0)
    tracker, wrist = tracker_at(POSES[0]), JOINTS.index("wrist_l")

    def sigma(masks: np.ndarray, poses: np.ndarray) -> np.ndarray:
        return tracker.second_pass(masks, poses, np.zeros(5, bool), np.zeros((5, 3, 2)), None, keep_body=True)[2][
            :, wrist
        ]

    one, other = draw_silhouettes(BODY, RIG, np.array([hanging[0], raised[0]]))
    found = sigma(np.array([one, one, half, other, other]), np.concatenate([hanging[:3], raised[3:]]))
    assert (found > 0.1).tolist() == [False, False, True, False, False]
    assert (sigma(np.stack(5 * [half]), hanging) < 0.05).all()


@pytest.mark.parametrize("frames", [1, 3])
def test_modes_as_likely_as_the_pose_add_to_sigma_and_change_no_pose(frames: int) -> None:
    """The masks show an arm at both of its places in all frames; the first pass has chosen one, and kept the other in
    the one in the middle."""
    hanging = np.repeat(POSES[:1], frames, axis=0)
    raised = with_arm(POSES[0], "l", (0.1, 1.0, 0.3), 15.0)
    half = draw_silhouettes(BODY, RIG, np.array([POSES[0], raised])).max(axis=0)
    tracker, wrist = tracker_at(POSES[0]), JOINTS.index("wrist_l")
    arm = next(limb for limb in tracker.limbs if "wrist_l" in [JOINTS[k] for k in limb.joints])
    cheap, dear = np.stack([POSES[0], raised]), np.array([2.0, 0.5])
    modes = np.full((frames, limbs.CANDIDATES, len(raised)), np.nan)
    modes[frames // 2] = limbs.others(POSES[0], POSES[0], [limbs.Modes(arm, cheap, dear)])
    np.testing.assert_array_equal(modes[frames // 2, 0, arm.dofs], raised[arm.dofs])
    assert np.isnan(modes[frames // 2, 1]).all(), "the present pose is no other one"

    def solved(modes: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        masks, lost = np.stack(frames * [half]), np.zeros(frames, bool)
        poses, _, sigma = tracker.second_pass(
            masks, hanging, lost, np.zeros((frames, 3, 2)), None, modes=modes, keep_body=True
        )
        return poses, sigma[:, wrist]

    (alone, before), (poses, sigma) = solved(None), solved(modes)
    np.testing.assert_array_equal(poses, alone)
    assert (sigma > 0.08).all() and (before < 0.06).all()


@pytest.mark.parametrize("place", ["hanging", "raised"])
def test_colors_choose_between_poses_that_the_masks_show_alike(place: str) -> None:
    """The masks show an arm at both of its places in all frames; one of the places has the colours of the trunk."""
    both = {"hanging": POSES[0], "raised": with_arm(POSES[0], "l", (0.1, 1.0, 0.3), 15.0)}
    half = draw_silhouettes(BODY, RIG, np.array(list(both.values()))).max(axis=0)
    tracker, wrist = tracker_at(POSES[0]), JOINTS.index("wrist_l")
    arm = next(limb for limb in tracker.limbs if "wrist_l" in [JOINTS[k] for k in limb.joints])
    modes = np.full((3, limbs.CANDIDATES, len(POSES[0])), np.nan)
    modes[:, 0, arm.dofs] = both["raised"][arm.dofs]
    label = tracker.coarse_grid.render(tracker.body, tracker.world.poses_in(both[place][None])).label[0]
    group = np.append(COLOR_GROUPS.index("torso"), BODY.color_group)[label]  # of label 0: the trunk
    colors = (100 + 400 * group).astype(np.uint16)  # bins that lie apart
    tracker.colors.learn(colors[label > 0].astype(np.int32), label[label > 0])
    masks, lost = np.stack(3 * [half]), np.zeros(3, bool)
    poses, _, sigma = tracker.second_pass(
        masks, np.repeat(POSES[:1], 3, axis=0), lost, np.zeros((3, 3, 2)), None, modes=modes, colors=3 * [colors],
        keep_body=True,
    )  # fmt: skip
    off = np.linalg.norm(SKELETON.joints(poses) - SKELETON.joints(both[place]), axis=-1)[:, wrist]
    assert off.max() < 0.06 and sigma[:, wrist].max() < 0.06


def test_a_mode_that_one_frame_leaves_open_replaces_the_pose_where_it_is_likelier() -> None:
    """The first pass has the arm at a wrong place in all frames, and has found the right one in the first frame."""
    raised = np.array([with_arm(pose, "l", (0.1, 1.0, 0.3), 15.0) for pose in POSES])
    tracker, wrist = tracker_at(POSES[0]), JOINTS.index("wrist_l")
    modes = np.full((6, limbs.CANDIDATES, raised.shape[1]), np.nan)
    arm = next(limb for limb in tracker.limbs if "wrist_l" in [JOINTS[k] for k in limb.joints])
    modes[0, 0, arm.dofs] = raised[0, arm.dofs]
    poses, _, sigma = tracker.second_pass(
        draw_silhouettes(BODY, RIG, raised), POSES, np.zeros(6, bool), np.zeros((6, 3, 2)), None, modes=modes,
        keep_body=True,
    )  # fmt: skip
    off = np.linalg.norm(SKELETON.joints(poses) - SKELETON.joints(raised), axis=-1)[:, wrist]
    assert off.max() < 0.06 and sigma[:, wrist].max() < 0.06


def test_a_person_who_stands_still_is_seen_once_a_second() -> None:
    """Two seconds of the same image, at 15 Hz, say as much as two independent images of the same pose, not as 30."""
    frames, tracker = 30, tracker_at(POSES[0])
    masks, poses = (np.repeat(one[:1], frames, axis=0) for one in (MASKS, POSES))
    lost, residual = np.zeros(frames, bool), np.zeros((frames, 3, 2))
    sigma = tracker.second_pass(masks, poses, lost, residual, None, keep_body=True)[2][frames // 2]
    pose, seen = tracker.world.poses_in(POSES[:1]), tracker.views.pyramid(MASKS[0], 1, False)
    hessian, _ = tracker.equations(seen, pose, tracker.prior(pose, second_pass.NEAR_DEG), tracker.view_m)
    single = np.sqrt(pose_variance(tracker.body.skeleton, pose[0], np.linalg.inv(hessian[0])))
    np.testing.assert_allclose(sigma / single, np.sqrt(0.5), rtol=0.15)


def test_second_pass_finds_legs_that_were_exchanged_in_most_frames() -> None:
    tracker = tracker_at(POSES[0], settings=replace(SETTINGS, search_every=1 / 3))
    legs = pairs(tracker.limbs)[1]
    first = np.array([exchanged_limbs(pose, [legs])[0] for pose in POSES[:4]] + list(POSES[4:]))
    masks = draw_silhouettes(BODY, RIG, POSES)
    poses, _, sigma = tracker.second_pass(masks, first, np.zeros(6, bool), np.zeros((6, 3, 2)), None, keep_body=True)
    moved = [joint for leg in legs for joint in leg.joints]
    off = np.linalg.norm(SKELETON.joints(poses) - SKELETON.joints(POSES), axis=-1)[:, moved]
    before = np.linalg.norm(SKELETON.joints(first) - SKELETON.joints(POSES), axis=-1)[:, moved]
    assert before[:4].mean() > 0.15 and off.max() < 0.06 and np.isfinite(sigma).all()


def test_a_long_recording_is_solved_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = tracker_at(POSES[0])

    def solved() -> np.ndarray:
        found = tracker.second_pass(MASKS, POSES + 0.01, np.zeros(6, bool), np.zeros((6, 3, 2)), None, keep_body=True)
        assert (found[2] > 0).all()
        return SKELETON.joints(found[0])

    whole, off = solved(), []
    monkeypatch.setattr(second_pass, "WINDOW", 2)
    for overlap in (4, 3, 0):
        monkeypatch.setattr(second_pass, "OVERLAP", overlap)
        off.append(np.abs(solved() - whole).max())
    assert off[0] < 1e-9, "every piece has all frames"
    assert off[1] < off[2] < 0.05, "a frame depends on its neighbours, less on those far away"


def test_second_pass_keeps_a_given_body() -> None:
    tracker = tracker_at(POSES[0])
    poses, error = POSES[:3] + 0.01, np.full((3, 3, 2), 0.05)
    result, found, _ = tracker.second_pass(MASKS[:3], poses, np.zeros(3, bool), error, STATURE, keep_body=True)
    assert tracker.body is BODY
    assert result.shape == poses.shape and found.shape == (3, 3, 2) and (found < 0.1).all()
    assert np.abs(result - poses).max() > 1e-3
    same, unchanged, known = tracker.second_pass(MASKS[:3], poses, np.ones(3, bool), error, STATURE)
    np.testing.assert_array_equal(same, poses)
    np.testing.assert_array_equal(unchanged, error)
    assert not known.any()


def test_legs_that_took_each_other_s_place_are_found_by_the_routine_search() -> None:
    pose = POSES[0]
    off = {}
    for every in (0.0, 0.3):
        tracker = tracker_at(pose, settings=replace(SETTINGS, search_every=every))
        _, legs = pairs(tracker.limbs)
        tracker.start_at(exchanged_limbs(pose, [legs])[0])
        moved = [joint for leg in legs for joint in leg.joints]
        off[every] = errors(tracker.step(observe(MASKS[0], 1)), pose)[moved].max()
    assert off[0.0] > 0.2  # a descent alone does not exchange them
    assert off[0.3] < CLOSE_M


@pytest.mark.parametrize("frames", [range(7), range(6, -1, -1)], ids=["forwards", "backwards"])
def test_routine_search_runs_at_intervals(frames: range) -> None:
    tracker = tracker_at(POSES[0], settings=replace(SETTINGS, search_every=1 / 3))
    searched = [bool(tracker.step(observe(MASKS[0], i)).iterations[1]) for i in frames]
    assert np.flatnonzero(searched).tolist() == [0, 5]


# --- the spread over the modes of a limb ------------------------------------------------------------------------------


def test_spread_counts_each_mode_once_and_the_pose_that_was_left() -> None:
    raised = with_arm(POSES[0], "l", (0.0, 0.3, 1.0), 10.0)
    tracker = tracker_at(POSES[0])
    arm = next(limb for limb in tracker.limbs if limb.name == "arm_l")
    one, twice = (
        [limbs.Modes(arm, np.array([raised] * count), np.full(count, np.log(3.0)))] for count in (1, 2)
    )  # its probability is 1/4
    square = ((SKELETON.joints(raised) - SKELETON.joints(POSES[0])) ** 2).sum(axis=1) / 3
    assert np.sqrt(square[JOINTS.index("wrist_l")]) > 0.3
    for found in (one, twice):
        np.testing.assert_allclose(limbs.spread(SKELETON, POSES[0], POSES[0], found), square / 4)
    # if it was chosen nevertheless, the pose before has a probability of 3/4
    np.testing.assert_allclose(limbs.spread(SKELETON, raised, POSES[0], one), 0.75 * square)
    # beside a mode that is likelier by far, the pose before counts nothing
    likelier = limbs.Modes(arm, raised[None], np.array([-2000.0]))
    assert not limbs.spread(SKELETON, raised, POSES[0], [likelier]).any()
    assert not limbs.spread(SKELETON, POSES[0], POSES[0], []).any()
