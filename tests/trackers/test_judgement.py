"""When a frame is suspect or without sigma."""

from __future__ import annotations

import numpy as np

from tk.io.results.status import Status
from tk.kernels.mask_values import OTHERS
from tk.trackers.camera_monitor import touched_by_others
from tk.trackers.judgement import (
    CONSEQUENCES,
    UNKNOWN_AFTER,
    FrameEvidence,
    Reason,
    is_status,
    judge_frames,
    likelihoods,
    report_frames,
)
from tk.trackers.residual import LEVEL, RECENT, displacement, variance_factor

VIEWS = 4


def judged(
    residual: np.ndarray, found: dict[int, Reason] | None = None, one_sided: bool = False, whole: bool = True
) -> np.ndarray:
    """Return the reasons of frames with these residuals (F, V, 2) and first reasons."""
    F = len(residual)
    first = np.zeros(F, np.uint8)
    for frame, reason in (found or {}).items():
        first[frame] = reason
    posed = ~is_status(first, Status.LOST)
    return judge_frames(FrameEvidence(first, posed, residual, np.full(F, not one_sided)), 0.02, whole)


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


def test_only_frames_about_a_lasting_high_residual_are_suspect() -> None:
    short, lasting = residuals(0.04, 0.05), residuals(0.04, 0.05)
    short[4] = 0.2
    lasting[5:11] = 0.25
    assert not suspect(short).any()
    found = np.flatnonzero(suspect(lasting))
    assert set(range(5, 11)) <= set(found) <= set(range(2, 14))


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


def test_every_reason_has_a_consequence_and_who_has_no_pose_has_no_sigma() -> None:
    assert list(CONSEQUENCES) == list(Reason)
    assert not any(then.sigma for then in CONSEQUENCES.values() if then.status in (Status.LOST, Status.SUSPECT))


def test_a_camera_in_which_people_touch_is_not_blamed_for_mixed_pixels() -> None:
    """Missing and surplus area as of a wrong camera: pixels of two people may have been taken for one another's."""
    excess, spread = np.array([[9.0, 9.0]] * 2), np.full(2, 0.03)
    apart, touched = likelihoods(excess, spread, np.array([False, True]))
    assert apart[1] - apart[0] > 20.0
    assert touched[1] - touched[0] < 5.0
    np.testing.assert_allclose(likelihoods(excess * 0.0, spread, True), likelihoods(excess * 0.0, spread), atol=0.01)


def test_others_touch_the_person_where_their_pixels_are_neighbours() -> None:
    masks = np.zeros((3, 8, 12), np.uint8)
    masks[:, 2:6, 1:4] = 255
    masks[0, 2:6, 4:7] = OTHERS
    masks[1, 2:6, 6:9] = OTHERS
    assert touched_by_others(masks).tolist() == [True, False, False]
