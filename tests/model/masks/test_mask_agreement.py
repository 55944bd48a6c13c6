"""Cameras against masks: drawn silhouettes of a body, with cameras and masks that are then spoilt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scripts.synthetic.scene import look_at
from tests.model.figures import draw_silhouettes
from tests.model.ring import ring_of_cameras, turned
from tk.kernels.mask_values import OTHERS
from tk.model.body import gait_poses as gait
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume
from tk.model.masks.mask_agreement import INCONSISTENT, Agreement, MaskAgreement, excess, largest_consistent
from tk.model.masks.tangency import Outline, Tangency, tangency


def rig_of_heights(*heights_m: float) -> Rig:
    """Return a ring of cameras at these heights that look at the person's hips."""
    cameras = []
    for level, height in zip(ring_of_cameras(len(heights_m), 240, 240), heights_m, strict=True):
        center = np.array([*level.center[:2], height])
        rotation = look_at(center, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
        cameras.append(replace(level, rotation=rotation, translation=-rotation @ center))
    return Rig(tuple(cameras))


RIG = rig_of_heights(1.0, 2.2, 1.4, 2.6, 1.8)
VOLUME = Volume((0.0, 0.0, 1.0), (2.4, 2.4, 2.2))


@pytest.fixture(scope="module")
def masks() -> np.ndarray:
    """(3, 5, 240, 240): a walker who goes along y."""
    body = build_cone_body(BodyDimensions.from_stature(1.75))
    poses = []
    for i in range(3):
        pose = gait.walking_pose(body.skeleton, i / 3)
        pose[:3] = 0.0, 0.2 * i - 0.2, 0.95
        poses.append(pose)
    return draw_silhouettes(body, RIG, np.array(poses))


def compare(masks: np.ndarray, rig: Rig = RIG) -> Agreement:
    return MaskAgreement(rig, VOLUME).compare(list(masks))


def part(masks: np.ndarray, cameras: list[int], rig: Rig = RIG) -> Agreement:
    """Return the agreement of some of the cameras."""
    return compare(masks[:, cameras], Rig(tuple(rig[c] for c in cameras)))


@pytest.mark.parametrize("shown", [0, 255])
def test_masks_that_do_not_exist_are_no_evidence(masks: np.ndarray, shown: int) -> None:
    spoilt, there = masks.copy(), np.ones(masks.shape[:2], np.bool_)
    spoilt[1:, 2], there[1:, 2] = shown, False
    assert compare(spoilt).wrong or compare(spoilt).refusal
    found = MaskAgreement(RIG, VOLUME).compare(list(spoilt), there)
    assert found.wrong == () and found.refusal == "" and found.closes.all() and found.disagreement < 0.01
    there[:, [0, 1, 3, 4]] = False  # one camera in one frame: nothing is left to compare
    alone = MaskAgreement(RIG, VOLUME).compare(list(spoilt), there)
    assert alone.wrong == () and alone.refusal == "" and np.isnan(alone.disagreement)


def test_exact_masks_agree(masks: np.ndarray) -> None:
    found = compare(masks)
    assert found.wrong == () and found.refusal == "" and found.closes.all()
    assert found.disagreement < 0.01 and np.nanmax(excess(found.tangency)) < 0.5
    np.testing.assert_array_equal(found.shift_px, 0.0)
    assert 1.6 < found.extent_m < 2.1


@pytest.fixture(scope="module")
def error(masks: np.ndarray) -> np.ndarray:
    """The disagreement of each pair of the cameras as they are."""
    return compare(masks).tangency.error


@given(
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1), scale=st.floats(0.01, 100)
)
@settings(max_examples=15)
def test_pairs_agree_in_every_world_and_unit(
    masks: np.ndarray, error: np.ndarray, quaternion: tuple, scale: float
) -> None:
    R = Rotation.from_quat(quaternion).as_matrix()
    rig = Rig(tuple(replace(c, rotation=c.rotation @ R.T, translation=scale * c.translation) for c in RIG))
    outlines = [[Outline.of(camera, mask) for camera, mask in zip(rig, frame, strict=True)] for frame in masks]
    np.testing.assert_allclose(tangency(outlines, rig.centers).error, error, atol=1e-5)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("camera", [1, 4])
