"""When a frame is suspect or without sigma."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tk.io.results.codec import decode, encode
from tk.io.results.status import Status
from tk.model.body import gait_poses as gait
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.skeleton import build_skeleton
from tk.model.cues.part_colors import RATE
from tk.trackers.judgement import (
    STATES,
    TORN,
    UNKNOWN_AFTER,
    WRONG,
    Cameras,
    FrameEvidence,
    FrameJudge,
    JudgeState,
    Match,
    impossible,
    judge_frames,
    likelihoods,
)
from tk.trackers.protocol import Estimate
from tk.trackers.reason import CONSEQUENCES, Reason, is_lost, known_sigma, report_frames, status_of
from tk.trackers.residual import LEVEL, RECENT, displacement, variance_factor

VIEWS = 4


def judged(
    residual: np.ndarray,
    found: dict[int, Reason] | None = None,
    one_sided: bool = False,
    whole: bool = True,
    begins: int | None = None,
) -> np.ndarray:
    """Return the reasons of frames with these residuals (F, V, 2) and first reasons; in ``begins`` the person is found
    elsewhere."""
    F = len(residual)
    first = np.zeros(F, np.uint8)
    for frame, reason in (found or {}).items():
        first[frame] = reason
    posed = np.array([not is_lost(Reason(reason)) for reason in first])
    start = np.arange(F) == begins
    return judge_frames(FrameEvidence(first, posed, start, residual, np.full(F, not one_sided)), 0.02, whole)


def suspect(residual: np.ndarray) -> np.ndarray:
    return judged(residual, whole=False) == Reason.CONTRADICTED


def residuals(missing: float, surplus: float, frames: int = 3 * RECENT) -> np.ndarray:
    """(F, V, 2) of equal frames."""
    return np.tile([missing, surplus], (frames, VIEWS, 1)).astype(float)


def test_residual_that_is_high_from_the_first_frame_contradicts_the_pose() -> None:
    assert suspect(residuals(0.15, 0.2)).all()
    assert suspect(residuals(0.15, 0.2, frames=1)).all()
    assert not suspect(residuals(LEVEL / 2, LEVEL / 2)).any()


def test_second_person_or_torn_mask_contradicts_no_pose() -> None:
    somebody_else = residuals(0.04, 0.05)
    somebody_else[:, 0, 1] = 0.8
    assert not suspect(somebody_else).any()
    assert not suspect(residuals(0.3, 0.01)).any()


def test_furniture_that_hides_most_of_a_person_from_one_camera_contradicts_no_pose() -> None:
    hidden = residuals(0.07, 0.04)
    hidden[:, 0] = 0.95, 0.11
    assert not suspect(hidden).any()
    hidden[:, :3] = 0.3, 0.3  # a wrong pose is wrong in most views
    assert suspect(hidden).all()


def test_only_frames_about_a_lasting_high_residual_are_suspect() -> None:
    short, lasting = residuals(0.04, 0.05), residuals(0.04, 0.05)
    short[4] = 0.2
    lasting[5:11] = 0.25
    assert not suspect(short).any()
    found = np.flatnonzero(suspect(lasting))
    assert set(range(5, 11)) <= set(found) <= set(range(2, 14))


@pytest.mark.parametrize("lost", [True, False])
@pytest.mark.parametrize("whole", [True, False])
def test_frames_before_a_loss_or_a_cut_are_no_evidence_about_those_after_it(lost: bool, whole: bool) -> None:
    residual = residuals(0.04, 0.05, 20)
    residual[:8] = 0.4
    found = {8: Reason.NOBODY} if lost else {}
    reasons = judged(residual, found, whole=whole, begins=9 if lost else 8)
    assert (reasons[:8] == Reason.CONTRADICTED).all() and not reasons[9 if lost else 8 :].any()
    if whole:  # a residual that stays high counts from its first frame, not from before the loss
        high = judged(residuals(0.04, 0.05, 40), {10: Reason.HIGH, **({8: Reason.NOBODY} if lost else {})}, begins=9)
        assert np.flatnonzero(high == Reason.HIGH).tolist() == [9, 10]


def test_frames_before_a_cut_do_not_count() -> None:
    """In the first frames of a recording, and in the first ones after a cut, fewer frames count."""
    half = 0.235 / 2
    assert suspect(residuals(half, half, RECENT)).all() and suspect(residuals(half, half, 1)).all()
    assert not judged(residuals(half / 2, half / 2, RECENT + 2), whole=False, begins=RECENT)[RECENT:].any()


def test_unmeasured_frames_and_views_do_not_count() -> None:
    residual = residuals(0.15, 0.2)
    residual[2], residual[:, 1] = np.nan, np.nan
    assert suspect(residual).tolist() == [i != 2 for i in range(len(residual))]
    assert np.isnan(displacement(residual)[2]) and variance_factor(residual)[2] == 1.0


def test_sigma_is_unknown_from_the_first_frame_with_a_high_residual_on() -> None:
    """The first pass knows only after some frames that the residual stays high."""
    high = {12: Reason.HIGH, 13: Reason.HIGH}
    for whole, first in ((True, 13 - UNKNOWN_AFTER), (False, 12)):
        reasons = judged(residuals(0.04, 0.05, 20), high, whole=whole)
        assert np.flatnonzero(reasons == Reason.HIGH).tolist() == list(range(first, 14))
        assert set(reasons.tolist()) == {Reason.NONE, Reason.HIGH}


def test_all_frames_with_a_pose_are_suspect_if_most_are_contradicted() -> None:
    for count, all_of_them in ((0, False), (10, False), (30, True)):
        residual = residuals(0.025, 0.025, 40)
        residual[:count] = 0.25
        reasons = judged(residual, {39: Reason.JUMPS})
        assert (reasons[:count] == Reason.CONTRADICTED).all() and reasons[39] == Reason.JUMPS
        assert (reasons[20:39] == Reason.CONTRADICTED).all() == all_of_them
        notes: list[str] = []
        report_frames(np.arange(40), reasons, notes.append)
        assert len(notes) == 1 + bool(count) and "it jumps: lost, frame 39" in notes[0]


def test_first_reason_counts() -> None:
    found = {0: Reason.UNCLEAR, 1: Reason.CUT, 2: Reason.CONTRADICTED}
    assert judged(residuals(0.3, 0.3, 4), found).tolist() == [Reason.UNCLEAR, *3 * [Reason.CONTRADICTED]]
    right = judged(residuals(0.02, 0.02, 4), found, whole=False)
    assert right.tolist() == [Reason.UNCLEAR, Reason.CUT, Reason.NONE, Reason.NONE]
    assert (judged(residuals(0.02, 0.02, 4), one_sided=True) == Reason.ONE_SIDED).all()


def test_numbers_of_a_tracker_have_one_reason() -> None:
    assert Match(0.2, 0.4).reason == Reason.NONE
    assert Match(np.inf, 0.4).reason == Reason.NOBODY
    assert Match(0.5, 0.4, lost_for=3, excess=9.0).reason == Reason.UNEXPLAINED
    assert Match(0.2, 0.4, excess=3.0).reason == Reason.NONE
    for again in (Match(0.2, 0.4, 1.5, cut=True), Match(0.2, 0.4, 1.5, lost_for=1), Match(0.2, 0.4, 1.5, lost_for=99)):
        assert again.reason == Reason.STILL_HIGH
    later = Match(0.2, 0.4, 3.0, cut=True, refused=round(1 / RATE), false_alarm=0.02)
    assert later.reason == Reason.CUT and replace(later, excess=4.0).reason == Reason.STILL_HIGH
    assert replace(later, high_for=UNKNOWN_AFTER).reason == Reason.HIGH
    assert replace(later, high_for=UNKNOWN_AFTER, depth=False).reason == Reason.ONE_SIDED


def estimate(joints: np.ndarray, residual: float = 0.05, **fields: Any) -> Estimate:
    whole = np.full((VIEWS, 2), residual / 2)
    given = {"origin": Status.TRACKED, "residual": whole, "deviation": np.full(15, 0.02), **fields}
    return Estimate(np.zeros(9), joints, objective=0.1, iterations=np.zeros(1, np.int32), timing={}, **given)


def frame_judge(fps: float = 15.0) -> FrameJudge:
    tracker: Any = SimpleNamespace(tracks_among_others=False)
    return FrameJudge(tracker, VIEWS, fps, 0.02)


SKELETON = build_skeleton(BodyDimensions.from_stature(1.75), "z")


def joints(x: float = 0.0, z: float = 0.95, yaw_deg: float = 0.0, phase: float = 0.0) -> np.ndarray:
    pose = gait.walking_pose(SKELETON, phase % 1)
    pose[:3] = x, 0.0, z
    pose[SKELETON.index("torso_yaw")] = np.radians(yaw_deg)
    return SKELETON.joints(pose)


def test_walking_turning_jumping_and_sprinting_are_possible() -> None:
    before = None
    for i in range(30):
        now = joints(0.5 * i, 0.95 + 0.5 * max(0.0, np.sin(i / 3)), 40.0 * i, i / 10)
        assert impossible(now, before, 1 / 15) == Reason.NONE, i
        before = now


@pytest.mark.parametrize(("then", "reason"), [(joints(x=3.0), Reason.JUMPS), (joints() * np.nan, Reason.NO_NUMBERS)])
def test_impossible_pose_is_lost_and_not_compared_with_the_next(then: np.ndarray, reason: Reason) -> None:
    judge = frame_judge()
    assert judge.judge(0, estimate(joints())).status == "tracked"
    lost = judge.judge(1, estimate(then))
    assert (lost.found, lost.reason, lost.status) == (reason, reason, "lost")
    assert judge.judge(2, estimate(joints(x=5.0))).status == "tracked"


def test_person_who_is_recovered_may_be_anywhere_and_keeps_this_status_unless_suspect() -> None:
    judge = frame_judge(60.0)
    for frame in range(RECENT):
        assert judge.judge(frame, estimate(joints(), 0.6)).status == "suspect"
    cut = judge.judge(RECENT, estimate(joints(x=5.0), origin=Status.RECOVERED, found=Reason.CUT))
    assert (cut.status, cut.reason) == ("recovered", Reason.CUT)
    suspected = judge.judge(RECENT + 1, estimate(joints(x=5.0), 2.0, origin=Status.INITIALISED))
    assert suspected.status == "suspect" and suspected.origin == Status.INITIALISED


def test_judge_that_is_restored_says_the_same() -> None:
    judge, again = frame_judge(), frame_judge()
    judge.judge(4, estimate(joints(), 0.3))
    again.state = decode(JudgeState, encode(judge.state))
    for then in (estimate(joints(x=3.0)), estimate(joints(x=0.1), 0.3)):
        assert again.judge(5, then).reason == judge.judge(5, then).reason


def test_sigma_is_kept_as_computed_and_hidden_by_the_reason() -> None:
    suspected = frame_judge().judge(0, estimate(joints(), 0.9))
    assert suspected.reason == Reason.CONTRADICTED and suspected.sigma is not None and suspected.deviation is not None
    assert np.isnan(suspected.sigma).all() and (suspected.deviation == 0.02).all()
    hidden = known_sigma(np.ones((len(Reason), 15)), np.arange(len(Reason)))
    known = [then.sigma for then in CONSEQUENCES.values()]
    assert np.isfinite(hidden).all(axis=1).tolist() == known and np.isnan(hidden).all(axis=1).tolist() == [
        not one for one in known
    ]


def test_status_follows_from_how_the_pose_was_found_and_from_the_reason() -> None:
    found = status_of(
        np.array([Status.RECOVERED, Status.RECOVERED, Status.INITIALISED, Status.TRACKED, Status.ABSENT]),
        np.array([Reason.NONE, Reason.UNCLEAR, Reason.HIGH, Reason.JUMPS, Reason.NOBODY]),
    )
    assert found.tolist() == [Status.RECOVERED, Status.SUSPECT, Status.INITIALISED, Status.LOST, Status.ABSENT]


def test_every_reason_has_a_consequence_and_who_has_no_pose_has_no_sigma() -> None:
    assert list(CONSEQUENCES) == list(Reason)
    assert not any(then.sigma for then in CONSEQUENCES.values() if then.status in (Status.LOST, Status.SUSPECT))


CAMERAS, SPREAD = 4, np.full(4, 0.03)
EVERYBODY = np.ones(CAMERAS, np.bool_)


def areas(missing: float, surplus: float, others: float = 0.0) -> np.ndarray:
    """Return (C, 3) the likelihoods of camera 1's areas, in spreads; those of the others have this excess."""
    excess = np.full((CAMERAS, 2), others)
    excess[1] = missing, surplus
    return likelihoods(excess, SPREAD)


