"""Who is tracked: the people of the user's choice among those found, and what is known of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.model.cameras.up import up_vector
from tk.model.people import LocatedPerson
from tk.model.setup import Subject
from tk.run.task import Choice


def chosen(
    choice: Choice, found: Sequence[LocatedPerson], subject: Subject, note: Callable[[str], None]
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


# A subject of whom nothing is known fits as well as one who is this far off, metres: half a stride, and more than the
# error of a height.
_UNKNOWN_M = 0.5


def unknown(first: Subject) -> Subject:
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
    return [subjects[who[p]] if p in who else unknown(subjects[0]) for p in range(len(people))]


def _position(subject: Subject) -> NDArray[np.float64] | None:
    return subject.init.center if subject.init is not None else subject.position