def test_turned_camera_is_the_only_wrong_one(masks: np.ndarray, camera: int, axis: str) -> None:
    for degrees in (-6.0, 6.0):
        found = compare(masks, turned(RIG, camera, degrees, axis))
        assert found.wrong == (camera,) and found.refusal == ""
        assert "turned" in found.reason(camera)
        assert np.nanargmax(found.pairs_px) == camera, "the table accuses the same camera"
        shown = {f"off by {px:.0f} px" for px in (np.hypot(*found.shift_px[camera]), found.pairs_px[camera])}
        assert any(text in found.reason(camera) for text in shown), "with a number of the table"


@pytest.mark.parametrize("factor", [0.85, 1.2])
@pytest.mark.parametrize("camera", [0, 3])
def test_camera_with_another_focal_length_is_the_only_wrong_one(masks: np.ndarray, camera: int, factor: float) -> None:
    """With a longer lens its silhouette is smaller than the others on both sides, and extends beyond none."""
    matrix = RIG[camera].matrix * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]]
    rig = Rig(tuple(replace(c, matrix=matrix) if c is RIG[camera] else c for c in RIG))
    found = compare(masks, rig)
    assert found.wrong == (camera,) and found.refusal == "" and np.nanargmax(found.pairs_px) == camera
    assert factor < 1 or "zoomed" in found.reason(camera)


def test_camera_that_is_wrong_in_pairs_only_has_their_error(masks: np.ndarray) -> None:
    """The bulky hull of three cameras may have room for the masks of a turned one."""
    cameras = [0, 1, 2, 3]
    found = part(masks, cameras, turned(RIG, 3, 2.5, axis="x"))
    inside = replace(found, wrong=(3,), outside=np.zeros(4), shift_px=np.zeros((4, 2)))
    assert np.nanargmax(inside.pairs_px) == 3 and inside.pairs_px[3] > 2 * np.delete(inside.pairs_px, 3).max()
    assert f"off by {inside.pairs_px[3]:.0f} px" in inside.reason(3)


def test_turned_camera_has_its_shift(masks: np.ndarray) -> None:
    found = compare(masks, turned(RIG, 3, 3.0))
    assert found.wrong == (3,)
    off = RIG[3].matrix[0, 0] * np.tan(np.radians(3.0))
    # the hull of the others has room for some of it
    assert 0.5 * off < np.hypot(*found.shift_px[3]) <= off + 3
    assert np.delete(found.outside, 3).max() < INCONSISTENT / 2


def test_two_turned_cameras_of_five_are_both_wrong(masks: np.ndarray) -> None:
    found = compare(masks, turned(turned(RIG, 0, 6.0), 3, -6.0))
    assert sorted(found.wrong) == [0, 3] and found.refusal == ""


def test_right_camera_with_a_single_partner_may_be_wrong_unnoticed(masks: np.ndarray) -> None:
    found = compare(masks, turned(RIG, 2, 6.0))
    assert found.wrong == (2,) and found.undetected_m == 0
    error = found.tangency.error.copy()
    error[1, [3, 4]] = error[[3, 4], 1] = np.nan
    single = replace(found, tangency=replace(found.tangency, error=error))
    assert 0.02 < single.undetected_m < 0.08
    assert replace(single, wrong=()).undetected_m == 0


def test_swapped_videos_are_named(masks: np.ndarray) -> None:
    found = compare(masks[:, [0, 3, 2, 1, 4]])
    assert found.wrong == () and found.refusal.startswith("the videos of c1 and c3 look swapped")


