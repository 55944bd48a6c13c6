"""Masks of several cameras against the hull of the others: drawn silhouettes of a body, then spoilt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.model.ring import ring_of_cameras
from tk.model.body import gait_poses as gait
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume
from tk.model.masks.mask_agreement import INCONSISTENT, MaskAgreement
from tk.model.masks.silhouettes import draw_silhouettes

RIG = ring_of_cameras(5, 240, 240)
VOLUME = Volume((0.0, 0.0, 1.0), (2.4, 2.4, 2.2))


@pytest.fixture(scope="module")
def masks() -> np.ndarray:
    """(3, 5, 240, 240): a walker who goes along y."""
    body = build_cone_body(BodyDimensions.from_stature(1.75), "z", "full")
    poses = []
    for i in range(3):
        pose = gait.walking_pose(body.skeleton, i / 3)
        pose[:3] = 0.0, 0.2 * i - 0.2, 0.95
        poses.append(pose)
    return draw_silhouettes(body, RIG, np.array(poses))


def compare(masks: np.ndarray, rig: Rig = RIG):
    return MaskAgreement(rig, VOLUME).compare(list(masks))


def test_exact_masks_agree(masks: np.ndarray) -> None:
    found = compare(masks)
    assert found.odd is None and found.inconsistent == () and found.closes.all()
    assert found.disagreement < 0.01
    np.testing.assert_array_equal(found.shift_px, 0.0)
    assert 1.6 < found.extent_m < 2.1


def test_turned_camera_is_identified_with_its_shift(masks: np.ndarray) -> None:
    turn = cv2.Rodrigues(np.radians([0.0, 3.0, 0.0]))[0]
    cameras = list(RIG)
    cameras[3] = replace(cameras[3], rotation=turn @ cameras[3].rotation, translation=turn @ cameras[3].translation)
    found = compare(masks, Rig(tuple(cameras)))
    assert found.odd == 3 and found.inconsistent == (3,)
    off = RIG[3].matrix[0, 0] * np.tan(np.radians(3.0))
    # the hull of the others has room for some of it
    assert 0.5 * off < np.hypot(*found.shift_px[3]) <= off + 3
    assert "turned" in found.reason(3)
    assert np.delete(found.own, 3).max() < INCONSISTENT / 2


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda m: np.roll(m, 60, axis=-1) | m, "something else"),
        (lambda m: np.where(np.arange(240)[:, None] > 120, m, 0).astype(np.uint8), "miss a part"),
    ],
    ids=["somebody beside", "half of the person missing"],
)
def test_mask_that_is_too_large_or_too_small_is_identified(
    masks: np.ndarray, spoil: Callable[[np.ndarray], np.ndarray], reason: str
) -> None:
    spoilt = masks.copy()
    spoilt[:, 2] = spoil(masks[:, 2])
    found = compare(spoilt)
    assert found.inconsistent == (2,)
    assert reason in found.reason(2)


def test_empty_masks_have_no_hull(masks: np.ndarray) -> None:
    found = compare(np.zeros_like(masks))
    assert not found.closes.any() and found.odd is None and np.isnan(found.extent_m)
    only = np.zeros_like(masks)
    only[:, 0] = masks[:, 0]
    assert not compare(only).closes.any()


def test_empty_mask_in_one_frame_is_ignored(masks: np.ndarray) -> None:
    spoilt = masks.copy()
    spoilt[1] = 0
    found = compare(spoilt)
    assert found.closes.tolist() == [True, False, True] and found.odd is None


def test_of_two_cameras_none_is_identified(masks: np.ndarray) -> None:
    rig = Rig(RIG.cameras[:2])
    found = MaskAgreement(rig, VOLUME).compare(list(masks[:, :2]))
    assert found.odd is None and np.isnan(found.without).all()
