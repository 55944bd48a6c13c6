"""Landmarks of several images against each other: evidence for cameras, and whose they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.model.landmarks import body_points, landmarks_of
from tests.model.ring import ring_of_cameras, turned
from tests.trackers.walker import BODY, walk
from tk.model.cameras.camera import Rig
from tk.model.cameras.landmark_agreement import (
    associated,
    consensus,
    evidence_for_cameras,
    evidence_of_sets,
    most_likely,
)
from tk.model.cues.landmarks import log_ratio

RIG = ring_of_cameras(4, 160, 200)
NETWORK_M = 0.03  # error of a network's landmarks
POSES = walk(3)


def seen(poses: np.ndarray = POSES, noise_m: float = NETWORK_M) -> list[np.ndarray]:
    """Return the landmarks (1, C, L, 4) of one person in each frame."""
    return [landmarks_of(RIG, BODY, pose, noise_m, seed=i)[None] for i, pose in enumerate(poses)]


def test_correct_cameras_are_confirmed() -> None:
    assert (evidence_for_cameras(RIG, seen()) > 3.0).all()


@pytest.mark.parametrize("c", [0, 2])
def test_turned_camera_is_contradicted_and_the_others_are_confirmed(c: int) -> None:
    evidence = evidence_for_cameras(turned(RIG, c, 10.0), seen())
    assert evidence[c] < -3.0
    assert (np.delete(evidence, c) > 0).all()


@pytest.mark.parametrize("by", [3.0, -3.0])
def test_small_turn_is_noticed_where_the_masks_show_it(by: float) -> None:
    """Cameras at one height: two that are turned to the side by 3° still fit the landmarks of the others."""
    rig = turned(turned(RIG, 1, by), 3, -by)
    shift = by * np.radians(1.0) * RIG[1].matrix[0, 0]
    undone = {1: np.array([shift, 0.0]), 3: np.array([-shift, 0.0])}
    assert (evidence_for_cameras(rig, seen())[[1, 3]] > 0).all()
    assert (evidence_for_cameras(rig, seen(), undone)[[1, 3]] < -1.0).all()
    assert (evidence_for_cameras(RIG, seen(), undone) > 1.0).all()  # the masks are wrong


def test_frames_of_an_opening_count_as_one() -> None:
    one = seen(POSES[:1])
    np.testing.assert_allclose(evidence_for_cameras(RIG, one * 4), evidence_for_cameras(RIG, one))


def test_two_cameras_confirm_or_contradict_each_other() -> None:
    own = [one[:, :2] for one in seen()]
    assert (evidence_for_cameras(Rig(tuple(RIG)[:2]), own) > 3.0).all()
    tilted = tuple(turned(RIG, 0, 10.0, "x"))[:2]  # turned about the vertical they agree on another place
    assert (evidence_for_cameras(Rig(tilted), own) < 0.0).all()


def test_cameras_that_others_cannot_test_have_no_evidence() -> None:
    assert np.isnan(evidence_for_cameras(Rig(tuple(RIG)[:1]), [one[:, :1] for one in seen()])).all()
    blind = [one.copy() for one in seen()]
    for one in blind:
        one[:, 3] = np.nan
    assert np.isfinite(evidence_for_cameras(RIG, blind)).tolist() == [True, True, True, False]
    assert np.isnan(evidence_for_cameras(RIG, [np.zeros((0, 4, 21, 4))])).all()


def test_ratio_falls_with_the_distance_and_is_bounded() -> None:
    visible = np.full(21, 0.95)
    ratios = [log_ratio(np.full((21, 2), [metres, 0.0]), visible).sum() for metres in (0.0, 0.03, 0.1, 0.5, 5.0)]
    assert ratios == sorted(ratios, reverse=True) and ratios[1] > 0 > ratios[3]
    assert ratios[3] - ratios[4] < 0.1 and np.isfinite(ratios[4])


# --- association --------------------------------------------------------------------------------------------------


def two_people() -> np.ndarray:
    """(2, C, L, 4)."""
    behind = POSES[1].copy()
    behind[:2] += [0.45, 0.3]
    return np.stack([landmarks_of(RIG, BODY, pose, 0.02, seed=k) for k, pose in enumerate((POSES[0], behind))])


def test_correct_association_is_kept() -> None:
    people = two_people()
    np.testing.assert_array_equal(associated(RIG, people), people)


def test_sets_that_were_exchanged_in_an_image_are_given_back() -> None:
    people = two_people()
    exchanged = people.copy()
    exchanged[:, 1] = people[::-1, 1]
    np.testing.assert_array_equal(associated(RIG, exchanged), people)


def test_set_that_shows_the_person_in_front_is_taken_from_the_one_behind() -> None:
    people = two_people()
    front = people.copy()
    front[1, 2] = people[0, 2]
    found = associated(RIG, front)
    np.testing.assert_array_equal(found[0], people[0])
    assert np.isnan(found[1, 2]).all()
    np.testing.assert_array_equal(found[1, [0, 1, 3]], people[1, [0, 1, 3]])


def test_set_of_the_person_behind_that_was_taken_for_the_one_in_front_is_moved() -> None:
    people = two_people()
    moved = people.copy()
    moved[0, 2], moved[1, 2] = np.nan, people[0, 2]
    found = associated(RIG, moved)
    np.testing.assert_array_equal(found[0], people[0])
    assert np.isnan(found[1, 2]).all()


def test_sets_remain_where_too_few_images_show_the_person() -> None:
    people = two_people()
    people[:, 2:] = np.nan
    np.testing.assert_array_equal(associated(RIG, people), people)
    assert associated(RIG, people[:0]).shape == (0, 4, 21, 4)


def test_people_sighted_as_one_are_told_apart_by_most_cameras() -> None:
    apart = POSES[0].copy()
    apart[1] += 0.35  # somebody else at the side
    one, other = (landmarks_of(RIG, BODY, pose, 0.02, seed=k) for k, pose in enumerate((POSES[0], apart)))
    mixed = one.copy()
    mixed[2] = other[2]
    agree, points, _ = consensus(RIG, mixed)
    assert agree.tolist() == [True, True, False, True]
    assert np.nanmedian(np.linalg.norm(points - body_points(BODY, POSES[0]), axis=1)) < 0.05
    assert consensus(RIG, one)[0].all()


def test_no_camera_agrees_without_a_pair_that_shows_one_person() -> None:
    alone = np.full((4, 21, 4), np.nan)
    alone[1] = landmarks_of(RIG, BODY, POSES[0], 0.02)[1]
    agree, points, _ = consensus(RIG, alone)
    assert not agree.any() and np.isnan(points).all()


def test_sightings_of_two_people_who_stand_close_are_separated() -> None:
    """One camera sees both, another neither; the order is any."""
    people = two_people()
    sets = [(0, 1), (1, 2), (0, 0), (1, 1), (0, 2), (1, 0)]  # person, camera
    cameras, seen = [c for _, c in sets], np.array([people[k, c] for k, c in sets])
    found = most_likely(RIG, cameras, seen)
    rest = np.setdiff1d(np.arange(len(sets)), found)
    other = rest[most_likely(RIG, [cameras[k] for k in rest], seen[rest])]
    groups = sorted([sets[k] for k in group] for group in (found, other))
    assert groups == [[(0, 1), (0, 0), (0, 2)], [(1, 2), (1, 1), (1, 0)]]
    evidence = evidence_of_sets(RIG, cameras, seen, people[0])
    assert ((evidence > 0) == [k == 0 for k, _ in sets]).all()


def test_no_two_sightings_of_a_camera_are_one_person_and_no_sighting_is_one_alone() -> None:
    person = two_people()[0]
    assert most_likely(RIG, [0, 0, 1], person[[0, 0, 1]]).tolist() in ([0, 2], [1, 2])
    assert not len(most_likely(RIG, [0, 0], person[[0, 0]]))
    assert not len(most_likely(RIG, [], np.zeros((0, 21, 4))))
    unknown = np.full((2, 21, 4), np.nan)
    assert not len(most_likely(RIG, [0, 1], unknown))
    assert np.isnan(evidence_of_sets(RIG, [0, 1], person[:2], np.full((4, 21, 4), np.nan))).all()


# --- what other images leave open ---------------------------------------------------------------------------------


def without(sets: np.ndarray, *cameras: int) -> np.ndarray:
    """Return the landmarks (C, L, 4) without those of some cameras."""
    result = sets.copy()
    result[list(cameras)] = np.nan
    return result


def test_cameras_that_face_each_other_do_not_contradict_a_third_one() -> None:
    half_turn = np.diag([-1.0, -1.0, 1.0])
    facing = replace(RIG[0], name="facing", rotation=RIG[0].rotation @ half_turn)
    rig = Rig((RIG[0], facing, RIG[1]))
    np.testing.assert_allclose(facing.center[:2], -RIG[0].center[:2], atol=1e-9)
    for seed in range(5):
        one = landmarks_of(rig, BODY, POSES[0], 0.05, seed=seed)
        assert (evidence_for_cameras(rig, [one[None]]) > 0).all()


def test_set_of_somebody_else_does_not_contradict_the_cameras_that_agree() -> None:
    below = POSES[1].copy()
    below[:3] += [0.45, 0.3, -0.5]  # at one height, each two cameras would agree on a point between both people
    one, other = (landmarks_of(RIG, BODY, pose, 0.02, seed=1)[[0, 1, 3]] for pose in (POSES[0], below))
    three = Rig(tuple(RIG[c] for c in (0, 1, 3)))
    mixed = one.copy()
    mixed[2] = other[2]
    evidence = evidence_for_cameras(three, [mixed[None]])
    assert evidence[2] < 0 and not (evidence[:2] < 0).any()
    found = associated(three, np.stack([mixed]))[0]
    assert np.isnan(found[2]).all() and np.isfinite(found[:2, :, :3]).all()


def test_wrong_landmarks_of_another_image_are_not_held_against_a_camera() -> None:
    one = landmarks_of(RIG, BODY, POSES[0], 0.02)
    wrong = one.copy()
    wrong[0, :6, :2] += 60.0
    right, doubtful = (evidence_for_cameras(RIG, [without(sets, 3)[None]])[1] for sets in (one, wrong))
    assert right > doubtful > 0


def test_unknown_place_says_nothing() -> None:
    away, visible = np.full((21, 2), 0.3), np.full(21, 0.95)
    known, unknown = (
        log_ratio(away, visible, np.tile(spread * np.eye(2), (21, 1, 1))).sum() for spread in (1e-6, 100.0)
    )
    assert known < -10 and abs(unknown) < 1.0
