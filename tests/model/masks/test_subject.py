"""Who the subject is, from sightings and from masks; squares of pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.model.ring import ring_of_cameras
from tk.model.cameras.volume import Volume
from tk.model.hull.coarse import CoarseHull
from tk.model.masks.subject import Patch, Sighting, locate, volume_patch

RIG = ring_of_cameras(4, 160, 200)
VOLUME = Volume((0.0, 0.0, 1.0), (2.4, 2.4, 2.2))

inside = st.tuples(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9))


def sighted(camera, at, score=0.9, z=0.95):
    """As a detector tells a person who stands at (x, y): the hips at z, the circle 0.9 m about them."""
    pixels, _ = camera.project([[*at, z], [*at, z + 0.9]])
    return Sighting(tuple(pixels[0]), tuple(pixels[1]), score)


@settings(max_examples=40, deadline=None)
@given(
    at=inside,
    others=st.lists(st.tuples(inside, st.sampled_from(range(4))), max_size=4),
    blind=st.sampled_from([*range(4), None]),
)
@example(at=(0.0, 0.5), others=[((0.76, 0.0), 1)], blind=1)
def test_person_seen_by_most_cameras_is_the_subject(at, others, blind) -> None:
    """Whoever else single cameras take for a person, and though one camera does not see the subject."""
    sightings = [[sighted(camera, at)] if c != blind else [] for c, camera in enumerate(RIG)]
    for c in range(4):
        strange = [place for place, where in others if where == c][:1]  # no two of them at one place: another subject
        sightings[c] += [sighted(RIG[c], (x + 0.01 * c, y), 0.95) for x, y in strange]
    found = locate(RIG, VOLUME, sightings)
    assert found is not None
    if found.views == 4 - (blind is not None) and not others:
        np.testing.assert_allclose(found.center, [*at, 0.95], atol=1e-6)
        np.testing.assert_allclose(found.top, [*at, 1.85], atol=1e-6)
        assert 0.7 < found.radius_m < 1.1
    assert np.linalg.norm(found.center[:2] - at) < 0.5 or len(others) >= 2


def test_no_subject_without_two_matching_sightings() -> None:
    assert locate(RIG, VOLUME, [[], [], [], []]) is None
    assert locate(RIG, VOLUME, [[sighted(RIG[0], (0, 0))], [], [], []]) is None
    assert locate(RIG, VOLUME, [[sighted(c, (2.0, 0.5))] for c in RIG]) is None, "beyond the volume"
    low, high = (sighted(RIG[c], (0.0, 0.0), z=z) for c, z in ((0, 0.1), (1, 1.9)))
    assert locate(RIG, VOLUME, [[low], [high], [], []]) is None, "their lines of sight do not meet"


def test_a_patch_shows_the_subject_upright() -> None:
    found = locate(RIG, VOLUME, [[sighted(camera, (0.3, -0.2))] for camera in RIG])
    assert found is not None
    for camera in RIG:
        patch = found.patch(camera, 1.25)
        assert patch is not None and abs(patch.angle) < 0.1
        body, _ = camera.project([[0.3, -0.2, z] for z in (0.05, 0.95, 1.8)])
        assert patch.holds(body) and not patch.holds(body + patch.side)


@settings(max_examples=30, deadline=None)
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
    alone = hull.subject(masks_of([(0.3, 0.2, 1.0, 0.4, everyone)]))
    assert 1.0 < hull.litres(alone) / (4 / 3 * np.pi * 4.0**3) < 1.5
    beside = masks_of([(0.3, 0.2, 1.0, 0.4, everyone), (-0.9, -0.7, 1.7, 0.12, (0, 1))])
    assert np.count_nonzero(hull.subject(beside) ^ alone) < 0.01 * np.count_nonzero(alone)
    for c in everyone:
        kept = hull.only(alone, c, beside[c])
        np.testing.assert_array_equal(kept, masks_of([(0.3, 0.2, 1.0, 0.4, everyone)])[c])
        assert hull.share(alone, c, kept) > 0.9 and hull.share(alone, c, 0 * kept) == 0
    blind = masks_of([(0.3, 0.2, 1.0, 0.4, (0, 1, 3))])
    lenient = hull.subject(blind)
    assert hull.litres(lenient) > hull.litres(alone) and lenient[alone].all()
    assert not hull.subject(0 * blind).any()
