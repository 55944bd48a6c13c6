"""Where people are, from sightings and from masks; squares of pictures."""

from __future__ import annotations

from itertools import combinations
from random import Random

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tests.model.ring import ring_of_cameras
from tk.model.cameras.volume import Volume
from tk.model.hull.coarse import CoarseHull
from tk.model.masks.sightings import Patch, Sighting, locate, volume_patch

RIG = ring_of_cameras(4, 160, 200)
VOLUME = Volume((0.0, 0.0, 1.0), (2.4, 2.4, 2.2))
ALL = np.ones(4, np.bool_)

inside = st.tuples(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9))


def sighted(camera, at, score=0.9, z=0.95):
    """As a detector tells a person who stands at (x, y): the hips at z, the circle 0.9 m about them."""
    pixels, _ = camera.project([[*at, z], [*at, z + 0.9]])
    return Sighting(tuple(pixels[0]), tuple(pixels[1]), score)


@settings(max_examples=40)
@given(
    places=st.lists(inside, max_size=3, unique_by=lambda at: (round(at[0]), round(at[1]))),
    blind=st.sampled_from([*range(4), None]),
    order=st.randoms(use_true_random=False),
)
@example(places=[(0.0, 0.5), (0.76, 0.0)], blind=1, order=Random(0))
def test_everybody_whom_several_cameras_see_is_located(places, blind, order) -> None:
    """Although one camera sees nobody, and the sightings have no order."""
    apart = [np.hypot(*np.subtract(a, b)) for a, b in combinations(places, 2)]
    assume(min(apart, default=1.0) > 0.7)
    sightings = [[sighted(camera, at) for at in places] if c != blind else [] for c, camera in enumerate(RIG)]
    for each in sightings:
        order.shuffle(each)
    people, rest = locate(RIG, VOLUME, sightings)
    assert len(people) == len(places) and not any(rest)
    for at in places:
        person = min(people, key=lambda p: float(np.linalg.norm(p.center[:2] - at)))
        assert person.cameras == tuple(c for c in range(4) if c != blind)
        np.testing.assert_allclose(person.center, [*at, 0.95], atol=1e-6)
        np.testing.assert_allclose(person.top, [*at, 1.85], atol=1e-6)
        assert 0.7 < person.radius_m < 1.1


def test_sightings_of_single_cameras_are_left_over() -> None:
    alone = sighted(RIG[0], (0.0, 0.0))
    assert locate(RIG, VOLUME, [[], [], [], []]) == ([], [[], [], [], []])
    assert locate(RIG, VOLUME, [[alone], [], [], []]) == ([], [[alone], [], [], []])
    beyond = Volume((-3.0, 0.0, 1.0), (1.0, 1.0, 2.2))
    assert locate(RIG, beyond, [[sighted(c, (0.0, 0.5))] for c in RIG])[0] == []
    low, high = (sighted(RIG[c], (0.0, 0.0), z=z) for c, z in ((0, 0.1), (1, 1.9)))
    assert locate(RIG, VOLUME, [[low], [high], [], []])[0] == [], "their lines of sight do not meet"
    (person,), rest = locate(RIG, VOLUME, [[sighted(c, (0.3, 0.2))] + [alone] * (c is RIG[0]) for c in RIG])
    assert person.cameras == (0, 1, 2, 3) and rest == [[alone], [], [], []]


def test_the_better_of_two_sightings_of_a_camera_is_the_person() -> None:
    near = [sighted(RIG[0], (0.1, 0.0)), sighted(RIG[0], (0.0, 0.0)), sighted(RIG[0], (0.0, 0.1))]
    (person,), rest = locate(RIG, VOLUME, [near, *([sighted(c, (0.0, 0.0))] for c in RIG[1:])])
    assert rest == [[near[0], near[2]], [], [], []]
    np.testing.assert_allclose(person.center, [0, 0, 0.95], atol=1e-6)


def test_a_patch_shows_the_person_upright() -> None:
    (found,), _ = locate(RIG, VOLUME, [[sighted(camera, (0.3, -0.2))] for camera in RIG])
    for camera in RIG:
        patch = found.patch(camera, 1.25)
        assert patch is not None and abs(patch.angle) < 0.1
        body, _ = camera.project([[0.3, -0.2, z] for z in (0.05, 0.95, 1.8)])
        assert patch.holds(body) and not patch.holds(body + patch.side)