def follow(missing: float, surplus: float, others: float, frames: int = 30) -> tuple[list[str | None], int]:
    """Judge camera 1 in each frame: areas with it, and the excess of the others that vanishes without it. Return the
    faults, and its state in the end."""
    cameras, faults = Cameras(CAMERAS, 15.0), []
    best, rest = areas(0.0, 0.0), EVERYBODY & (np.arange(CAMERAS) != 1)
    for _ in range(frames):
        with_it, without = areas(missing, surplus, others), areas(missing, surplus)
        if cameras.accused(with_it, best, EVERYBODY) == 1:
            faults.append(cameras.judge(1, rest, with_it, without))
        else:
            faults.append(None)
            cameras.weigh(EVERYBODY, with_it)
        if faults[-1] == WRONG:
            break
    return faults, int(cameras.states[1])


@pytest.mark.parametrize(("missing", "surplus"), [(0.0, 8.0), (10.0, 0.0), (4.0, 4.0)])
def test_a_poor_mask_is_used_while_the_others_fit_as_well_with_it(missing: float, surplus: float) -> None:
    """Something that the person carries hides a part of the body, or is taken for one."""
    faults, state = follow(missing, surplus, 0.0)
    assert not any(faults) and state == 0


def test_a_camera_is_wrong_if_the_others_fit_better_without_it() -> None:
    faults, state = follow(10.0, 10.0, 3.0)
    assert (faults, STATES[state]) == ([WRONG], WRONG)
    # a little better in each of several frames
    faults, state = follow(8.0, 8.0, 0.5)
    assert faults[0] is None and STATES[state] == WRONG


