"""Masks of everybody: a segmenter that prefers one person, as networks do, and people who hide each other."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.model.ring import ring_of_cameras
from tests.people import VOLUME, person_mask
from tk.errors import ConfigError
from tk.model.body.body_points import LANDMARKS
from tk.model.cameras.triangulation import triangulate_joints
from tk.model.cameras.volume import Volume
from tk.model.masks.sightings import Sighting
from tk.segmenters.people_masks import PeopleMasks

RIG = ring_of_cameras(4, 160, 200)
HUES = ((40, 40, 200), (200, 60, 30), (30, 160, 40))  # of the people

At = tuple[float, float]


def shown(places: Sequence[At]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return images (4, H, W, 3) of people, the nearer in front, and whom each pixel shows, from 1; 0: nobody."""
    rng = np.random.default_rng(3)
    images = rng.integers(90, 110, (4, 200, 160, 3)).astype(np.uint8)
    who = np.zeros((4, 200, 160), np.int64)
    for c, camera in enumerate(RIG):
        for k in sorted(range(len(places)), key=lambda k: -float(camera.project([[*places[k], 1.0]])[1][0])):
            mask = person_mask(camera, places[k]) > 0
            images[c][mask], who[c][mask] = HUES[k], k + 1
    return images, who


@dataclass
class OneOfMany:
    """Detects one person, the largest, and segments one, the largest in the middle, as a network for single people.

    ``blind``: number of the first images in which nobody is detected. ``seen``: number of people in each square.
    """

    blind: int = 0
    seen: list[int] = field(default_factory=list)

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        masks = self._masks(image)
        self.seen.append(len(masks))
        side = len(image) // 4
        masks.sort(key=lambda mask: -np.count_nonzero(mask[side:-side, side:-side]))
        return masks[0].astype(np.float32) * 0.9 if masks else np.zeros(image.shape[:2], np.float32)

    def find(self, image: NDArray[np.uint8]) -> list[Sighting]:
        self.blind -= 1
        masks = self._masks(image)
        if self.blind >= 0 or not masks:
            return []
        x, y, width, height = cv2.boundingRect(masks[0].astype(np.uint8))
        middle = (x + (width - 1) / 2, y + (height - 1) / 2)
        return [Sighting(middle, (middle[0], middle[1] - 0.55 * height), 0.9)]

    def _masks(self, picture: NDArray[np.uint8]) -> list[NDArray[np.bool_]]:
        found = [(cv2.absdiff(picture, np.full_like(picture, hue)) < 30).all(axis=2) for hue in HUES]
        return sorted((m for m in found if np.count_nonzero(m) > 60), key=lambda m: -int(np.count_nonzero(m)))


def masks_of(segmenter: OneOfMany) -> PeopleMasks:
    return PeopleMasks(segmenter, "one", RIG, Volume(tuple(VOLUME["center"]), tuple(VOLUME["size"])))


@pytest.mark.parametrize(
    "places",
    [[(0.2, 0.1)], [(-0.6, 0.2), (0.6, -0.1)], [(0.0, 0.0), (0.5, 0.1)], [(-0.7, 0.0), (0.0, 0.6), (0.6, -0.5)]],
    ids=["one", "two", "two who hide each other", "three"],
)
def test_masks_show_everybody(places: list[At]) -> None:
    images, who = shown(places)
    masks = masks_of(OneOfMany()).segment(images)
    for k in range(len(places)):
        assert (masks > 0)[who == k + 1].mean() > 0.9, k
    assert (masks > 0)[who == 0].mean() < 0.002


@dataclass
class Parallel(OneOfMany):
    """May be called at once, and notes by which threads."""

    parallel = True
    threads: set[int] = field(default_factory=set)

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.threads.add(threading.get_ident())
        return super().segment(image)


def test_cameras_are_segmented_at_once_with_the_same_masks() -> None:
    images, _ = shown([(0.0, 0.0), (0.5, 0.1)])
    at_once = Parallel()
    for a, b in zip(masks_of(OneOfMany()).label(images), masks_of(at_once).label(images), strict=True):
        np.testing.assert_array_equal(a, b)
    assert at_once.threads - {threading.get_ident()}


def test_person_whom_a_camera_does_not_detect_is_in_its_mask() -> None:
    images, who = shown([(0.3, -0.2)])
    masks = masks_of(OneOfMany(blind=1)).segment(images)
    assert (masks[0] > 0)[who[0] == 1].mean() > 0.9


def test_person_whom_one_camera_shows_is_in_its_mask() -> None:
    images, who = shown([(0.3, -0.2)])
    alone = images.copy()
    alone[1:] = shown([])[0][1:]
    masks = masks_of(OneOfMany()).segment(alone)
    assert (masks[0] > 0)[who[0] == 1].mean() > 0.9 and not masks[1:].any()