@pytest.mark.parametrize(("facing", "expected"), [(False, (0, 1)), (True, None)])
def test_swap_needs_two_tested_partners_of_each_camera(
    monkeypatch: pytest.MonkeyPatch, facing: bool, expected: tuple[int, int] | None
) -> None:
    """Of three cameras, two of which face each other, exchanged videos agree by chance."""
    error = np.zeros((3, 3, 2))
    error[range(3), range(3)] = np.nan
    if facing:
        error[[0, 2], [2, 0]] = np.nan
    exchanged = Tangency(error, np.full(3, 0.004), np.eye(3))
    monkeypatch.setattr("tk.model.masks.mask_agreement.tangency", lambda *_: exchanged)
    assert MaskAgreement(Rig(tuple(RIG)[:3]), VOLUME)._swapped([], [], [0, 1, 2]) == expected


def test_two_cameras_that_contradict_each_other_are_refused(masks: np.ndarray) -> None:
    assert part(masks, [0, 1]).refusal == ""
    found = part(masks, [0, 1], turned(RIG, 1, 8.0))
    assert found.wrong == () and found.refusal.startswith("c0 and c1 contradict each other by up to")


def test_cameras_of_another_recording_are_refused(masks: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    rig = RIG
    for camera in range(5):
        rig = turned(turned(rig, camera, rng.uniform(-9, 9), "x"), camera, rng.uniform(-9, 9))
    found = compare(masks, rig)
    assert "the cameras c0, c1, c2, c3 and c4 do not belong together" in found.refusal
    assert "calibration.toml is of another recording" in found.refusal


def test_volume_beside_the_person_is_named(masks: np.ndarray) -> None:
    beside = Volume((0.0, -1.3, 1.0), (2.4, 2.4, 2.2))
    found = MaskAgreement(RIG, beside).compare(list(masks))
    assert "does not hold the person" in found.refusal and "[volume]" in found.refusal


def test_masks_of_a_thing_that_never_moves_are_refused(masks: np.ndarray) -> None:
    box = np.zeros_like(masks)
    box[:, :, 60:200, 20:90] = 255
    assert "never change" in compare(box).refusal


def test_cameras_that_face_each_other_are_refused(masks: np.ndarray) -> None:
    first, z = RIG[0], np.diag([-1.0, -1.0, 1.0])
    facing = replace(first, name="c9", rotation=first.rotation @ z)
    mirrored = np.concatenate(
        [masks[:, :2], masks[:, :1, :, ::-1]], axis=1
    )  # what the facing camera sees of a symmetric body
    assert (
        "c0 and c9 see the person from the same or from" in compare(mirrored[:, [0, 2]], Rig((first, facing))).refusal
    )
    assert compare(mirrored, Rig((first, RIG[1], facing))).refusal == ""


def test_silhouette_that_the_border_cuts_contradicts_nothing(masks: np.ndarray) -> None:
    cut = masks[..., :130, :]
    rig = Rig(tuple(replace(c, height=130) for c in RIG))
    found = compare(cut, rig)
    assert found.wrong == () and found.refusal == ""
    assert np.nanmin(found.tangency.apart) < 0.02 and np.nanmax(found.tangency.apart) < 0.02


def test_silhouette_that_another_person_cuts_contradicts_nothing(masks: np.ndarray) -> None:
    hidden = masks.copy()
    hidden[:, 2, 150:] = np.where(masks[:, 2, 150:] > 0, OTHERS, 0)
    pairs = compare(hidden).tangency
    assert np.nanmax(pairs.apart) < 0.02 and np.isnan(pairs.apart[2]).all()
    hidden[:, 2, 150:] = 0
    assert np.nanmax(compare(hidden).tangency.apart) > 0.1


def test_shadow_at_the_feet_counts_half_of_a_turned_camera() -> None:
    """A shadow moves one side of a silhouette, a turned camera moves both."""
    error = np.full((3, 3, 2), np.nan)
    error[0, 1], error[0, 2], error[1, 2] = (0.03, 0.0), (0.03, -0.03), (0.03, np.nan)
    apart = Tangency(error, np.full(3, 0.01), np.zeros((3, 3))).apart
    np.testing.assert_allclose([apart[0, 1], apart[0, 2], apart[1, 2], apart[2, 0]], [0.015, 0.03, 0.03, np.nan])


def test_shadow_in_the_masks_of_one_camera_excludes_nobody(masks: np.ndarray) -> None:
    shadowed = masks.copy()
    for mask in shadowed[:, 0]:
        y, x = np.argwhere(mask)[-1]
        mask[y : y + 7, x - 10 : x] = 255
    found = compare(shadowed[:, [0, 1, 3, 4]], Rig((RIG[0], RIG[1], RIG[3], RIG[4])))
    assert np.nanmax(np.abs(found.tangency.error)) > 0.02
    assert found.wrong == () and found.refusal == ""


def test_set_with_an_untested_rival_blames_nobody() -> None:
    """0 and 2 face each other; of 0 and 1, which contradict each other, either may be wrong."""
    error = np.array([[np.nan, 2.0, np.nan], [2.0, np.nan, 0.1], [np.nan, 0.1, np.nan]])
    assert largest_consistent(error) == []
    error[0, 2] = error[2, 0] = 3.0
    assert largest_consistent(error) == [1, 2]


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
    assert found.wrong == (2,)
    assert reason in found.reason(2)


def test_empty_masks_have_no_hull(masks: np.ndarray) -> None:
    found = compare(np.zeros_like(masks))
    assert not found.closes.any() and found.wrong == () and np.isnan(found.extent_m)
    only = np.zeros_like(masks)
    only[:, 0] = masks[:, 0]
    assert not compare(only).closes.any()


def test_empty_mask_in_one_frame_is_ignored(masks: np.ndarray) -> None:
    spoilt = masks.copy()
    spoilt[1] = 0
    found = compare(spoilt)
    assert found.closes.tolist() == [True, False, True] and found.wrong == ()


NO_EVIDENCE = np.full(5, np.nan)


def with_evidence(**nats: float) -> np.ndarray:
    """Return (5,) evidence for the cameras c0 to c4; the others have none."""
    return np.array([nats.get(f"c{c}", np.nan) for c in range(5)])


def test_camera_that_other_evidence_confirms_is_not_wrong(masks: np.ndarray) -> None:
    judged = replace(compare(masks), wrong=(1, 3))
    assert judged.confirmed(with_evidence(c0=4, c1=5, c2=4, c3=6, c4=3)).wrong == ()
    assert judged.confirmed(with_evidence(c0=4, c1=5, c2=4, c3=-6, c4=3)).wrong == (3,)
    assert judged.confirmed(with_evidence(c0=4, c1=5, c2=4)).wrong == (3,)  # of c3 the masks alone tell
    assert judged.confirmed(NO_EVIDENCE).wrong == judged.wrong


def test_refusal_stays_unless_other_evidence_denies_it(masks: np.ndarray) -> None:
    refused = replace(compare(masks), refusal="no three cameras agree")
    assert refused.confirmed(np.full(5, 4.0)).refusal == ""
    assert refused.confirmed(with_evidence(c0=4, c1=4, c2=4)).refusal == ""
    assert refused.confirmed(with_evidence(c0=4, c1=4, c2=-4, c3=4, c4=4)).refusal == refused.refusal
    assert refused.confirmed(NO_EVIDENCE).refusal == refused.refusal  # as with two cameras
    one_sided = replace(refused, wrong=(2,))
    assert one_sided.confirmed(with_evidence(c0=4, c1=4, c2=-4, c3=4, c4=4)).refusal == refused.refusal
    assert one_sided.confirmed(np.full(5, 4.0)).refusal == ""