def test_a_torn_mask_is_left_out_in_its_frames_only() -> None:
    cameras, rest = Cameras(CAMERAS, 15.0), EVERYBODY & (np.arange(CAMERAS) != 1)
    assert cameras.judge(1, rest, areas(7.0, 0.0, 2.0), areas(7.0, 0.0)) == TORN
    assert cameras.states[1] == 0
    for _ in range(10):
        assert cameras.accused(areas(0.0, 0.0), areas(0.0, 0.0), EVERYBODY) is None
        cameras.weigh(EVERYBODY, areas(0.0, 0.0))
    assert not cameras.states.any()


def test_a_wrong_camera_is_used_again_when_its_residual_is_normal() -> None:
    cameras = Cameras(CAMERAS, 15.0)
    cameras.accuse(1)
    for _ in range(5):
        cameras.weigh(~EVERYBODY | (np.arange(CAMERAS) == 1), areas(9.0, 9.0))
        assert STATES[cameras.states[1]] == WRONG
    for _ in range(3):
        cameras.weigh(EVERYBODY, areas(0.0, 0.0))
    assert not cameras.states.any()


def test_a_wrong_camera_is_still_wrong_after_its_image_was_covered() -> None:
    cameras = Cameras(CAMERAS, 15.0)
    cameras.accuse(1)
    states = []
    for fault in ("blank", "blank", None):
        cameras.look([None, fault, *[None] * (CAMERAS - 2)])
        states.append((STATES[cameras.states[1]], bool(cameras.unfit[1])))
    assert states == [("blank", True), ("blank", True), (WRONG, False)]
    assert not np.delete(cameras.states, 1).any()
