"""Identity: people who come close to each other may be exchanged by their trackers.

While two people are in contact their pixels are assigned by position alone. After it, the colours and the body of each
trajectory are compared with those of both people before it: a log-likelihood for each pair, and the assignment with the
largest sum. If it is the exchanged one, the trackers are exchanged, and the frames in which they were mixed up are
exchanged when the run is finished. If neither is clearly better, the frames of the contact are suspect.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.io.captures.mask_store import MaskStore, MaskStores
from tk.io.results.data import Result
from tk.io.results.status import Status
from tk.model.body.joints import JOINTS
from tk.model.cues.part_colors import LearnedColors
from tk.model.masks.image_health import described
from tk.people.person import Answer, Person

_LOG = logging.getLogger(__name__)
Float = NDArray[np.float64]

# People are in contact if their pelvises are closer than this, metres: arms reach so far.
CONTACT_M = 1.0
# An assignment is clear if its log-likelihood, mean per pixel and summed over both people, exceeds that of the other by
# this.
CLEAR = 0.3

OPEN, KEPT, EXCHANGED, UNCLEAR = range(4)


@dataclass
class Contact:
    """A time during which two people are close to each other.

    Attributes:
        people: their numbers.
        first, last: frames.
        moment: the frame from which on an exchange is likeliest, because it makes the steps of the pelvises shortest.
        shorter_m: by how much an exchange in this frame makes them shorter, metres; negative in most cases.
        pelvis: (2, 3) m, in the last frame.
        outcome: :data:`OPEN`, :data:`KEPT`, :data:`EXCHANGED` or :data:`UNCLEAR`.
        learned: the colours of both before the contact.
    """

    people: tuple[int, int]
    first: int
    last: int
    moment: int
    pelvis: Float
    shorter_m: float = -np.inf
    outcome: int = OPEN
    learned: tuple[LearnedColors, ...] = field(default=(), repr=False)

    @property
    def without_comparison(self) -> int:
        """The outcome if the colours of the two cannot be compared after the contact."""
        return outcome_of(np.zeros((2, 2)), self.shorter_m)


class Contacts:
    """The contacts of a run."""

    def __init__(self) -> None:
        self.all: list[Contact] = []

    def update(
        self, frame: int, pelvis: Mapping[int, Float], learned: Mapping[int, LearnedColors | None]
    ) -> list[Contact]:
        """Return the contacts that have ended.

        Args:
            frame: number of the frame.
            pelvis: (3,) m, of each person who is tracked in it.
            learned: colours of each person; None if they are unknown.
        """
        now = {c.people: c for c in self.all if c.outcome == OPEN}
        ended = []
        numbers = sorted(pelvis)
        for i, a in enumerate(numbers):
            for b in numbers[i + 1 :]:
                both = np.array([pelvis[a], pelvis[b]])
                distance_m = float(np.linalg.norm(both[0] - both[1]))
                contact = now.get((a, b))
                if contact is None and distance_m < CONTACT_M:
                    colors = tuple(c for c in (learned[a], learned[b]) if c is not None)
                    if len(colors) == 2:
                        self.all.append(Contact((a, b), frame, frame, frame, both, learned=colors))
                elif contact is not None:
                    kept, crossed = (
                        np.linalg.norm(order - contact.pelvis, axis=1).sum() for order in (both, both[::-1])
                    )
                    if kept - crossed > contact.shorter_m:
                        contact.moment, contact.shorter_m = frame, float(kept - crossed)
                    contact.last, contact.pelvis = frame, both
                    if distance_m >= CONTACT_M:
                        ended.append(contact)
        return ended

    def leave(self, number: int) -> None:
        """End the contacts of somebody who is no longer tracked: nobody can be compared, and somebody else may get the
        number."""
        for contact in self.all:
            if contact.outcome == OPEN and number in contact.people:
                contact.outcome, contact.learned = contact.without_comparison, ()


def judge_contacts(contacts: Contacts, tracked: Sequence[Person], answers: Mapping[int, Answer]) -> None:
    """Compare people whose contact has ended with those before it; exchange their trackers if they were mixed up.

    Args:
        contacts: of the run.
        tracked: the people.
        answers: theirs for a frame, by number.
    """
    if len(tracked) < 2:
        return
    here = {person.number: person for person in tracked if not person.lost}
    pelvis = {n: answers[n].estimate.joints[JOINTS.index("pelvis")] for n in here}
    frame = next(iter(answers.values())).share.index
    for contact in contacts.update(frame, pelvis, {n: person.sharing.learned() for n, person in here.items()}):
        pair = [here[number] for number in contact.people]
        likeness = _likeness(contact, pair, answers)
        contact.outcome = outcome_of(likeness, contact.shorter_m)
        _LOG.debug("contact of %s, frames %d to %d: %s", contact.people, contact.first, contact.last, likeness)
        if contact.outcome == EXCHANGED:
            states = [person.state for person in pair]
            for person, state, colors in zip(pair, states[::-1], contact.learned, strict=True):
                tracker: Any = state.tracker
                person.state = replace(state, tracker=replace(tracker, colors=colors))
        contact.learned = ()


def last_outcome(contact: Contact, tracked: Sequence[Person], answers: Mapping[int, Answer]) -> int:
    """Return the outcome of a contact at the end of the run, arguments as for :func:`judge_contacts` and those of the
    last frame; if it has not ended, the people are compared in that frame, in which both may be lost."""
    if contact.outcome != OPEN:
        return contact.outcome
    here = {person.number: person for person in tracked if not person.lost and person.number in answers}
    if not here.keys() >= set(contact.people):
        return contact.without_comparison
    return outcome_of(_likeness(contact, [here[n] for n in contact.people], answers), contact.shorter_m)


def _likeness(contact: Contact, pair: Sequence[Person], answers: Mapping[int, Answer]) -> Float:
    """Return (2, 2) the log-likelihood of trajectory i as person j of a contact."""
    likeness = np.zeros((2, 2))
    for i, one in enumerate(pair):
        share, pose = answers[one.number].used, one.sharing.last_poses()[0]
        for j, other in enumerate(pair):
            likeness[i, j] = other.sharing.likeness(share, contact.learned[j], pose)
    return likeness


def outcome_of(likeness: Float, shorter_m: float) -> int:
    """Return the outcome of a contact.

    Without a clear assignment the people are kept if an exchange would lengthen the steps of the two pelvises by
    :data:`CONTACT_M` in any frame: people whose pelvises stay half as far apart are not mixed up.

    Args:
        likeness: (2, 2) log-likelihood of trajectory i as person j.
        shorter_m: see :class:`Contact`.
    """
    kept, exchanged = np.trace(likeness), np.trace(likeness[::-1])
    if abs(kept - exchanged) > CLEAR:
        return KEPT if kept > exchanged else EXCHANGED
    return UNCLEAR if shorter_m > -CONTACT_M else KEPT


def unmixed(people: Sequence[Result], contacts: Sequence[Contact]) -> tuple[Result, ...]:
    """Return the people with the frames exchanged that the contacts name; lengths of the people do not change."""
    found = list(people)
    for contact in contacts:
        if contact.outcome != EXCHANGED:
            continue
        of_a, of_b = (found[n] for n in contact.people)
        rows = np.flatnonzero(_exchanged(contact, of_a, of_b))
        for n, mine, other in zip(contact.people, (of_a, of_b), (of_b, of_a), strict=True):
            found[n] = _with_rows(mine, other, rows)
    return tuple(found)


def _exchanged(contact: Contact, of_a: Result, of_b: Result) -> NDArray[np.bool_]:
    """Return (F,) the frames in which the two of a contact are exchanged: none in which one is absent."""
    there = (of_a.status != Status.ABSENT) & (of_b.status != Status.ABSENT)
    return np.asarray(there & (of_a.frames >= contact.moment) & (of_a.frames <= contact.last))


def doubtful(person: Result, contacts: Sequence[Contact]) -> NDArray[np.bool_]:
    """Return (F,) the frames of a person in which it is unclear who is who."""
    found = np.zeros(len(person), np.bool_)
    for contact in contacts:
        if contact.outcome == UNCLEAR and person.person in contact.people:
            found |= (person.frames >= contact.first) & (person.frames <= contact.last)
    return found


def report(contacts: Sequence[Contact]) -> list[str]:
    """Return a line on each contact after which people were exchanged or may have been."""
    lines = []
    for contact in contacts:
        a, b = contact.people
        if contact.outcome == EXCHANGED:
            lines.append(f"people {a} and {b} were mixed up in frame {contact.moment}; this is undone")
        elif contact.outcome == UNCLEAR:
            which = described(contact.first, contact.last, contact.last - contact.first + 1)
            lines.append(f"people {a} and {b} may have been mixed up when they met: suspect, {which}")
    return lines


def unmixed_masks(
    person: int, contacts: Sequence[Contact], masks: MaskStores | Mapping[int, MaskStore], people: Sequence[Result]
) -> MaskStore:
    """Return a person's masks of all frames, those that :func:`unmixed` exchanges taken from the other person; the
    stores stay as they are.

    Args:
        person: number of the person.
        contacts: of the run.
        masks: of each person.
        people: as given to :func:`unmixed`.
    """
    mixed = [(c, _exchanged(c, *(people[n] for n in c.people))) for c in contacts if c.outcome == EXCHANGED]
    if not any(person in contact.people for contact, _ in mixed):
        return masks[person]
    result = MaskStore()
    for row, frame in enumerate(people[person].frames.tolist()):
        owner = {n: n for contact, _ in mixed for n in contact.people}
        for contact, exchanged in mixed:
            a, b = contact.people
            if exchanged[row]:
                owner[a], owner[b] = owner[b], owner[a]
        if frame in masks[owner[person]]:
            result.put(frame, masks[owner[person]].get(frame), masks[owner[person]].colors(frame))
    return result


def _with_rows(to: Result, source: Result, rows: NDArray[np.int64]) -> Result:
    """Return a result with some rows of another one."""
    columns: dict[str, Any] = {}
    for name in COLUMNS.values():
        values = getattr(to, name)
        if values is not None:
            columns[name] = values.copy()
            columns[name][rows] = getattr(source, name)[rows]
    for name in {"status", "origin"} & columns.keys():
        columns[name][rows[columns[name][rows] == Status.INITIALISED]] = Status.TRACKED
    return replace(to, **columns)


#: the columns of a result that are exchanged, by dataset
COLUMNS = {
    "pose": "pose", "joints/position": "joints", "joints/sigma": "sigma", "residual": "residual", "status": "status",
    "objective": "objective", "landmarks": "landmarks", "landmark_depth": "landmark_depth", "evidence/reason": "reason",
    "evidence/camera": "camera_state", "evidence/found": "found", "evidence/origin": "origin",
    "evidence/sigma": "deviation", "evidence/modes": "modes",
}  # fmt: skip
