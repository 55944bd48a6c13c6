"""Who is who before tracking: who is really there, in the order of the numbers; who is chosen; what is known of each.

A camera that is turned or upside down makes one person look like several, or lets the person stand elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.kernels.mask_values import PERSON
from tk.model.cameras.camera import Rig
from tk.model.cameras.up import up_vector
from tk.model.setup import Setup, Subject
from tk.people.find import LocatedPerson, PeopleFinder, order_people
from tk.trackers.camera_monitor import image_faults, opening_agreement
from tk.trackers.protocol import Frame, without_cameras

# A camera shows a person if its mask covers this share of the person's hull from the other cameras. Right cameras of
# the demo cover 0.84 and more: the hull is larger than the person. One that is upside down covers 0.19.
_SHOWN = 0.5
# A subject of whom nothing is known fits as well as one who is this far off, metres: half a stride, and more than the
# error of a height.
_UNKNOWN_M = 0.5


def in_order(
    finder: PeopleFinder, setup: Setup, opening: Sequence[Frame], found: tuple[LocatedPerson, ...]
) -> tuple[LocatedPerson, ...]:
    """Return the people who are really there, in the order of their numbers. Arguments as of :func:`really_there`."""
    first = setup.subjects[0]
    return order_people(really_there(finder, setup, opening, found), setup.volume, first.height_m, first.position)


def really_there(
    finder: PeopleFinder, setup: Setup, opening: Sequence[Frame], found: tuple[LocatedPerson, ...]
) -> tuple[LocatedPerson, ...]:
    """Return the people in the first frame of an opening: those just ``found`` in all cameras, or one.

    It is one if the cameras without those that contradict them show one, whom the contradicting ones do not show. A
    camera that alone sees a second person shows the first one, too.
    """
    if len(found) == 1 and finder.explain(opening[0].masks, found):
        return found
    agreement = opening_agreement(setup, opening, image_faults(setup.rig, opening))
    if agreement.refusal or not agreement.wrong:
        return found
    wrong = np.isin(np.arange(len(setup.rig)), agreement.wrong)
    frame = without_cameras(opening[0], wrong)
    people = finder.find(frame.masks, frame.uncertain, landmarks=frame.landmarks)
    if len(people) == 1 and (_covered(setup.rig, opening[0].masks, people[0])[wrong] < _SHOWN).all():
        return people
    return found


def _covered(rig: Rig, masks: NDArray[np.uint8], person: LocatedPerson) -> NDArray[np.float64]:
    """Return (C,) the share of a person's points that the masks (C, H, W) cover; 1 if a camera sees none."""
    shares = np.ones(len(rig))
    for c, camera in enumerate(rig):
        pixels, depth = camera.project(person.points)
        inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        if inside.any():
            x, y = pixels[inside].astype(int).T
            shares[c] = np.mean(masks[c, y, x] >= PERSON)
    return shares


def chosen(
    choice: str | tuple[int, ...], found: Sequence[LocatedPerson], subject: Subject, note: Callable[[str], None]
) -> tuple[int, ...]:
    """Return the numbers of the people in the result among those found in the first frame: who is chosen and stands in
    the volume. If nobody stands there, number 0 does.

    Raises:
        CaptureError: a chosen person is seen by one camera.
    """
    present = tuple(n for n, person in enumerate(found) if person.inside) or (0,)
    if isinstance(choice, tuple):
        numbers = tuple(n for n in choice if n in present)
        for n in numbers if len(found) > 1 else ():
            if found[n].views.sum() < 2:
                raise CaptureError(
                    f"person {n} is seen by one camera in the first frame, and two are needed: choose all, or a later "
                    "first frame",
                    hint="with --frames N:",
                )
        return numbers
    if choice == "all":
        return present
    number = 0
    place = _position(subject)
    if place is not None and found:
        number = int(np.argmin([np.linalg.norm(person.position - place) for person in found]))
    if len(found) > 1:
        note(
            f"{len(found)} people are in view, and number {number} is tracked, at {found[number].where}; "
            "the option people chooses others by the numbers that tk inspect prints, or all"
        )
    return (number,)


def unknown_subject(first: Subject) -> Subject:
    """Return a subject of whom nothing is known but how the recording begins."""
    return Subject(in_init_pose=first.in_init_pose)


def matched(subjects: Sequence[Subject], people: Sequence[LocatedPerson], up: str) -> list[Subject]:
    """Return the subject of each of the people, by the least sum of distances on the floor and differences of height;
    nothing is known of the others."""
    cost, upward = np.zeros((len(people), len(subjects))), up_vector(up)
    for p, person in enumerate(people):
        for s, subject in enumerate(subjects):
            place = _position(subject)
            if place is not None:
                cost[p, s] += float(np.linalg.norm(np.cross(person.position - place, upward)))
            if subject.height_m is not None:
                cost[p, s] += abs(person.height_m - subject.height_m)
            if place is None and subject.height_m is None:
                cost[p, s] += _UNKNOWN_M
            cost[p, s] += 1e-6 * abs(p - s)
    if not people:
        return []
    if len(subjects) == 1:  # SciPy's optimisation takes 0.3 s to import
        who = {int(cost.argmin()): 0}
    else:
        who = dict(zip(*scipy.optimize.linear_sum_assignment(cost), strict=True))
    return [subjects[who[p]] if p in who else unknown_subject(subjects[0]) for p in range(len(people))]


def _position(subject: Subject) -> NDArray[np.float64] | None:
    return subject.init.center if subject.init is not None else subject.position