@settings(max_examples=30)
@given(st.floats(20, 140), st.floats(20, 180), st.integers(20, 90), st.floats(-np.pi, np.pi))
def test_cut_and_paste_are_inverse(x: float, y: float, side: int, angle: float) -> None:
    v, u = np.mgrid[:200, :160].astype(np.float32)
    values = np.sin(u / 15) * np.cos(v / 20) * 0.5 + 0.5
    patch = Patch((x, y), side, angle)
    back = patch.paste(
        patch.cut(np.dstack([values * 255] * 3).astype(np.uint8))[..., 0] / np.float32(255), values.shape
    )
    deep = Patch((x, y), side - 6, angle)
    for a, b in np.ndindex(12, 12):
        column, row = 8 + 13 * a, 8 + 16 * b
        if deep.holds(np.array([[column, row]], float)):
            assert back[row, column] == pytest.approx(values[row, column], abs=0.05)
    outside = np.hypot(u - x, v - y) > side
    assert (back[outside] == 0).all()


def test_a_patch_of_a_sighting_shows_the_body_upright() -> None:
    patch = Sighting((50.0, 60.0), (80.0, 20.0), 0.9).patch(1.2)
    assert patch.center == (50.0, 60.0) and patch.side == 120
    corner = np.array([50.0, 60.0]) + 59 * np.array([[0.6, -0.8], [0.8, 0.6]])  # up, and to the right
    assert patch.holds(corner) and not patch.holds(corner * 1.1)


def test_a_patch_around_points() -> None:
    points = np.array([[10.0, 20.0], [50.0, 30.0]])
    assert Patch.about(points, 1.5) == Patch((30.0, 25.0), 60)
    turned = Patch.about(points, 1.0, np.pi / 2)
    assert turned.side == 40 and turned.center == pytest.approx((30.0, 25.0))


def test_the_patch_of_the_volume_covers_it() -> None:
    for camera in RIG:
        patch = volume_patch(camera, VOLUME)
        assert patch.holds(camera.project([[0, 0, 0.1], [0, 0, 1.9]])[0]) and patch.side <= 200
    small = volume_patch(RIG[0], Volume((0, 0, 1), (0.2, 0.2, 0.2)))
    assert small.side < 40
    behind = Volume(tuple(2 * RIG[0].center), (0.2, 0.2, 0.2))
    assert volume_patch(RIG[0], behind).side == 199, "the whole picture"


def masks_of(balls) -> np.ndarray:
    """(4, 200, 160) 255 where a camera sees one of the balls (x, y, z, radius, cameras)."""
    masks = np.zeros((4, 200, 160), np.uint8)
    v, u = np.mgrid[:200, :160]
    for x, y, z, radius, cameras in balls:
        for c in cameras:
            pixels, depth = RIG[c].project([[x, y, z]])
            r = radius * RIG[c].matrix[0, 0] / depth[0]
            masks[c][np.hypot(u - pixels[0, 0], v - pixels[0, 1]) <= r] = 255
    return masks


def test_coarse_hull_contains_what_all_cameras_see() -> None:
    hull = CoarseHull(RIG, VOLUME)
    everyone = range(4)
    alone = hull.subject(masks_of([(0.3, 0.2, 1.0, 0.4, everyone)]), ALL)
    assert 1.0 < hull.litres(alone) / (4 / 3 * np.pi * 4.0**3) < 1.5
    beside = masks_of([(0.3, 0.2, 1.0, 0.4, everyone), (-0.9, -0.7, 1.7, 0.12, (0, 1))])
    assert np.count_nonzero(hull.subject(beside, ALL) ^ alone) < 0.01 * np.count_nonzero(alone)
    for c in everyone:
        kept = hull.only(alone, c, beside[c])
        np.testing.assert_array_equal(kept, masks_of([(0.3, 0.2, 1.0, 0.4, everyone)])[c])
        assert hull.share(alone, c, kept) > 0.9 and hull.share(alone, c, 0 * kept) == 0
    blind = masks_of([(0.3, 0.2, 1.0, 0.4, (0, 1, 3))])
    lenient = hull.subject(blind, ALL)
    assert hull.litres(lenient) > hull.litres(alone) and lenient[alone].all()
    assert not hull.subject(0 * blind, ALL).any()
    np.testing.assert_array_equal(hull.subject(blind, np.arange(4) != 2), lenient, "by the cameras that see")
