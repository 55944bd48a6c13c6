"""Pixels that show another subject, in front of the one that is tracked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, STATURE, errors, observe, walk
from tk.model.cues.ray_costs import Evidence, RayGrid
from tk.model.masks.silhouettes import draw_silhouettes
from tk.settings import SilhouetteSettings
from tk.trackers.region import RegionTracker

RIG = ring_of_cameras(3, width=160, height=200)
POSES = walk(3)
MASKS = draw_silhouettes(BODY, RIG, POSES)
# another subject hides the legs in the first camera
OTHERS = np.zeros(MASKS.shape[1:], bool)
OTHERS[0, RIG.frame_shape[0] * 55 // 100 :] = True
HIDDEN = np.where(OTHERS, np.uint8(0), MASKS)


def test_a_body_part_on_another_subject_costs_nothing() -> None:
    grid, group = RayGrid(RIG, 50), np.zeros(len(BODY.parts), np.int32)
    marked, unmarked = (Evidence.of(grid, HIDDEN[0], others=o) for o in (OTHERS, None))
    (with_others, _), (without, _) = (e.cast(BODY, group, POSES[:1]) for e in (marked, unmarked))
    assert with_others[0, 0] < 0.1 < without[0, 0]
    np.testing.assert_array_equal(with_others[0, 1:], without[0, 1:])


def test_a_subject_behind_another_one_is_tracked() -> None:
    tracker = RegionTracker(RIG, "z", SilhouetteSettings(adapt=False))
    tracker.start([observe(MASKS[0])], STATURE, None, BODY)
    tracker.step(observe(MASKS[0]))
    for i in (1, 2):
        estimate = tracker.step(replace(observe(HIDDEN[i], i), others=OTHERS))
        assert estimate.status == "tracked" and errors(estimate, POSES[i]).mean() < 0.03
