"""Lost frames are tracked backwards from the frames after them: silhouettes drawn from the tracker's own body."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.model.figures import draw_silhouettes
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, NAMES, STATURE, errors, observe, walk
from tk.io.captures.mask_store import MaskStore
from tk.model.setup import InitPose, Subject
from tk.run.second_run import Run, shown_again, track_back
from tk.settings import SilhouetteSettings
from tk.trackers.judgement import STATES
from tk.trackers.protocol import Estimate
from tk.trackers.region import RegionTracker

RIG = ring_of_cameras(3, width=160, height=200)
POSES = walk(7)
MASKS = draw_silhouettes(BODY, RIG, POSES)
NOBODY = np.zeros_like(MASKS[0])
CLOSE_M = 0.03
WRONG, UNSEEN = STATES.index("wrong"), STATES.index("unseen")


def tracked_back(
    lost: list[int], frames: np.ndarray, unseen_in: int | None = None, by: int = len(RIG)
) -> dict[int, Estimate]:
    """What is found in the lost rows of a run; it has these frames' masks, and nowhere a pose in a lost one. In one row
    the first cameras, ``by`` of them, see nobody."""
    tracker, store = RegionTracker(RIG, "z", SilhouetteSettings(adapt=False)), MaskStore()
    init = InitPose({}, dict(zip(NAMES, POSES[0], strict=True)), None, STATURE)
    tracker.start([observe(MASKS[0])], Subject(init=init, body=BODY))
    for row, (number, masks) in enumerate(zip(frames.tolist(), MASKS, strict=True)):
        store.put(number, np.concatenate([NOBODY[:by], masks[by:]]) if row == unseen_in else masks)
    is_lost = np.isin(np.arange(len(POSES)), lost)
    poses = np.where(is_lost[:, None], np.nan, POSES)
    residual = np.where(is_lost[:, None, None], np.nan, np.full((len(POSES), 3, 2), 0.02))
    states = np.where(is_lost[:, None], np.full(len(RIG), WRONG, np.uint8), 0)
    return track_back(Run(tracker, store, frames, poses, is_lost, residual, states), {})


@pytest.mark.parametrize("lost", [[0], [2, 3], [0, 1, 3]])
def test_the_person_is_found_from_the_frames_after_a_stretch(lost: list[int]) -> None:
    found = tracked_back(lost, np.arange(10, 17))
    assert sorted(found) == [10 + row for row in lost]
    for number, estimate in found.items():
        assert errors(estimate, POSES[number - 10]).mean() < CLOSE_M
        assert estimate.status == "tracked" and estimate.cameras is not None and not estimate.cameras.any()


@pytest.mark.parametrize(("by", "found"), [(1, [1, 2, 3, 4]), (2, [3, 4]), (3, [3, 4])])
def test_frames_before_one_that_fewer_than_two_cameras_see_stay_lost(by: int, found: list[int]) -> None:
    estimates = tracked_back([1, 2, 3, 4], np.arange(7), unseen_in=2, by=by)
    assert sorted(estimates) == found
    if by == 1:
        np.testing.assert_array_equal(estimates[2].cameras, [UNSEEN, 0, 0])


def test_no_frame_is_tracked_over_a_gap_or_after_the_end() -> None:
    assert not tracked_back([2, 6], np.array([0, 1, 2, 9, 10, 11, 12]))


def test_what_images_show_again_leaves_out_the_frames_in_which_the_person_is_absent() -> None:
    store = MaskStore()
    for number, masks in enumerate(MASKS):
        store.put(number, masks)
    images: Any = [SimpleNamespace(index=n, halved=np.zeros((3, 1, 1, 3), np.uint8), time=n / 30) for n in range(7)]
    marked = np.zeros((3, 5, 4))
    frames = list(shown_again(images, np.array([0, 1, 5]), store, {5: marked}))
    assert [frame.index for frame in frames] == [0, 1, 5]
    np.testing.assert_array_equal(frames[2].masks, MASKS[5])
    assert frames[0].landmarks is None and frames[2].landmarks is not None
