"""Whose pixels are whose, by depth and by distance in the image."""

from __future__ import annotations

import numpy as np
import pytest

from tests.model.ring import ring_of_cameras
from tk.kernels.mask_values import OTHERS
from tk.kernels.raycast import FAR, Cast
from tk.model.cues.ray_costs import RayGrid
from tk.trackers.protocol import Observation
from tk.trackers.sharing import NOBODY, UNCLEAR, PixelOwners, assign

RIG = ring_of_cameras(2, width=160, height=200)
GRID = RayGrid(RIG, 50)


def block(left: int, right: int, depth_m: float) -> Cast:
    """Return a body that covers these columns of the grid at one depth."""
    label = np.zeros(GRID.rays.shape[:3], np.uint8)
    label[:, 10:40, left:right] = 1
    return Cast(label, np.where(label > 0, np.float32(depth_m), np.float32(FAR)))


def owners(*shapes: Cast | None) -> PixelOwners:
    return assign(RIG, GRID, shapes)


def test_nearer_person_owns_pixels_that_two_cover() -> None:
    found = owners(block(5, 20, 3.0), block(15, 30, 2.0))
    assert (found.owner[:, 20, 8] == 0).all() and (found.owner[:, 20, 15:20] == 1).all()


def test_pixels_are_unclear_where_two_people_are_equally_near() -> None:
    found = owners(block(5, 20, 3.0), block(15, 30, 3.05))
    assert (found.owner[:, 20, 15:20] == UNCLEAR).all()
    beside = owners(block(5, 15, 3.0), block(25, 35, 3.0))
    assert (beside.owner[:, 20, 19:21] == UNCLEAR).any() and (beside.owner[:, 20, 24] == 1).all()


def test_pixels_far_from_everybody_belong_to_a_person_whose_place_is_unknown() -> None:
    found = owners(block(0, 3, 1.0), None)
    far = GRID.rays.shape[2] - 1
    if (found.owner[:, 20, far] != NOBODY).all():
        pytest.fail("the last column is more than half a metre away")
    frame = Observation(0, np.zeros((2, 200, 160, 3), np.uint8), np.full((2, 200, 160), 255, np.uint8))
    known, lost = (found.share(frame, 1, unknown).masks for unknown in (False, True))
    assert (known[:, 80, -1] == OTHERS).all() and (lost[:, 80, -1] == 255).all()
    assert (found.unexplained(frame.masks)[:, 80, -1] == 255).all()


def test_three_people_are_assigned_as_by_sorting() -> None:
    rng = np.random.default_rng(3)
    shapes = [block(5 * k, 5 * k + 14, 3.0) for k in range(3)]
    shapes = [Cast(s.label, np.where(s.label > 0, s.depth + rng.random(s.depth.shape), s.depth)) for s in shapes]
    shapes = [Cast(s.label, s.depth.astype(np.float32)) for s in shapes]
    depth = np.sort([s.depth for s in shapes], axis=0)
    covered = depth[1] < FAR
    found = owners(*shapes).owner
    nearest = np.argmin([s.depth for s in shapes], axis=0)
    clear = covered & (depth[1] - depth[0] > 0.09)
    np.testing.assert_array_equal(found[clear], nearest[clear])
    assert (found[covered & (depth[1] - depth[0] < 0.07)] == UNCLEAR).all()