def test_nobody_is_segmented_where_nobody_is() -> None:
    segmenter = OneOfMany()
    masks, uncertain, *_ = masks_of(segmenter).label(shown([])[0])
    assert not masks.any() and not uncertain.any() and not segmenter.seen


def test_another_detection_of_the_same_person_changes_nothing() -> None:
    """An arm that the mask misses may look like a person."""

    class Twice(OneOfMany):
        def find(self, image: NDArray[np.uint8]) -> list[Sighting]:
            return super().find(image) or [Sighting((80.0, 100.0), (80.0, 30.0), 0.6)]

    images, _ = shown([(0.2, 0.1)])
    once, twice = (masks_of(segmenter).label(images) for segmenter in (OneOfMany(), Twice()))
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_array_equal(a, b)


class Posed(OneOfMany):
    """Takes the top of a mask for the shoulders, the lower end for the ankles, and sees nothing else."""

    def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        found, landmarks = self.segment(image), np.full((12, 3), np.nan)
        y, x = np.nonzero(found > 0.5)
        if len(x):
            landmarks[:2], landmarks[-2:] = (x.mean(), y.min(), 0.9), (x.mean(), y.max(), 0.9)
        return found, landmarks


class Named(OneOfMany):
    """Names its landmarks; one of them is none of ours."""

    landmarks = ("navel", "toe_r", "nose")

    def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        found, landmarks = self.segment(image), np.full((3, 3), np.nan)
        y, x = np.nonzero(found > 0.5)
        if len(x):
            landmarks[1:] = (x.mean(), y.max(), 0.7), (x.mean(), y.min(), 0.8)
        return found, landmarks


@pytest.mark.parametrize(
    ("segmenter", "top", "bottom"),
    [(Posed(), ("shoulder_l", "shoulder_r"), ("ankle_l", "ankle_r")), (Named(), ("nose",), ("toe_r",))],
    ids=["twelve without names", "with names"],
)
def test_landmarks_of_everybody_in_each_image_are_returned(
    segmenter: OneOfMany, top: tuple[str, ...], bottom: tuple[str, ...]
) -> None:
    places = [(-0.6, 0.2), (0.6, -0.1)]
    images, _ = shown(places)
    landmarks = masks_of(segmenter).label(images).landmarks
    assert landmarks.shape == (2, 4, len(LANDMARKS), 4)
    rows = [LANDMARKS.index(name) for name in top + bottom]
    assert np.isnan(np.delete(landmarks, rows, axis=2)).all()
    feet = [triangulate_joints(RIG, person)[0][LANDMARKS.index(bottom[0])] for person in landmarks]
    for k, at in zip(np.argsort([foot[0] for foot in feet]), places, strict=True):
        points = triangulate_joints(RIG, landmarks[k])[0]
        for names, height in ((top, 1.75), (bottom, 0.0)):
            for name in names:
                np.testing.assert_allclose(points[LANDMARKS.index(name)], (*at, height), atol=0.15)


def test_segmenter_without_landmarks_returns_unknown_ones() -> None:
    found = masks_of(OneOfMany()).label(shown([(0.2, 0.1)])[0])
    assert found.landmarks.shape == (1, 4, len(LANDMARKS), 4) and np.isnan(found.landmarks).all()
    nobody = masks_of(Posed()).label(shown([])[0])
    assert nobody.landmarks.shape == (0, 4, len(LANDMARKS), 4)


@pytest.mark.parametrize(("names", "count"), [((), 12), (("nose", "heel_l"), 2)])
def test_landmarks_of_another_shape_are_refused(names: tuple[str, ...], count: int) -> None:
    class Wrong(OneOfMany):
        def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
            return self.segment(image), np.zeros((17, 2))

    segmenter = Wrong()
    if names:
        segmenter.landmarks = names  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=rf"segmenter one: returned landmarks \(17, 2\); they must be \({count}, 3\)"):
        masks_of(segmenter).label(shown([(0.2, 0.1)])[0])


class Blundering(OneOfMany):
    """Takes the feet for the whole person in a dark image, unless the square fits the person closely."""

    landmarks = ("shoulder_l", "shoulder_r", "hip_l", "hip_r", "ankle_l", "ankle_r")

    def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        found, points = self.segment(image), np.full((6, 3), np.nan)
        y, x = np.nonzero(found > 0.5)
        if len(x):
            if np.median(image[image.max(axis=2) > 0]) < 80 and np.ptp(y) < 0.8 * len(image):
                found[: y.max() - 20] = 0
                y, x = np.nonzero(found > 0.5)
            points[:] = x.mean(), 0, 0.9
            points[:, 1] = y.min() + np.repeat([0.15, 0.5, 0.95], 2) * (y.max() - y.min())
        return found, points


