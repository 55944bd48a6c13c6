"""The people of a run: who is in the scene, who is tracked, and which pixels are whose in each frame.

People are found by their visual hulls, in the first frame in which somebody stands in the working volume. Everybody
there gets a tracker, also people who are not written, because a body separates their pixels from those of others
(:mod:`tk.people.share`). Pixels that no body explains show somebody unknown. They are no evidence for the people
who are tracked. A person who enters is found in them. While somebody is awaited whom the user has chosen by number,
everybody keeps a number while away, as if all were written.

A person who is alone in view gets the whole masks.

A person has two numbers. `tk inspect` prints the one, and the user chooses by it: people get it in the order of
:func:`tk.people.find.order_people`, then of entering. :attr:`Person.number` is that in the result.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, ConfigError
from tk.kernels.mask_values import OTHERS, PERSON
from tk.model.body.body_fit import INFORMATIVE_FRAMES
from tk.model.cues.part_colors import RenderedBody
from tk.model.cues.ray_costs import RayGrid
from tk.model.masks.image_health import mask_contradiction, sampled
from tk.model.setup import Setup, Subject
from tk.people.choose import chosen, in_order, matched, unknown_subject
from tk.people.find import LocatedPerson, PeopleFinder
from tk.people.hulls import shares_by_hulls
from tk.people.identity import EXCHANGED, UNCLEAR, Contact, Contacts, judge_contacts, last_outcome
from tk.people.person import Answer, Person, PersonState, no_pose
from tk.people.share import PixelOwners, assign
from tk.settings import Settings
from tk.trackers.camera_monitor import CameraMonitor, spread_over
from tk.trackers.protocol import Frame, Tracker, sharing, without_cameras

_LOG = logging.getLogger(__name__)

# Seconds between two searches for people who enter.
LOOK_EVERY_S = 0.5
# After each refusal of somebody who enters the next attempt is twice as far away, up to this multiple of LOOK_EVERY_S:
# a start takes seconds. The first attempt often fails, because the person is still partly out of view.
_LONGEST_PAUSE = 8
# Least share of the area of a person who is tracked that must be unexplained in two views before a search.
_LEAST_UNEXPLAINED = 0.25
# Likeness by the colours above which somebody who enters is a person who has left.
_SAME_COLORS = -1.1


@dataclass(frozen=True)
class PeopleState:
    """The people who are tracked, the numbers of those who have had a tracker, the contacts, and how many could not be
    tracked since somebody was, and the frame from which on another may be."""

    tracked: list[PersonState]
    given: list[int]
    contacts: list[Contact]
    refused: int = 0
    admit_from: int = 0


class People:
    """Steps the trackers of a run.

    Args:
        setup: the scene.
        settings: all settings.
        choice: who is tracked, see :class:`tk.run.task.TrackOptions`.
        first: the first person's tracker, not started yet; the others get trackers of the same method.
        note: receives messages for the user.
    """

    def __init__(
        self,
        setup: Setup,
        settings: Settings,
        choice: str | tuple[int, ...],
        first: Tracker,
        note: Callable[[str], None],
    ) -> None:
        self._setup, self._settings, self._choice = setup, settings, choice
        self._first, self._note = first, note
        self._tracked: list[Person] = []
        self._contacts = Contacts()
        self._last: dict[int, Answer] = {}  # of the last frame
        self._every = max(1, round(LOOK_EVERY_S * setup.fps))
        self._unknown: deque[Frame] = deque(maxlen=INFORMATIVE_FRAMES)  # people who are unknown, in the last frames
        self._refused = 0  # consecutive people who could not be tracked
        self._admit_from = 0  # the frame from which on another may be
        # numbers, as `tk inspect` prints them, of the people who have had a tracker; None before the first frame
        self._given: set[int] | None = None
        #: why nobody is tracked yet; empty before the first frame
        self.refusal = ""
        self._located: tuple[Frame, tuple[LocatedPerson, ...]] | None = None  # before :meth:`start`
        tracker = sharing(first)
        self._grid: RayGrid | None = None if tracker is None else tracker.fine_grid

    def _person(self, number: int, subject: Subject, written: bool = True) -> Person:
        """Return somebody with the first tracker, whose kernels are compiled, or with another, if somebody has it."""
        tracker = type(self._first).of(self._setup, self._settings) if self._tracked else self._first
        return Person(number, subject, tracker, CameraMonitor(tracker, self._setup, subject), written)

    @property
    def written(self) -> list[Person]:
        """The people in the result."""
        return [person for person in self._tracked if person.written]

    @property
    def contacts(self) -> list[Contact]:
        """The contacts of the people in the result; one that has not ended is judged in the last frame. With somebody
        who is not in the result, frames cannot be exchanged."""
        numbers, found = {person.number for person in self.written}, []
        for contact in self._contacts.all:
            outcome = last_outcome(contact, self._tracked, self._last)
            if outcome == EXCHANGED and not numbers.issuperset(contact.people):
                outcome = UNCLEAR
            if not numbers.isdisjoint(contact.people):
                found.append(replace(contact, outcome=outcome))
        return found

    @property
    def alone(self) -> bool:
        """Whether nobody but the one person in the result has been tracked: all masks are this person's."""
        return len(self._given or ()) == len(self.written) == 1

    @property
    def has_segments(self) -> bool:
        """Whether segments, angles and a smoothed copy follow from the poses."""
        return self._first.has_segments

    @property
    def _awaited(self) -> set[int]:
        """Numbers, as `tk inspect` prints them, of chosen people who have not entered yet."""
        return set(self._choice) - self._given if isinstance(self._choice, tuple) and self._given is not None else set()

    # --- the first frames ---------------------------------------------------------------------------------------------

    def locate(self, frame: Frame) -> tuple[LocatedPerson, ...]:
        """Return the people in a frame. :meth:`start` asks for those in its first frame, and takes them from here."""
        if self._located is None or self._located[0] is not frame:
            self._located = frame, self._finder.find(frame.masks, frame.uncertain, landmarks=frame.landmarks)
        return self._located[1]

    def anticipate(self, frame: Frame) -> None:
        """Locate the people in the first frame of an opening, and search for the pose of one who is alone, before the
        other frames are there."""
        found, one = self.locate(frame), self._choice in ("auto", "all", (0,))
        if one and len(found) == 1 and not self._finder.is_empty(frame.masks, found):
            subject = matched(self._setup.subjects[:1], found, self._setup.up)[0]
            self._first.anticipate(frame, replace(subject, hull_m=found[0].height_m))

    def start(self, opening: Sequence[Frame], given_masks: bool = False) -> bool:
        """Find the people in the first frame, and start a tracker for everybody in the volume.

        Masks that were made from the images belong to them; ``given_masks`` are compared with them.

        Returns:
            False if nobody stands in the volume yet, or if somebody who has just entered cannot be tracked yet; then
            call this method again with the frames from the next one on.

        Raises:
            CaptureError: in the first call, too few cameras see the person, or the masks do not belong to the images.
        """
        frame, subjects = opening[0], self._setup.subjects
        found, self._located = self.locate(frame), None
        if not any(s.init for s in subjects) and self._finder.is_empty(frame.masks, found):
            if not self.refusal:
                _LOG.info("waiting: nobody stands in the working volume in frame %d", frame.index)
            if found or not self.refusal:
                at = f", but somebody stands outside it, at {found[0].where}" if found else ""
                self.refusal = (
                    f"the working volume is empty{at}; check the masks, [volume] in capture.toml, and the unit and the "
                    "image size of calibration.toml"
                )
            self._refused = 0
            return False
        if frame.index < self._admit_from:
            return False
        entered = bool(self.refusal)
        if entered:
            self._begin_in_any_pose()
        _LOG.info("finding the person in frame %d and fitting the body to %d frames", frame.index, len(opening))
        found = in_order(self._finder, self._setup, opening, found)
        numbers = chosen(self._choice, found, subjects[0], self._note)
        if self._grid is None and (len(found) > 1 or self._choice not in ("auto", "all", (0,))):
            raise ConfigError(f"the method {self._first.method} tracks one person who is alone in view")
        try:
            compared = spread_over(opening) if given_masks else ()
            if reason := mask_contradiction(
                pairwise(sampled(f.images, f.masks, self._setup.rig.sizes) for f in compared)
            ):
                raise CaptureError(reason)
            self._start(opening, found, numbers)
        except CaptureError as error:
            if not entered:
                raise
            self._refuse(frame.index, error)
            self._tracked, self._given = [], None
            return False
        if entered:
            self._note(f"frame {frame.index}: the first person has entered")
        for number in sorted(self._awaited):
            self._note(f"person {number} is not in the working volume in frame {frame.index}, and is awaited")
            self.refusal = f"{_not_entered(number)}; tk inspect prints the numbers, from 0"
        return True

    def _begin_in_any_pose(self, number: int | None = None) -> None:
        """Take the pose in which a subject, or each, begins for unknown, because it is not that of the first frame."""
        subjects = [
            replace(s, in_init_pose=False, init=None) if number in (None, k) else s
            for k, s in enumerate(self._setup.subjects)
        ]
        self._setup = replace(self._setup, subjects=tuple(subjects))

    def _start(self, opening: Sequence[Frame], found: Sequence[LocatedPerson], numbers: Sequence[int]) -> None:
        """Start the trackers of the people found in the first frame. ``numbers``: of those chosen. A person who is
        alone has the whole masks; if that fails, others may have entered in the opening."""
        alone = len(found) <= 1 and 0 in numbers
        try:
            self._start_each(opening, found, numbers, [opening] if alone else None)
        except CaptureError:
            if not alone or self._grid is None or not found or not self._several_in(opening):
                raise
            self._start_each(opening, found, numbers, None)

    def _start_each(
        self,
        opening: Sequence[Frame],
        found: Sequence[LocatedPerson],
        numbers: Sequence[int],
        shares: Sequence[Sequence[Frame]] | None,
    ) -> None:
        """Start a tracker for each person, with the person's share of the opening; None: by the hulls."""
        subjects, self._tracked = self._setup.subjects, []
        people = [found[n] for n in numbers] if found else []
        known = matched(subjects[:1] if self._choice == "auto" else subjects, people, self._setup.up) or subjects[:1]
        rest = [n for n, other in enumerate(found) if n not in numbers and other.views.sum() >= 2]
        shares = shares or self._shares([*people, *(found[n] for n in rest)], opening)
        for k, frames in enumerate(shares[: len(numbers)]):
            person = self._person(len(self._tracked), known[k])
            try:
                person.begin(frames, people[k].height_m if people else None, opening)
            except CaptureError as error:
                if self._choice != "all" or not (self._tracked or people[k + 1 :]):
                    raise
                self._note(f"the person at {people[k].where} cannot be tracked: {error}")
            else:
                self._tracked.append(person)
        self._given = set(numbers)
        for n, frames in zip(rest, shares[len(people) :], strict=False):
            if found[n].inside and self._admit(frames, found[n], unknown_subject(subjects[0]), written=False):
                self._given.add(n)

    @cached_property
    def _finder(self) -> PeopleFinder:
        return PeopleFinder(self._setup.rig, self._setup.volume, self._setup.up)

    def _several_in(self, opening: Sequence[Frame]) -> bool:
        """Return whether several people are found in some frame of the opening."""
        found = (self._finder.find(f.masks, f.uncertain, landmarks=f.landmarks) for f in spread_over(opening))
        return any(len(people) > 1 for people in found)

    def _shares(self, people: Sequence[LocatedPerson], frames: Sequence[Frame]) -> list[list[Frame]]:
        """Return the observations of each person in consecutive frames, from the hulls in the first one."""
        assert self._grid is not None
        return shares_by_hulls(self._finder, self._grid, people, frames, self._sighted)

    def _sighted(self, frame: Frame) -> list[RenderedBody]:
        """Return the bodies that the landmarks in a frame show."""
        tracker = sharing(self._first)
        if tracker is None or frame.landmarks is None:
            return []
        return [body for landmarks in frame.landmarks if (body := tracker.sighted(landmarks)) is not None]

    # --- one frame ----------------------------------------------------------------------------------------------------

    def step(self, frame: Frame) -> dict[int, Answer]:
        """Step everybody's tracker with the person's share of a frame, then find who enters and leaves; return the
        answers of the people in the result, by number.

        Before anybody is tracked, person 0 is absent, or lost if the first person in the volume could not be tracked.
        """
        if not self._tracked and not self._awaited:
            return self._nobody(frame, lost=self._refused > 0)
        alone = len(self._tracked) == 1 and not self._tracked[0].shows_others(frame.masks, self._setup.rig)
        owners = None if alone else self._owners(frame, ahead=True)
        answers = {}
        for k, person in enumerate(self._tracked):
            share = frame if owners is None else owners.share(frame, k, person.lost and not person.absent)
            answers[person.number] = person.step(share)
        fit = self._without_unfit(frame)
        if owners is None:
            self._unknown.clear()
        else:
            without = np.empty((len(frame.masks), 0, 0, 3), np.uint8)  # images are views into the ring of frames
            self._unknown.append(replace(owners.unknown(fit), images=without))
        judge_contacts(self._contacts, self._tracked, answers)
        self._last = dict(answers)
        answers |= self._look(fit, owners)
        for person in self._tracked:
            if person.absent:
                answers[person.number] = answers[person.number].without_pose(person.tracker)
        return {person.number: answers[person.number] for person in self.written} or self._nobody(frame)

    def _without_unfit(self, frame: Frame) -> Frame:
        """Return a frame without the cameras whose images are wrong: what a moved camera shows beside people who are
        tracked is no evidence of somebody else."""
        unfit = np.zeros(len(frame.masks), np.bool_)
        for person in self._tracked:
            unfit |= person.monitor.unfit
        return without_cameras(frame, unfit)

    def _owners(self, frame: Frame, ahead: bool = False) -> PixelOwners:
        """Return the owners of a frame's pixels, in the order of the people who are tracked, by their bodies.

        ``ahead``: the trackers have not seen the frame yet, so the bodies are at the poses expected in it.
        """
        assert self._grid is not None
        bodies: list[RenderedBody | None] = [None if p.lost else p.sharing.rendered(ahead) for p in self._tracked]
        return assign(self._setup.rig, self._grid, bodies, frame)

    # --- who enters and leaves ----------------------------------------------------------------------------------------

    def _look(self, frame: Frame, owners: PixelOwners | None) -> dict[int, Answer]:
        """Find people who enter or leave, and return the answers of those who enter.

        ``owners``: of the frame's pixels; None if the only person got all.
        """
        lost, due = [p for p in self._tracked if p.lost], frame.index % self._every == 0
        for person in self._tracked:
            person.absent &= person.lost
        if self._grid is None or not (lost or (due and owners is not None)):
            return {}
        owners = owners or self._owners(frame)
        newcomers, numbered = self._newcomers(frame, owners), self._choice == "all" or bool(self._awaited)
        for person in lost:
            if not newcomers and person.has_left(frame.masks):
                person.absent = True
            elif newcomers and not numbered:
                person.absent = False  # no newcomer is written: who appears may be this person, and the tracker looks
        if due and not numbered:  # who is not written, and lost, comes back as a newcomer
            self._tracked = [p for p in self._tracked if p.written or not p.lost]
            for person in lost:
                if not person.written:
                    self._contacts.leave(person.number)
        searching = any(p.lost and not p.absent for p in self._tracked)
        if searching or len(self._unknown) < INFORMATIVE_FRAMES or frame.index < self._admit_from:
            return {}
        answers: dict[int, Answer] = {}
        for newcomer in newcomers:
            answers |= self._enter(frame, newcomer)
        return answers

    def _enter(self, frame: Frame, newcomer: LocatedPerson) -> dict[int, Answer]:
        """Recognise somebody who is absent, or track somebody new; return the new person's answer by number."""
        share = self._shares([newcomer], list(self._unknown)[::-1])[0]
        away = [p for p in self._tracked if p.absent]
        alike = [p.sharing.likeness(replace(share[0], images=frame.images)) for p in away]
        if alike and max(alike) > _SAME_COLORS:
            away[int(np.argmax(alike))].absent = False  # the tracker finds this person in the unknown pixels
            return {}
        assert self._given is not None
        number = next(n for n in range(len(self._given) + 1) if n not in self._given)
        written = self._choice == "all" or number in self._awaited
        subject = self._subject_of(newcomer) if written else Subject(in_init_pose=False)
        person = self._admit(share, newcomer, subject, written)
        if person is None:
            return {}
        self._given.add(number)
        who = f"person {number} has entered" if written else f"another person is in view, at {newcomer.where}"
        answer = person.step(replace(share[0], images=frame.images))
        self._note(f"frame {frame.index}: {who}")
        return {person.number: answer}

    def _subject_of(self, person: LocatedPerson) -> Subject:
        """Return the subject of somebody who enters: the one who fits best of those that nobody has."""
        subjects = self._setup.subjects
        free = [s for s in subjects if all(s is not other.subject for other in self._tracked)]
        if not free:
            return Subject(in_init_pose=False)
        (fits,) = matched(free, [person], self._setup.up)
        number = next(k for k, s in enumerate(subjects) if s is fits)
        self._begin_in_any_pose(number)
        return self._setup.subjects[number]

    def _newcomers(self, frame: Frame, owners: PixelOwners) -> list[LocatedPerson]:
        """Return the people in the working volume whom the pixels show that no body explains."""
        *areas, unexplained = owners.areas(frame.masks)
        person = max((float(np.median(area)) for area in areas), default=0.0)
        if np.count_nonzero(unexplained > _LEAST_UNEXPLAINED * person) < 2:
            return []
        masks = owners.unknown(frame).masks
        return [p for p in self._finder.find(masks >= PERSON, hidden=masks == OTHERS) if p.inside]

    def _admit(self, frames: Sequence[Frame], found: LocatedPerson, subject: Subject, written: bool) -> Person | None:
        """Add a person who is tracked from the first of some frames on; None if nobody can be tracked."""
        # people who are not written have higher numbers than all who are, now and later
        higher = len(self._choice) if isinstance(self._choice, tuple) else 1
        number = len(self.written) if written else max([higher, *(1 + p.number for p in self._tracked)])
        person = self._person(number, subject, written)
        try:
            person.begin(frames, found.height_m)
        except CaptureError as reason:
            self._refuse(frames[0].index, reason)
            return None
        self._refused = 0
        self._tracked.append(person)
        return person

    def _refuse(self, frame: int, reason: CaptureError) -> None:
        """Put off the next attempt to track somebody, because the one in this frame has failed."""
        _LOG.info("nobody can be tracked there: %s", reason)
        self.refusal = str(reason)
        self._refused += 1
        self._admit_from = frame + self._every * min(2 ** (self._refused - 1), _LONGEST_PAUSE)

    def _nobody(self, frame: Frame, lost: bool = False) -> dict[int, Answer]:
        """Return the answers in a frame before anybody in the result is tracked; ``lost``: somebody is there."""
        return {0: Answer(no_pose(self._first, len(self._setup.rig), lost), frame, frame)}

    # --- what a result keeps ------------------------------------------------------------------------------------------

    @property
    def doubted(self) -> NDArray[np.bool_]:
        """(C,) cameras, see :attr:`CameraMonitor.doubted`."""
        return np.any([person.monitor.doubted for person in self.written], axis=0)

    def report(self) -> list[str]:
        """Return lines on excluded cameras and losses, see :meth:`CameraMonitor.report`, and on who did not come."""
        missing = [_not_entered(number) for number in sorted(self._awaited)]
        if len(self.written) == 1:
            return [*self.written[0].monitor.report(), *missing]
        return [*(f"person {p.number}: {line}" for p in self.written for line in p.monitor.report()), *missing]

    def state(self) -> PeopleState:
        """Return what :meth:`resume` needs."""
        subjects = self._setup.subjects
        tracked = [
            PersonState(
                number=person.number,
                subject=next((k for k, known in enumerate(subjects) if known is person.subject), None),
                in_init_pose=person.subject.in_init_pose,
                body=None if person.written else dict(person.tracker.model()),
                member=person.state,
            )
            for person in self._tracked
        ]
        return PeopleState(tracked, sorted(self._given or ()), self._contacts.all, self._refused, self._admit_from)

    def resume(self, models: Sequence[Mapping[str, Any]], state: PeopleState) -> None:
        """Continue a run. Earlier frames are not stored, so a person who has just entered is tracked some frames
        later.

        Args:
            models: bodies of the people in the result.
            state: of :meth:`state`.
        """
        self._tracked = []
        for stored in state.tracked:
            k, subjects = stored.subject, self._setup.subjects
            if k is not None and subjects[k].in_init_pose and not stored.in_init_pose:
                self._begin_in_any_pose(k)
            known = Subject(in_init_pose=stored.in_init_pose) if k is None else self._setup.subjects[k]
            person = self._person(stored.number, known, written=stored.body is None)
            person.tracker.take_model(models[stored.number] if stored.body is None else stored.body)
            person.state = stored.member
            self._tracked.append(person)
        self._given, self._contacts.all = set(state.given), state.contacts
        self._refused, self._admit_from = state.refused, state.admit_from


def _not_entered(number: int) -> str:
    return f"person {number} did not enter the working volume"
