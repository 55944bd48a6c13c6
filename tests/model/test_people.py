"""People in frame sets: bodies drawn into the views of a ring of cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.model.figures import draw_silhouettes
from tests.model.landmarks import landmarks_of
from tests.model.ring import ring_of_cameras
from tk.model.body import gait_poses as gait
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import build_cone_body
from tk.model.cameras.camera import Rig
from tk.model.cameras.volume import Volume
from tk.people.columns import MOST, HullColumns
from tk.people.find import LocatedPerson, PeopleFinder, order_people

RIG = ring_of_cameras(5, 240, 240)
VOLUME = Volume((0.0, 0.0, 1.0), (2.4, 2.4, 2.2))
FINDER = PeopleFinder(RIG, VOLUME, "z")
TALL, SHORT = 1.85, 1.60


def drawn(places: list[tuple[float, float]], statures: list[float] | None = None, rig: Rig = RIG) -> np.ndarray:
    """Return (P, C, H, W) bool, the silhouette of each walker, as if nobody hid another."""
    alone = []
    for k, (x, y) in enumerate(places):
        stature = statures[k] if statures else 1.75
        body = build_cone_body(BodyDimensions.from_stature(stature))
        pose = gait.walking_pose(body.skeleton, 0.3 * k)
        pose[:3] = x, y, 0.54 * stature
        alone.append(draw_silhouettes(body, rig, pose[None])[0] > 0)
    return np.array(alone)


def test_masks_that_are_full_everywhere_have_few_candidates() -> None:
    """Every cell of their floor plan is a maximum; comparing all of them takes minutes."""
    columns = HullColumns(FINDER._grid, np.eye(3), np.zeros((0, 3)), np.zeros(0, np.int64))
    assert len(columns._maxima(np.full((90, 90), 2.0), 1.0)) <= MOST


def nearest(found: tuple[LocatedPerson, ...], places: list[tuple[float, float]]) -> list[float]:
    """Return the distance on the floor from each place to the nearest person, metres."""
    return [min(float(np.linalg.norm(person.position[:2] - place)) for person in found) for place in places]


@pytest.mark.parametrize(
    "places",
    [
        [(0.1, 0.2)],
        [(-0.6, 0.0), (0.6, 0.1)],
        [(-0.3, 0.0), (0.3, 0.0)],
        [(-0.7, -0.7), (0.7, -0.6), (0.0, 0.8)],
        [(-0.8, -0.8), (0.8, 0.8), (-0.8, 0.8), (0.8, -0.8)],
    ],
)
def test_people_are_counted_and_located(places: list[tuple[float, float]]) -> None:
    """Ghosts, which silhouettes of three or four people leave between them, are not counted."""
    found = FINDER.find(drawn(places).any(axis=0))
    assert len(found) == len(places)
    assert max(nearest(found, places)) < 0.15
    assert all(person.inside and person.views.all() for person in found)
    assert all(1.5 < person.height_m < 2.0 and 0.04 < person.volume_m3 < 0.25 for person in found)


def test_people_of_whom_others_hide_all_but_the_head_keep_their_height() -> None:
    """Shadows, which are uncertain, too, lower a height: they add to the feet."""
    (masks,) = drawn([(0.1, 0.2)])
    hidden = np.zeros_like(masks)
    hidden[0, np.flatnonzero(masks[0].any(axis=1))[0] + 8 :] = True
    found, in_shadow = (FINDER.find(masks & ~hidden, **{name: hidden}) for name in ("hidden", "uncertain"))
    assert 1.65 < found[0].height_m < 1.85 and in_shadow[0].height_m < 0.5


def test_people_close_together_before_four_cameras_are_told_apart() -> None:
    """Their hull is one block, larger than one person's."""
    rig = Rig(ring_of_cameras(5, 240, 240).cameras[:4])
    places = [(-0.45, 0.0), (0.15, 0.15), (0.1, -0.5)]
    found = PeopleFinder(rig, VOLUME, "z").find(drawn(places, rig=rig).any(axis=0))
    assert len(found) == 3 and max(nearest(found, places)) < 0.2


def test_people_are_the_same_if_all_voxels_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(tuple(replace(camera, distortions=np.array([-0.3, 0.0, 0.0, 0.0, 0.0])) for camera in RIG))
    masks = drawn([(-0.9, -0.5), (0.8, 0.9)], rig=rig).any(axis=0)
    masks[1, 100:140] = False
    uncertain = masks | np.roll(masks, 6, axis=2)
    finder = PeopleFinder(rig, VOLUME, "z")
    some = finder.find(masks, uncertain)
    points, _ = finder.around(np.array([0.8, 0.9, 0.9]), 255 * masks.astype(np.uint8))
    touched = "tk.model.hull.voxel_table._touched"
    monkeypatch.setattr(touched, lambda mask, center, radius: np.ones(len(center), np.bool_))
    every = PeopleFinder(rig, VOLUME, "z").find(masks, uncertain)
    assert len(some) == len(every) > 0
    for a, b in zip(some, every, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.share, b.share)
    # without a search before: the voxels around a position do not depend on what was found
    fresh, _ = PeopleFinder(rig, VOLUME, "z").around(np.array([0.8, 0.9, 0.9]), 255 * masks.astype(np.uint8))
    assert len(points) > 100
    np.testing.assert_array_equal(points, fresh)


def test_nobody_is_found_in_empty_masks_and_specks() -> None:
    masks = np.zeros((5, 240, 240), np.uint8)
    assert FINDER.find(masks) == ()
    masks[:, 118:124, 118:124] = 255
    assert FINDER.find(masks) == () and FINDER.is_empty(masks, ())