def test_wrong_answers_in_two_cameras_are_asked_again_where_the_others_see_the_person() -> None:
    """Their hull contains almost nothing."""
    images, who = shown([(0.2, 0.1)])
    dark = images[:2]
    dark[who[:2] == 0] //= 2
    labels = masks_of(Blundering(blind=2)).label(images)
    shares = [(mask > 0)[one == 1].mean() for mask, one in zip(labels.masks, who, strict=True)]
    assert min(shares) > 0.9, shares
    assert np.isfinite(labels.landmarks[0, :, LANDMARKS.index("hip_l"), 0]).all()


def test_masks_do_not_change_the_images() -> None:
    images, _ = shown([(-0.6, 0.2), (0.6, -0.1)])
    before = images.copy()
    masks_of(OneOfMany()).segment(images)
    np.testing.assert_array_equal(images, before)


def test_specks_that_no_other_camera_shows_are_removed() -> None:
    """A person whom one camera shows stays."""
    masks = np.where(shown([(0.2, 0.1)])[1] > 0, 255, 0).astype(np.uint8)
    masks[0, 40:160, 2:22] = 255
    spoilt = masks.copy()
    spoilt[0, 10:20, 140:150] = spoilt[2, 190:196, 4:20] = 255
    np.testing.assert_array_equal(masks_of(OneOfMany()).without_specks(spoilt), masks)


class Standing(OneOfMany):
    """Sees shoulders, hips and ankles of an upright person."""

    def __init__(self) -> None:
        super().__init__()
        self.searched = 0

    def find(self, image: NDArray[np.uint8]) -> list[Sighting]:
        self.searched += 1
        return super().find(image)

    def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        found, landmarks = self.segment(image), np.full((12, 3), np.nan)
        y, x = np.nonzero(found > 0.5)
        if len(x):
            for row, share in ((0, 0.0), (6, 0.5), (10, 1.0)):
                landmarks[row : row + 2] = x.mean(), y.min() + share * np.ptp(y), 0.9
        return found, landmarks


class Embracing(Standing):
    """Takes people who touch for one region; sees the landmarks of the one in the middle of the square."""

    def segment_pose(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        masks, landmarks = self._masks(image), np.full((12, 3), np.nan)
        middle = (len(image) - 1) / 2
        if masks:
            y, x = min((np.nonzero(mask) for mask in masks), key=lambda pixels: abs(float(pixels[1].mean()) - middle))
            for row, share in ((0, 0.0), (6, 0.5), (10, 1.0)):
                landmarks[row : row + 2] = x.mean(), y.min() + share * np.ptp(y), 0.9
        return np.asarray(0.9 * np.any([*masks, np.zeros(image.shape[:2])], axis=0), np.float32), landmarks


def test_two_who_touch_are_found_where_each_image_shows_the_nearer_one() -> None:
    """Between them is a point that all four lines of sight pass; the masks show both."""
    places = [(-0.14, 0.24), (0.14, -0.24)]
    found = masks_of(Embracing()).label(shown(places)[0])
    assert len(found.landmarks) == 2
    hips = [triangulate_joints(RIG, person)[0][LANDMARKS.index("hip_l")] for person in found.landmarks]
    np.testing.assert_allclose(sorted(hip[:2].tolist() for hip in hips), places, atol=0.1)


@pytest.mark.parametrize(
    ("now", "searched", "asked"),
    [
        ([(0.25, 0.1)], 2, 4),  # every second image is searched for others
        ([(0.6, 0.1)], 2, 8),  # some squares about the last place do not hold the person
        ([(0.25, 0.1), (-0.6, -0.2)], 8, 25),
        ([], 4, 4),
    ],
    ids=["there", "moved on", "a newcomer", "gone"],
)
def test_expected_people_are_not_detected_again(now: list[At], searched: int, asked: int) -> None:
    places = masks_of(Standing()).label(shown([(0.2, 0.1)])[0]).places
    assert places is not None and len(places) == 1
    segmenter = Standing()
    images, who = shown(now)
    found = masks_of(segmenter).label(images, places)
    assert segmenter.searched == searched and len(segmenter.seen) <= asked
    for k in range(len(now)):
        assert (found.masks > 0)[who == k + 1].mean() > 0.9, k
    assert (found.masks > 0)[who == 0].mean() < 0.002


def test_newcomer_is_found_by_the_other_half_of_the_cameras_in_the_next_turn() -> None:
    segmenter = masks_of(Standing())
    places = segmenter.label(shown([(0.2, 0.1)])[0]).places or ()
    images, who = shown([(0.2, 0.1), (-0.6, -0.2)])
    images[::2] = shown([(0.2, 0.1)])[0][::2]  # only the cameras 1 and 3 see the newcomer
    for turn in (0, 1):
        masks = segmenter.label(images, places, turn).masks
        assert ((masks[1::2] > 0)[who[1::2] == 2].mean() > 0.9) == (turn == 1)
