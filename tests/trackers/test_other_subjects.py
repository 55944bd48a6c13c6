"""Pixels that show another person, in front of the one who is tracked."""

from __future__ import annotations

import numpy as np
import pytest

from tests.model.figures import draw_silhouettes
from tests.model.ring import ring_of_cameras
from tests.trackers.walker import BODY, STATURE, errors, observe, walk
from tk.kernels.mask_values import OTHERS
from tk.kernels.silhouette import find_edgels
from tk.model.cues.ray_costs import Evidence, RayGrid
from tk.model.masks.silhouettes import Views
from tk.model.setup import Subject
from tk.settings import SilhouetteSettings
from tk.trackers.contour_finder import LINE_SEARCH
from tk.trackers.region import RegionTracker

RIG = ring_of_cameras(3, width=160, height=200)
POSES = walk(3)
MASKS = draw_silhouettes(BODY, RIG, POSES)
# in the first camera another person hides the legs
IN_FRONT = np.zeros(MASKS.shape[1:], bool)
IN_FRONT[0, RIG.frame_shape[0] * 60 // 100 :] = True
MARKED, CUT = (np.where(IN_FRONT, np.uint8(value), MASKS) for value in (OTHERS, 0))


def test_body_part_on_another_person_costs_nothing() -> None:
    grid = RayGrid(RIG, 50)
    found = []
    for masks in (MARKED, CUT):
        evidence = Evidence.of(grid, masks[0])
        cost, met = evidence.cast(BODY, POSES[:1])
        found.append(evidence.residual(met.label[0]).sum(axis=1))
        assert cost == pytest.approx(found[-1].mean(), abs=1e-6)
    marked, cut = found
    assert marked[0] < 0.1 < cut[0]
    np.testing.assert_array_equal(marked[1:], cut[1:])


def test_no_contour_is_searched_at_another_person() -> None:
    views, border = Views(RIG), int(np.argmax(IN_FRONT[0].any(axis=1)))
    lowest = []
    for masks in (MARKED, CUT):
        pyramid = views.pyramid(masks[0], 3, True)
        assert all((level == OTHERS).any() == (masks is MARKED) for level in pyramid.masks)
        for scale in range(3):
            edgels = find_edgels(BODY.arrays, views.at(pyramid, scale), POSES[:1], LINE_SEARCH)
            found = (edgels.pixel + edgels.distance[:, None] * edgels.normal)[edgels.view == 0, 1]
            assert len(found) > 10
            lowest.append(found.max() - border)
    marked, cut = np.reshape(lowest, (2, 3))
    assert (marked[:2] < -1).all() and (cut[:2] > -1).all()  # pixels


def test_person_behind_another_one_is_tracked() -> None:
    tracker = RegionTracker(RIG, "z", SilhouetteSettings(adapt=False))
    tracker.start([observe(MASKS[0])], Subject(STATURE, body=BODY))
    tracker.step(observe(MASKS[0]))
    for i in (1, 2):
        estimate = tracker.step(observe(MARKED[i], i))
        assert estimate.status == "tracked" and errors(estimate, POSES[i]).mean() < 0.03
