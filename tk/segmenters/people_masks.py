"""Masks of everybody in all cameras, from a segmenter that works on single images.

A network segments the person in the middle of a square. It is inaccurate for a small person in a large image, prefers
one person if a square shows several, and misses people whom others hide. The calibrated cameras solve this:

1. The segmenter detects people in every image, and gets the square around each. Detections whose landmarks agree are
   one person (:func:`~tk.model.cameras.landmark_agreement.most_likely`); without landmarks, or where they do not agree,
   detections are matched by the middle of the body (:mod:`tk.model.masks.sightings`). In every other camera, also
   without a detection (from above, for example), the segmenter gets the square around each person in space.
2. Where a person's landmarks in a camera show somebody else than in most cameras, the segmenter gets the square around
   the points that these cameras show. One wrong mask spoils a hull, so hulls serve only where no landmarks agree: if
   the square does not contain the hull of the person's other masks or is much too large, or the mask shows another,
   the segmenter gets the square around the hull. A further answer counts only if the cameras agree no less on the
   person's landmarks.
3. The people who are found are painted over, and the search is repeated until nobody new is found: a detection whose
   landmarks show one of them is no newcomer, nor is a person whose trunk is where one of theirs is. Detections that
   match no other camera's are people whom one camera shows.
4. Where somebody else stands in a person's square, the segmenter gets the square again, with everybody else painted
   over.

The mask of a camera is the union of the people's masks. A segmenter that cannot detect people gets the part of the
image that shows the volume, and must find everybody in it.

Where people are known to be, from a frame shortly before, no detection is needed: the segmenter gets the squares around
them at once, and again where these do not hold them. Only then, in the images without them, others are searched for.

No state is kept between frames, so a resumed run sees the same masks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from tk.model.body.body_points import LANDMARKS
from tk.model.cameras.camera import Rig
from tk.model.cameras.landmark_agreement import (
    APART_M,
    Consensus,
    associated,
    consensus,
    evidence_of_sets,
    most_likely,
    trunk,
)
from tk.model.cameras.volume import Volume
from tk.model.hull.coarse import CoarseHull, parts
from tk.model.masks.sightings import Patch, SeenPerson, Sighting, locate, near, place_of, volume_patch
from tk.segmenters import Finder, Segmenter, segmented
from tk.system.machine import cores

T = TypeVar("T")
Images = NDArray[np.uint8]
Bool = NDArray[np.bool_]

#: side of the square, relative to the ball around the body (MediaPipe's 1.25) and to the hull (slightly more)
_BALL_MARGIN, _HULL_MARGIN = 1.25, 1.35
#: a mask that covers a smaller share of the others' hull shows another person. The hull is up to twice as large as the
#: person; correct masks cover 0.4 and more (measured).
_LEAST_SHARE = 0.3
#: pixels with a probability from here to 0.5 are uncertain
_UNCERTAIN = 0.1
#: a square larger than the hull's by this factor wastes the network's pixels
_TOO_LARGE = 1.6
#: somebody new covers, in two cameras, this share of the square with pixels that no other mask shows. A person covers
#: 0.1 of it, and 0.07 or more if half hidden; what the search takes for a person, an arm that a mask misses for
#: example, less than 0.06.
_LEAST_NEW = 0.065
#: a part of a mask that no other camera shows is a speck below this share of the largest part: somebody whom one camera
#: shows is larger.
_SPECK = 0.25
#: rounds of the search at most: three people who hide each other, and a round that finds nobody
_ROUNDS = 4
#: width by which a mask is enlarged before it is painted over, as a share of the square: the outline's error
_RIM = 0.01


@dataclass
class _Person:
    """A person's squares and masks.

    Attributes:
        patches: one per camera.
        masks, uncertain: (C, H, W) uint8, 0 or 255, and bool.
        landmarks: (C, L, 4), see :mod:`tk.model.cues.landmarks`; NaN where there are none.
        agreement: which cameras' landmarks agree; None if it is not known yet.
    """

    patches: list[Patch]
    masks: Images
    uncertain: Bool
    landmarks: NDArray[np.float64]
    agreement: Consensus | None = None


class _View(NamedTuple):
    """What the segmenter sees of a sighting in an image."""

    sighting: Sighting
    camera: int
    patch: Patch
    found: NDArray[np.float32]  # (H, W) probabilities
    landmarks: NDArray[np.float64]  # (L, 4)


class Segmented(NamedTuple):
    """What a segmenter sees in a frame set.

    Attributes:
        masks: (C, H, W) uint8, 0 or 255.
        uncertain: (C, H, W) bool, where the mask is 0.
        landmarks: (N, C, L, 4) of each of N people's landmarks in each image, see
            :data:`~tk.model.body.body_points.LANDMARKS`; NaN where an image shows none.
        people: (C, H, W) uint8, bit n: the mask of person n shows the pixel. Of the first eight people.
        places: where the people are; None if that is unknown of one of them.
    """

    masks: Images
    uncertain: Bool
    landmarks: NDArray[np.float64]
    people: Images
    places: tuple[SeenPerson, ...] | None = None


class PeopleMasks:
    """Segments the people in the images of a rig."""

    def __init__(self, segmenter: Segmenter, name: str, rig: Rig, volume: Volume) -> None:
        self._segmenter, self._name = segmenter, name
        self._rig, self._volume = rig, volume
        self._hull = CoarseHull(rig, volume)
        self._whole = [volume_patch(camera, volume) for camera in rig]
        parallel = getattr(segmenter, "parallel", False)
        self._threads = ThreadPoolExecutor(min(cores(), len(rig)), "tk-segment") if parallel else None

    def _each(self, see: Callable[[int], T], cameras: Sequence[int]) -> list[T]:
        """Return what ``see`` returns for each of some cameras; at once, if the segmenter can be called so."""
        return list((self._threads.map if self._threads else map)(see, cameras))

    def segment(self, images: Images) -> Images:
        """Return the masks (C, H, W) uint8, 0 or 255, of images (C, H, W, 3) uint8 BGR.

        Raises:
            ConfigError: the segmenter does not return probabilities.
        """
        return self.label(images).masks

    def label(self, images: Images, expected: Sequence[SeenPerson] = (), turn: int = 0) -> Segmented:
        """Return what the segmenter sees in images (C, H, W, 3); see :meth:`segment`.

        Args:
            images: the frame set.
            expected: where people are expected. If all of them are there, every second camera is searched for others,
                and the rest if it shows somebody.
            turn: the first of these cameras, modulo two.
        """
        masks, bits = np.zeros((2, *images.shape[:3]), np.uint8)
        uncertain = np.zeros(images.shape[:3], np.bool_)
        people = self._people(images, expected, turn)
        for n, person in enumerate(people):
            masks |= person.masks
            bits |= person.masks & np.uint8(1 << n if n < 8 else 0)
            uncertain |= person.uncertain
        shape = len(people), len(images), len(LANDMARKS), 4
        landmarks = np.array([person.landmarks for person in people]).reshape(shape)
        places = [SeenPerson.at(self._agreement(person).points) for person in people]
        known = tuple(place for place in places if place is not None)
        landmarks = associated(self._rig, landmarks)
        return Segmented(masks, uncertain & (masks == 0), landmarks, bits, known if len(known) == len(people) else None)

    def landmarks(self, images: Images, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the landmarks (C, L, 4) in images (C, H, W, 3) of a person whose landmarks are expected at points
        (L, 3), world frame, metres; None if nobody can be there."""
        if (place := SeenPerson.at(points)) is None:
            return None
        person, cameras = self._empty(self._patches(place)), range(len(images))
        self._each(lambda c: self._segment(images, c, person), cameras)
        self._compare(images, person, cameras)
        return np.asarray(associated(self._rig, person.landmarks[None])[0])

    def without_specks(self, masks: Images) -> Images:
        """Return masks (C, H, W) without small parts that no other camera shows: shadows, reflections."""
        areas = [parts(mask)[2] for mask in masks]
        doubtful = [c for c, area in enumerate(areas) if (area < _SPECK * area.max(initial=0)).any()]
        if not doubtful:
            return masks
        hull, result = self._hull.everybody(masks), masks.copy()
        for c in doubtful:
            result[c] = self._hull.only(hull, c, masks[c], _SPECK)
        return result

    def _people(self, images: Images, expected: Sequence[SeenPerson], turn: int) -> list[_Person]:
        if not isinstance(self._segmenter, Finder):
            everybody = self._empty(self._whole)
            self._each(lambda c: self._segment(images, c, everybody), range(len(images)))
            self._compare(images, everybody, range(len(images)))
            return [everybody]
        left, every = images.copy(), range(len(images))
        people: list[_Person] = []
        for place in expected:
            if person := self._followed(left, place):
                people.append(person)
                self._paint_over(left, person)
        all_there = bool(expected) and len(people) == len(expected)
        cameras, views = list(every)[turn % 2 :: 2] if all_there else list(every), list[_View]()
        for _ in range(_ROUNDS):
            views += self._find(images, left, cameras)
            if views and len(cameras) < len(images):
                views += self._find(images, left, sorted(set(every) - set(cameras)))
            cameras = list(every)
            new, views = self._newcomers(left, people, views)
            if not new:
                break
            people += new
            for person in new:
                self._paint_over(left, person)
        self._separate(images, people)
        return people + self._alone(images, people, views)

    def _newcomers(
        self, left: Images, people: Sequence[_Person], views: list[_View]
    ) -> tuple[list[_Person], list[_View]]:
        """Return the people whom views show and who are not among the people already found; and the views that show
        nobody."""
        for known in people:
            views = self._of_others(known, views)
        new: list[_Person] = []
        unknown: list[_View] = []
        while len(of_one := most_likely(self._rig, [v.camera for v in views], np.array([v.landmarks for v in views]))):
            members = [views[k] for k in of_one]
            views = [view for k, view in enumerate(views) if k not in of_one]
            joined = self._joined(left, members)
            if joined is None:
                unknown += members
            elif not any(self._in_one_place(joined, other) for other in [*people, *new]):
                new.append(joined)
                views = self._of_others(joined, views)
        views += unknown
        # each sighting once, in the order of the cameras
        sightings = [list(dict.fromkeys(v.sighting for v in views if v.camera == c)) for c in range(len(left))]
        located, rest = locate(self._rig, self._volume, sightings)
        new += [person for seen in located if (person := self._look(left, seen, [*people, *new]))]
        return new, [view for view in views if view.sighting in rest[view.camera]]

    def _of_others(self, person: _Person, views: list[_View]) -> list[_View]:
        """Return the views that do not show a person."""
        if not views:
            return views
        sets = np.array([view.landmarks for view in views])
        evidence = evidence_of_sets(self._rig, [view.camera for view in views], sets, person.landmarks)
        return [view for view, ratio in zip(views, evidence, strict=True) if not ratio > 0]

    def _joined(self, left: Images, views: Sequence[_View]) -> _Person | None:
        """Return the masks of a person whom views of some cameras show; None if nobody in the volume is known to be
        there.

        The squares around the place of the person are more exact than the views', but may show somebody beside: those
        on which the cameras' landmarks agree better are kept.
        """
        place = place_of(self._rig, [(view.camera, view.sighting) for view in views])
        if place is None:
            return None
        seen, person = (self._empty(self._patches(place)) for _ in range(2))
        for view in views:
            seen.patches[view.camera], seen.landmarks[view.camera] = view.patch, view.landmarks
            self._put(seen, view.camera, view.found)
        if not near(trunk(self._agreement(seen).points), self._volume):
            return None
        self._each(lambda c: self._segment(left, c, person), range(len(left)))
        others = np.setdiff1d(np.arange(len(left)), [view.camera for view in views])
        seen.masks[others], seen.uncertain[others] = person.masks[others], person.uncertain[others]
        seen.landmarks[others] = person.landmarks[others]
        seen.agreement = None
        better = seen if self._agreement(seen).support > self._agreement(person).support else person
        self._compare(left, better, range(len(left)))
        return self._carved(better)

    def _in_one_place(self, a: _Person, b: _Person) -> bool:
        """Return whether landmarks show the trunks of two people in one place: they are one person."""
        apart = trunk(self._agreement(a).points) - trunk(self._agreement(b).points)
        return bool(np.linalg.norm(apart) < APART_M)

    def _alone(self, images: Images, people: Sequence[_Person], views: Sequence[_View]) -> list[_Person]:
        """Return those whom one camera shows: the views that match no other camera's."""
        alone: list[_Person] = []
        for view in views:
            person = self._empty([view.patch] * len(images))
            person.landmarks[view.camera] = view.landmarks
            self._put(person, view.camera, view.found)
            if self._new_views(person, [*people, *alone])[view.camera]:
                alone.append(person)
        return alone

    def _find(self, images: Images, left: Images, cameras: Sequence[int]) -> list[_View]:
        """Return the people whom the segmenter finds in some images, in which those already found are painted over
        (``left``). Where a square shows some of these, there are two views: with and without them."""

        def views(c: int) -> list[_View]:
            found = []
            for sighting in self._sightings(left, c):
                patch = sighting.patch(_BALL_MARGIN)
                same = np.array_equal(patch.cut(left[c]), patch.cut(images[c]))
                pictures = [left[c]] if same else [left[c], images[c]]
                found += [_View(sighting, c, patch, *self._seen(picture, c, patch)) for picture in pictures]
            return found

        return [view for each in self._each(views, cameras) for view in each]

    def _sightings(self, images: Images, c: int) -> list[Sighting]:
        """Return the people in the part of an image that shows the volume."""
        assert isinstance(self._segmenter, Finder)
        whole = self._whole[c]
        found = self._segmenter.find(whole.cut(self._shown(images[c], c)))
        x, y = (value - (whole.side - 1) / 2 for value in whole.center)  # whole patches are not rotated
        moved = [Sighting((s.center[0] + x, s.center[1] + y), (s.top[0] + x, s.top[1] + y), s.score) for s in found]
        return [s for s in moved if np.isfinite(s.radius)]

    def _followed(self, left: Images, place: SeenPerson) -> _Person | None:
        """Return the masks of a person who is expected at a place; None if no two images show anybody there.

        Where the square does not hold the sphere around the person, the segmenter gets the right one.
        """
        person, cameras = self._empty(self._patches(place)), range(len(left))
        self._each(lambda c: self._segment(left, c, person), cameras)
        here = SeenPerson.at(self._agreement(person).points)
        if here is None:
            return None
        better = dict(enumerate(self._patches(here)))
        bad = [c for c in cameras if not person.patches[c].fits(better[c], _BALL_MARGIN, _TOO_LARGE)]
        self._ask_again(left, person, {c: better[c] for c in bad})
        self._compare(left, person, cameras)
        if SeenPerson.at(self._agreement(person).points) is None:
            return None
        return self._carved(person)

    def _patches(self, person: SeenPerson) -> list[Patch]:
        patches = [person.patch(camera, _BALL_MARGIN) for camera in self._rig]
        return [patch or whole for patch, whole in zip(patches, self._whole, strict=True)]

    def _look(self, left: Images, seen: SeenPerson, people: Sequence[_Person]) -> _Person | None:
        """Return the masks of a person in the images that are left; None if they show nobody new."""
        person = self._empty(self._patches(seen))
        self._each(lambda c: self._segment(left, c, person), seen.cameras)
        self._compare(left, person, seen.cameras)
        if people and np.count_nonzero(self._new_views(person, people)) < 2:
            return None
        others = [c for c in range(len(left)) if c not in seen.cameras]
        self._each(lambda c: self._segment(left, c, person), others)
        self._compare(left, person, range(len(left)))
        return self._carved(person)

    def _carved(self, person: _Person) -> _Person:
        """Return the person without the regions of the masks that are away from the hull."""
        hull = self._by_all(person)
        for c, mask in enumerate(person.masks):
            person.masks[c] = self._hull.only(hull, c, mask)
        return person

    def _compare(self, images: Images, person: _Person, cameras: Sequence[int]) -> None:
        """Where one of some cameras shows somebody else than the others, or its square fits badly, give the segmenter
        the square around what the others show: people who stand close together are sighted as one."""
        for c in cameras:
            better = self._better(person, c)
            if better is not None and better != person.patches[c]:
                self._ask_again(images, person, {c: better})

    def _better(self, person: _Person, c: int) -> Patch | None:
        """Return the square of a person in an image that follows from what the cameras show: where the landmarks of two
        agree, from their points, else from the hull of the other cameras' masks. None if the present one is good."""
        agree, points, _ = self._agreement(person)
        if (seen := SeenPerson.at(points)) is not None:
            return None if agree[c] else seen.patch(self._rig[c], _BALL_MARGIN)
        patch, others = person.patches[c], self._hull.subject(person.masks, np.arange(len(self._rig)) != c)
        expected = self._hull.points(others, c)
        if not len(expected):
            return None
        better = Patch.about(expected, _HULL_MARGIN, patch.angle)
        missed = self._hull.share(others, c, person.masks[c]) < _LEAST_SHARE
        return better if missed or patch.side > _TOO_LARGE * better.side or not patch.holds(expected) else None

    def _by_all(self, person: _Person) -> Bool:
        """Return (N,) the voxels of a person's hull, by the cameras whose landmarks do not show somebody else."""
        agree = self._agreement(person).agree
        unknown = ~np.isfinite(person.landmarks[..., 0]).any(axis=1)
        return self._hull.subject(person.masks, agree | unknown if agree.any() else ~agree)

    def _new_views(self, person: _Person, people: Sequence[_Person]) -> Bool:
        """Return (C,) whether a camera shows enough of a person that nobody else's mask shows."""
        own = person.masks > 0
        for other in people:
            own &= other.masks == 0
        area = np.count_nonzero(own, axis=(1, 2))
        return np.asarray(area > [_LEAST_NEW * patch.side**2 for patch in person.patches])

    def _separate(self, images: Images, people: Sequence[_Person]) -> None:
        """Add what the segmenter sees of a person where others stood in the square and are now painted over."""
        for person in people:
            for c in range(len(images)):
                patch = person.patches[c]
                beside = [p for p in people if p is not person and patch.holds(np.array([p.patches[c].center]))]
                if not beside:
                    continue
                painted = images[c].copy()
                for other in people:
                    if other is not person:
                        self._paint(painted, c, other.masks[c], other.patches[c])
                found, landmarks = self._seen(painted, c, person.patches[c])
                if not self._take(person, c, landmarks):
                    continue
                others = self._hull.subject(person.masks, np.arange(len(images)) != c)
                near = self._hull.near(others, c, images.shape[1:3])
                person.uncertain[c] |= (found > _UNCERTAIN) & near
                person.masks[c][(found > 0.5) & near] = 255

    def _paint_over(self, images: Images, person: _Person) -> None:
        """Paint a person over in images (C, H, W, 3)."""
        self._each(lambda c: self._paint(images[c], c, person.masks[c], person.patches[c]), range(len(images)))

    def _paint(self, image: Images, c: int, mask: Images, patch: Patch) -> None:
        """Paint a mask (H, W) over in an image (H, W, 3), with the mean colour of the other pixels."""
        picture, shown, radius = self._shown(image, c), self._shown(mask, c), max(round(_RIM * patch.side), 1)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        x, y, w, h = cv2.boundingRect(shown)
        around = slice(max(y - radius, 0), y + h + radius), slice(max(x - radius, 0), x + w + radius)
        others = np.ones(shown.shape, np.uint8)
        others[around] = cv2.dilate(shown[around], disc) == 0
        picture[around][others[around] == 0] = cv2.mean(picture, others)[:3]

    def _empty(self, patches: Sequence[Patch]) -> _Person:
        shape = len(self._rig), *self._rig.frame_shape
        landmarks = np.full((len(self._rig), len(LANDMARKS), 4), np.nan)
        return _Person(list(patches), np.zeros(shape, np.uint8), np.zeros(shape, np.bool_), landmarks)

    def _ask_again(self, images: Images, person: _Person, patches: Mapping[int, Patch]) -> None:
        """Give the segmenter other squares of a person in some images."""
        answers = self._each(lambda c: self._seen(images[c], c, patches[c]), list(patches))
        for (c, patch), (found, landmarks) in zip(patches.items(), answers, strict=True):
            if self._take(person, c, landmarks):
                person.patches[c] = patch
                self._put(person, c, found)

    def _take(self, person: _Person, c: int, landmarks: NDArray[np.float64]) -> bool:
        """Replace a person's landmarks in an image, unless the cameras then agree less, or there are none any more: the
        network shows somebody else, or nobody. Return whether they were replaced."""
        before, earlier = self._agreement(person), person.landmarks[c].copy()
        if np.isnan(landmarks).all() and not np.isnan(earlier).all():
            return False
        person.landmarks[c], person.agreement = landmarks, None
        if self._agreement(person).support < before.support:
            person.landmarks[c], person.agreement = earlier, before
            return False
        return True

    def _agreement(self, person: _Person) -> Consensus:
        """Return which cameras' landmarks of a person agree."""
        person.agreement = person.agreement or consensus(self._rig, person.landmarks)
        return person.agreement

    def _segment(self, images: Images, c: int, person: _Person) -> None:
        """Give the segmenter the square of a person in an image; replace the mask and the landmarks."""
        found, person.landmarks[c] = self._seen(images[c], c, person.patches[c])
        person.agreement = None
        self._put(person, c, found)

    @staticmethod
    def _put(person: _Person, c: int, found: NDArray[np.float32]) -> None:
        """Replace a person's mask in an image by the probabilities (H, W)."""
        np.multiply(found > 0.5, np.uint8(255), out=person.masks[c])
        person.uncertain[c] = (found > _UNCERTAIN) & (found <= 0.5)

    def _seen(self, image: Images, c: int, patch: Patch) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the probability (H, W) of each pixel to show the person in the middle of a square, 0 outside it; and
        the person's landmarks (L, 4) in the image."""
        whole = np.zeros(image.shape[:2], np.float32)
        picture = self._shown(image, c)
        found, landmarks = segmented(self._segmenter, self._name, patch.cut(picture))
        self._shown(whole, c)[...] = patch.paste(found, picture.shape[:2])
        return whole, np.column_stack([patch.in_image(landmarks[:, :2]), landmarks[:, 2:]])

    def _shown(self, image: NDArray, c: int) -> NDArray:
        """Return the part (h, w) of a padded image (H, W) that the camera shows."""
        return image[: self._rig[c].height, : self._rig[c].width]