def test_volume_is_not_empty_if_somebody_is_inside_or_the_masks_contradict_each_other() -> None:
    inside, outside = (drawn([place])[0] for place in ((0.4, 0.6), (0.0, 2.0)))
    for masks, empty in ((inside, False), (outside, True), (inside | outside, False)):
        assert FINDER.is_empty(masks, FINDER.find(masks)) == empty
    apart = np.stack([np.roll(mask, shift, axis=1) for mask, shift in zip(inside, (0, 40, 80, -40, -80), strict=True)])
    assert not FINDER.find(apart) and not FINDER.is_empty(apart, ())
    apart[[1, 3]] = False  # two cameras see nobody
    assert FINDER.is_empty(apart, FINDER.find(apart))


def test_operator_at_the_edge_of_some_images_is_found_outside_the_volume() -> None:
    places = [(0.0, 0.0), (1.9, 1.2)]
    found = order_people(FINDER.find(drawn(places).any(axis=0)), VOLUME)
    assert [person.inside for person in found] == [True, False]
    assert found[1].views[[2, 3]].all() and not found[1].views[[1, 4]].any()
    assert nearest(found[1:], places[1:])[0] < 0.3


def test_person_behind_furniture_in_two_views_is_found() -> None:
    places = [(-0.6, 0.0), (0.6, 0.1)]
    alone = drawn(places)
    alone[1, [0, 3]] = False
    found = FINDER.find(alone.any(axis=0))
    assert len(found) == 2 and max(nearest(found, places)) < 0.2
    right = max(found, key=lambda person: person.position[0])
    assert right.views[[1, 2, 4]].all() and not right.views[[0, 3]].all()


def test_empty_mask_of_one_camera_hides_nobody() -> None:
    places = [(-0.6, 0.0), (0.6, 0.1)]
    masks = drawn(places).any(axis=0)
    masks[2] = False
    found = FINDER.find(masks)
    assert len(found) == 2 and max(nearest(found, places)) < 0.2
    assert all(person.views.tolist() == [True, True, False, True, True] for person in found)


def test_gap_in_one_mask_leaves_the_person_whole() -> None:
    masks = drawn([(0.0, 0.0)]).any(axis=0)
    masks[1, 140:] = False  # no legs
    (person,) = FINDER.find(masks)
    assert person.height_m > 1.6


def test_embraced_people_are_split_by_their_last_positions() -> None:
    last = FINDER.find(drawn([(-0.4, 0.0), (0.4, 0.0)]).any(axis=0))
    masks = drawn([(-0.12, 0.0), (0.12, 0.05)]).any(axis=0)
    assert len(FINDER.find(masks)) == 1
    found = FINDER.find(masks, near=last)
    assert len(found) == 2
    left, right = sorted(found, key=lambda person: person.position[0])
    assert left.position[0] < 0 < right.position[0]


def test_embraced_people_are_split_where_landmarks_show_two() -> None:
    """The landmarks of one person, seen twice, do not split."""
    places, bodies = [(-0.16, 0.0), (0.16, 0.05)], []
    masks = drawn(places).any(axis=0)
    assert len(FINDER.find(masks)) == 1
    for k, (x, y) in enumerate(places):
        body = build_cone_body(BodyDimensions.from_stature(1.75))
        pose = gait.walking_pose(body.skeleton, 0.3 * k)
        pose[:3] = x, y, 0.54 * 1.75
        bodies.append((body, pose))
    first, second = (landmarks_of(RIG, body, pose, 0.02) for body, pose in bodies)
    found = FINDER.find(masks, landmarks=np.stack([first, second]))
    assert len(found) == 2 and max(nearest(found, places)) < 0.15
    again = landmarks_of(RIG, *bodies[0], 0.02, seed=8)
    assert len(FINDER.find(drawn(places)[0], landmarks=np.stack([first, again]))) == 1


def test_person_at_the_place_of_someone_who_left_is_not_split() -> None:
    last = FINDER.find(drawn([(-0.3, 0.0), (0.3, 0.0)]).any(axis=0))
    assert len(last) == 2
    assert len(FINDER.find(drawn([(0.0, 0.0)])[0], near=last)) == 1


def test_person_in_one_image_stands_where_the_feet_meet_the_floor() -> None:
    behind = RIG[0].center * (-1.1, -1.1, 0.0)  # on the far side of the volume
    alone = drawn([(0.3, 0.6), (float(behind[0]), float(behind[1]))])
    alone[1, 1:] = False
    floor = Volume((0.0, 0.0, 1.0), (2.4, 2.4, 2.0))
    finder = PeopleFinder(RIG, floor, "z")
    found = order_people(finder.find(alone.any(axis=0)), floor)
    assert len(found) == 2
    assert np.flatnonzero(found[1].views).tolist() == [0] and not found[1].inside
    assert nearest(found[1:], [(float(behind[0]), float(behind[1]))])[0] < 0.5
    assert found[1].height_m == pytest.approx(1.75, abs=0.15)


def test_numbers_follow_height_then_views_then_distance_to_the_centre() -> None:
    places = [(-0.7, 0.0), (0.5, 0.1)]
    found = FINDER.find(drawn(places, [TALL, SHORT]).any(axis=0))

    def first(**known: object) -> float:
        return float(order_people(found, VOLUME, **known)[0].position[0])  # type: ignore[arg-type]

    assert first() > 0  # nearer to the centre
    assert first(height_m=TALL) < 0 and first(height_m=SHORT) > 0
    assert first(position=np.array([-0.6, 0.0, 0.9])) < 0
    fewer = [replace(p, views=p.views & (np.arange(5) > 0)) if p.position[0] > 0 else p for p in found]
    assert order_people(fewer, VOLUME)[0].position[0] < 0
