"""The people of a run: who is in the scene, who is tracked, and which pixels are whose in each frame.

People are found in the first frame by their visual hulls. Those who are chosen get a tracker each. The others are
followed by their hulls, so that their pixels are no evidence for those who are tracked. A person who enters later is
found in the pixels that nobody explains.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.errors import CaptureError, ConfigError
from tk.kernels.raycast import FAR, Cast
from tk.model.cues.part_colors import color_bins
from tk.model.cues.ray_costs import RayGrid
from tk.model.people import LocatedPerson, PeopleFinder, order_people
from tk.model.setup import Setup, Subject
from tk.trackers.camera_monitor import CameraMonitor, opening_agreement
from tk.trackers.protocol import Estimate, Observation, Tracker, sharing
from tk.trackers.sharing import PixelOwners, assign, cast_points

_LOG = logging.getLogger(__name__)
Float = NDArray[np.float64]
Choice = str | tuple[int, ...]
"""Who is tracked: "auto" (one person), "all", or numbers."""

# Seconds between two looks for people who enter.
LOOK_EVERY_S = 0.5
# Mean surplus area of the subject's masks, as a share of the person, above which somebody else may have entered: a
# second person adds 1 in every camera, if not hidden. No frame of the development captures has more than 0.11.
SURPLUS = 0.25
# Somebody who is seen so far from a person who is tracked is somebody else, metres: half a stride, and a hull's error.
_SAME_M = 0.6
# Voxels of somebody who is not tracked, at least: 5 litres, a head's volume.
_LEAST_VOXELS = 25
# Frames of somebody who enters from which the body is fitted: half a second at 15 Hz.
_HISTORY = 8
# Least share of the area of a person who is tracked that must be unexplained in two views before a search.
_UNEXPLAINED = 0.25
# Mean logarithm of the likelihood of a person's pixels by the colours of the segments, above which somebody who enters
# is a person who has left. On pair and a rendered crossing, three frames each: -3.5 to -4.2 by the own colours, -4.8 to
# -7.1 by the other person's.
_SAME_COLORS = -4.5


_DRAWN = "drawn"
_WATCH, _LOST, _ABSENT, _PEOPLE, _BYSTANDERS = "watch/", "lost", "absent", "people/", "bystanders/"


@dataclass
class Member:
    """A person who is tracked.

    Attributes:
        number: number in the result.
        subject: what is known of the person.
        lost: whether the last frame is lost.
        absent: whether nobody was seen in the last frame who could be this person.
        drawn: (C, h, w) bool, the body in the last frame that is not lost, see :class:`~tk.trackers.protocol.Estimate`.
    """

    number: int
    subject: Subject
    tracker: Tracker
    monitor: CameraMonitor
    lost: bool = False
    absent: bool = False
    drawn: NDArray[np.bool_] | None = None


@dataclass
class Bystander:
    """A person who is not tracked, or not yet.

    Attributes:
        position: (3,) m, centre of the trunk.
        shape: the hull on the grid of the trackers.
        history: the person's own observations of the last frames, if a tracker may be started.
    """

    position: Float
    shape: Cast
    history: list[Observation] = field(default_factory=list)


@dataclass(frozen=True)
class Tracked:
    """A member's answer for a frame: the estimate, the member's share of the frame, and what its tracker used."""

    estimate: Estimate
    share: Observation
    used: Observation


class People:
    """Steps the trackers of a run.

    Args:
        setup: the scene.
        first: a tracker.
        make: makes another tracker.
        choice: who is tracked.
        note: receives messages for the user.
    """

    def __init__(
        self, setup: Setup, first: Tracker, make: Callable[[], Tracker], choice: Choice, note: Callable[[str], None]
    ) -> None:
        self._setup, self._make, self._choice, self._note = setup, make, choice, note
        self.members = [self._member(0, setup.subjects[0], first)]
        self._bystanders: list[Bystander] = []
        self._every = max(1, round(LOOK_EVERY_S * setup.fps))
        self._known_finder: PeopleFinder | None = None
        share = sharing(first)
        self._grid: RayGrid | None = None if share is None else share.choice

    def _member(self, number: int, subject: Subject, tracker: Tracker) -> Member:
        return Member(number, subject, tracker, CameraMonitor(tracker, self._setup, subject))

    @property
    def several(self) -> bool:
        """Whether the result may have several people: each then has rows only for frames in which the person is
        present."""
        return self._choice == "all" or len(self.members) > 1

    @property
    def alone(self) -> bool:
        """Whether nobody but one tracked person has been seen."""
        return len(self.members) == 1 and not self._bystanders

    # --- the first frames ---------------------------------------------------------------------------------------------

    def start(self, opening: Sequence[Observation]) -> None:
        """Find the people in the first frame, and start a tracker for each who is chosen.

        Raises:
            CaptureError: a chosen person is not there, or too few cameras see the person.
        """
        subject = self._setup.subjects[0]
        found = self._find(opening[0].masks, opening[0].uncertain)
        found = order_people(found, self._setup.volume, subject.height_m, subject.position)
        if len(found) <= 1 and self._choice in ("auto", "all", (0,)):
            try:
                self._begin(self.members[0], opening)
            except CaptureError as refusal:
                # somebody may pass close to a camera, where no hull shows him or her: the person's own pixels may do
                if not found or self._grid is None:
                    raise
                try:
                    self._begin_among(found, opening)
                except CaptureError:
                    raise refusal from None
            return
        self._begin_among(found, opening)

    def _begin_among(self, found: Sequence[LocatedPerson], opening: Sequence[Observation]) -> None:
        """Start the trackers of those who are chosen among the people found in the first frame."""
        subjects = self._setup.subjects
        numbers = self._chosen(found)
        known = _matched(subjects[:1] if self._choice == "auto" else subjects, [found[n] for n in numbers])
        self.members = [self._member(0, known[0], self.members[0].tracker)]
        for k, subject in enumerate(known[1:], 1):
            self.members.append(self._member(k, subject, self._make()))  # its kernels are compiled
        if self._grid is None:
            if len(self.members) > 1 or len(found) > 1:
                raise ConfigError(f"the method {self.members[0].tracker.method} tracks one person who is alone in view")
            self._begin(self.members[0], opening)
            return
        order = [*numbers, *(n for n in range(len(found)) if n not in numbers)]
        shown = [Bystander(found[n].position, self._hull(found[n])) for n in order]
        shares: list[list[Observation]] = [[] for _ in numbers]
        for frame in opening:
            owners = self._owners([b.shape for b in shown])
            if frame is not opening[0]:
                self._follow(shown, frame, owners)
                owners = self._owners([b.shape for b in shown])
            for k, own in enumerate(shares):
                own.append(owners.share(frame, k, False))
        refusal = opening_agreement(self._setup, opening).refusal
        for member, frames in zip(self.members, shares, strict=True):
            self._begin(member, frames, refusal)
        first = [Bystander(found[n].position, self._hull(found[n])) for n in order]
        self._bystanders = first[len(numbers) :]

    def _begin(self, member: Member, frames: Sequence[Observation], refusal: str | None = None) -> None:
        """Start a tracker. ``refusal``: why the whole masks contradict each other, which counts if those of the person
        alone cannot be compared: cameras that do not belong together show several people where one is."""
        subject = member.subject
        seen = member.monitor.start(frames)
        if refusal and not member.monitor.tested:
            raise CaptureError(refusal)
        member.tracker.start(seen, subject.height_m, subject.init, subject.body)
        member.monitor.check_body()

    def _find(self, masks: NDArray[np.uint8], uncertain: NDArray[np.bool_] | None = None) -> tuple[LocatedPerson, ...]:
        return self._finder.find(masks, uncertain)

    @property
    def _finder(self) -> PeopleFinder:
        if self._known_finder is None:
            self._known_finder = PeopleFinder(self._setup.rig, self._setup.volume, self._setup.up)
        return self._known_finder

    def _chosen(self, found: Sequence[LocatedPerson]) -> tuple[int, ...]:
        """Return the numbers of the people to be tracked."""
        present = [n for n, person in enumerate(found) if person.inside]
        if isinstance(self._choice, tuple):
            missing = [n for n in self._choice if n >= len(found)]
            if missing:
                raise CaptureError(
                    f"person {missing[0]} is asked for, but {len(found)} were found in the first frame; the numbers "
                    "start at 0, see tk inspect"
                )
            return self._choice
        if self._choice == "all":
            return tuple(present) or (0,)
        number = 0
        place = _position(self._setup.subjects[0])
        if place is not None and found:
            number = int(np.argmin([np.linalg.norm(person.position - place) for person in found]))
        if len(found) > 1:
            x, y, z = found[number].position
            self._note(
                f"{len(found)} people are in view, and number {number} is tracked, at ({x:.1f}, {y:.1f}, {z:.1f}) m; "
                "the option people chooses others by the numbers that tk inspect prints, or all"
            )
        return (number,)

    # --- one frame ----------------------------------------------------------------------------------------------------

    def step(self, frame: Observation) -> dict[int, Tracked]:
        """Return the answers of the members for a frame, by number."""
        if self.alone:
            (member,) = self.members
            tracked = self._step(member, frame)
            answers = {member.number: tracked}
            self._look(frame, answers)
            return self._with_absent(answers)
        before = [self._state_of(m) for m in self.members]
        shown = [*(self._shape(m, True) for m in self.members), *(b.shape for b in self._bystanders)]
        owners = self._owners(shown)
        if self._bystanders:
            self._follow(self._bystanders, frame, owners, len(self.members))
            owners = self._owners([*shown[: len(self.members)], *(b.shape for b in self._bystanders)])
        answers = {}
        for k, member in enumerate(self.members):
            answers[member.number] = self._step(member, owners.share(frame, k, member.lost and not member.absent))
        now = self._owners([*(self._shape(m, False) for m in self.members), *(b.shape for b in self._bystanders)])
        for k, member in enumerate(self.members):
            if not member.lost and now.changed(owners, frame.masks, k):
                tracker = sharing(member.tracker)
                assert tracker is not None
                tracker.rewind(before[k])
                self._restore(member, before[k])
                answers[member.number] = self._step(member, now.share(frame, k, False))
        if self._choice == "all":
            for k, bystander in enumerate(self._bystanders, len(self.members)):
                bystander.history = [*bystander.history[1 - _HISTORY :], now.share(frame, k, False)]
        self._look(frame, answers, now)
        return self._with_absent(answers)

    def _with_absent(self, answers: dict[int, Tracked]) -> dict[int, Tracked]:
        """Return the answers, with the status of those who are absent."""
        for number in (m.number for m in self.members if m.absent):
            answers[number] = replace(answers[number], estimate=replace(answers[number].estimate, status="absent"))
        return answers

    def _step(self, member: Member, share: Observation) -> Tracked:
        estimate, used = member.monitor.step(share)
        member.lost = estimate.status == "lost"
        if not member.lost:
            member.drawn = estimate.drawn
        return Tracked(estimate, share, used)

    def _shape(self, member: Member, ahead: bool) -> Cast | None:
        tracker = sharing(member.tracker)
        assert tracker is not None
        return None if member.lost else tracker.rendered(ahead)

    def _hull(self, person: LocatedPerson) -> Cast:
        assert self._grid is not None
        return cast_points(self._setup.rig, self._grid, person.points, person.voxel_m)

    def _owners(self, shapes: Sequence[Cast | None]) -> PixelOwners:
        assert self._grid is not None
        return assign(self._setup.rig, self._grid, shapes)

    def _follow(self, bystanders: Sequence[Bystander], frame: Observation, owners: PixelOwners, first: int = 0) -> None:
        """Carve the hulls of people who are not tracked again; ``first``: number of the first in the owners."""
        assert self._grid is not None
        for k, bystander in enumerate(bystanders, first):
            free = owners.share(frame, k, True).masks
            points, position = self._finder.around(bystander.position, free)
            if len(points) >= _LEAST_VOXELS:
                bystander.position = position
                bystander.shape = cast_points(self._setup.rig, self._grid, points, self._finder.voxel_m)

    # --- what a result keeps ------------------------------------------------------------------------------------------

    def report(self) -> list[str]:
        """Return lines on excluded cameras and losses, see :meth:`CameraMonitor.report`."""
        if len(self.members) == 1:
            return self.members[0].monitor.report()
        return [f"person {m.number}: {line}" for m in self.members for line in m.monitor.report()]

    def state(self) -> dict[str, Any]:
        """Return what :meth:`restore` needs beside the bodies. Person 0's entries have no prefix."""
        state: dict[str, Any] = {}
        for member in self.members:
            prefix = f"{_PEOPLE}{member.number}/" if member.number else ""
            state |= {prefix + name: value for name, value in self._state_of(member).items()}
        for k, b in enumerate(self._bystanders):
            prefix = f"{_BYSTANDERS}{k}/"
            state |= {prefix + "position": b.position, prefix + "depth": b.shape.depth}
        return state

    def restore(self, models: Sequence[Mapping[str, Any]], state: Mapping[str, Any]) -> None:
        """Continue a run.

        Args:
            models: bodies of the people who are tracked.
            state: of :meth:`state`.
        """
        subjects = self._setup.subjects
        for number, model in enumerate(models):
            own = below(f"{_PEOPLE}{number}/", state) if number else state
            if number:
                known = subjects[number] if number < len(subjects) else _unknown(subjects[0])
                self.members.append(self._member(number, known, self._make()))
            member = self.members[number]
            member.tracker.restore(model, own)
            self._restore(member, own)
        k = 0
        while found := below(f"{_BYSTANDERS}{k}/", state):
            depth = np.asarray(found["depth"], np.float32)
            shape = Cast((depth < FAR).astype(np.uint8), depth)
            self._bystanders.append(Bystander(np.array(found["position"]), shape))
            k += 1

    def _state_of(self, member: Member) -> dict[str, Any]:
        watch = {_WATCH + name: value for name, value in member.monitor.state().items()}
        drawn = {} if member.drawn is None else {_DRAWN: member.drawn}
        return {**member.tracker.state(), **watch, **drawn, _LOST: member.lost, _ABSENT: member.absent}

    def _restore(self, member: Member, state: Mapping[str, Any]) -> None:
        member.monitor.restore(below(_WATCH, state))
        member.lost, member.absent = bool(state[_LOST]), bool(state[_ABSENT])
        member.drawn = np.array(state[_DRAWN], np.bool_) if _DRAWN in state else None

    # --- who enters and leaves ----------------------------------------------------------------------------------------

    def _look(self, frame: Observation, answers: dict[int, Tracked], owners: PixelOwners | None = None) -> None:
        """Find those who enter, and those who are absent, in the pixels that nobody explains."""
        lost = [m for m in self.members if m.lost]
        for member in self.members:
            member.absent &= member.lost
        if self._grid is None:
            return
        self._admit()
        due = frame.index % self._every == 0 or bool(lost)
        if owners is None:
            residual = answers[self.members[0].number].estimate.residual
            known = residual is not None and bool(np.isfinite(residual).any())
            surplus = float(np.nanmean(residual[:, 1])) if residual is not None and known else 0.0
            due = (due and bool(lost)) or (
                surplus > SURPLUS and frame.index % 2 == 0
            )  # at once: it misleads the tracker
            if not due:
                return
            owners = self._owners([self._shape(m, False) for m in self.members])
        if not due:
            return
        free = owners.unexplained(frame.masks)
        found = [p for p in self._find(free) if p.inside] if self._much(free, owners, frame) else []
        for member in lost:
            if not found and self._gone(member, frame):
                member.absent = True
            elif found and self._choice != "all":
                member.absent = False  # no newcomer is tracked: who appears may be this person, and the tracker looks
        if any(not m.absent for m in lost):
            return  # the tracker looks for the person
        places = [b.position for b in self._bystanders]
        for person in found:
            if all(np.linalg.norm(person.position - other) > _SAME_M for other in places):
                places.append(person.position)
                self._bystanders.append(Bystander(person.position, self._hull(person)))
                x, y, z = person.position
                self._note(f"frame {frame.index}: another person is in view, at ({x:.1f}, {y:.1f}, {z:.1f}) m")
        self._bystanders = [b for b in self._bystanders if self._seen(b, frame)]

    def _much(self, free: NDArray[np.uint8], owners: PixelOwners, frame: Observation) -> bool:
        """Return whether the pixels that nobody explains may be a person's."""
        shown = owners.grid.sample(frame.masks) >= 128
        areas = [np.count_nonzero(shown & (owners.owner == k), axis=(1, 2)) for k in range(len(self.members))]
        person = max(float(np.median(area)) for area in areas)
        left = np.count_nonzero(owners.grid.sample(free), axis=(1, 2))
        return bool(np.count_nonzero(left > _UNEXPLAINED * person) >= 2)

    def _gone(self, member: Member, frame: Observation) -> bool:
        """Return whether a lost person has left the last place: in every view most of the body would be on background.

        One view that still shows the person says that the others' masks fail.
        """
        body = member.drawn
        if body is None:
            return False
        step = frame.masks.shape[1] // body.shape[1]
        masks = frame.masks[:, step // 2 :: step, step // 2 :: step][:, : body.shape[1], : body.shape[2]]
        covered = np.count_nonzero(body, axis=(1, 2))
        return bool((np.count_nonzero(body & (masks < 128), axis=(1, 2)) >= 0.5 * covered).all())

    def _admit(self) -> None:
        """Start trackers for people who have entered, or let the tracker of an absent person find the person again."""
        for bystander in list(self._bystanders):
            if len(bystander.history) < _HISTORY or not self._inside(bystander.position):
                continue
            self._bystanders.remove(bystander)
            shares, bystander.history = bystander.history[::-1], []
            away = [m for m in self.members if m.absent]
            alike = [_likelihood(m.tracker, shares[0]) for m in away]
            if alike and max(alike) > _SAME_COLORS:
                member = away[int(np.argmax(alike))]
                member.absent = False  # lost: the pixels that nobody explains are this person's
                continue
            number = len(self.members)
            member = self._member(number, _unknown(Subject(in_init_pose=False)), self._make())
            try:
                self._begin(member, shares)
            except CaptureError as reason:
                _LOG.info("nobody can be tracked there: %s", reason)
                self._bystanders.append(bystander)
                continue
            self.members.append(member)
            self._note(f"frame {shares[0].index}: person {number} has entered")

    def _inside(self, position: Float) -> bool:
        volume = self._setup.volume
        return bool(((volume.lower <= position) & (position <= volume.upper)).all())

    def _seen(self, bystander: Bystander, frame: Observation) -> bool:
        """Return whether a person who is not tracked is still in view."""
        covered = bystander.shape.label > 0
        assert self._grid is not None
        shown = covered & (self._grid.sample(frame.masks) >= 128)
        return bool(np.count_nonzero(shown) > 0.3 * np.count_nonzero(covered))


def parse_choice(text: str) -> Choice:
    """Return the choice that a user gives as "auto", "all" or numbers, such as "0,2".

    Raises:
        ConfigError: it is none of these.
    """
    if text in ("auto", "all"):
        return text
    numbers = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in numbers) or len(set(numbers)) < len(numbers):
        raise ConfigError(f"people {text!r}: give auto, all, or different numbers from 0 on, such as 0,2")
    return tuple(map(int, numbers))


def describe(choice: Choice) -> str:
    """Return a choice as the user gives it."""
    return choice if isinstance(choice, str) else ",".join(map(str, choice))


def below(prefix: str, state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a state whose names begin with a prefix, without it."""
    return {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}


def _likelihood(tracker: Tracker, share: Observation) -> float:
    """Return the mean logarithm of the likelihood of a person's pixels by the colours of a tracker's segments."""
    colors = getattr(tracker, "colors", None)
    if colors is None or colors.log_likelihood is None or not share.images.size:
        return 0.0  # nothing contradicts it
    bins = color_bins(share.images[share.masks >= 128])
    return float(colors.log_likelihood.max(axis=0)[bins].mean()) if len(bins) else -np.inf


def _position(subject: Subject) -> Float | None:
    return subject.init.center if subject.init is not None else subject.position


def _unknown(first: Subject) -> Subject:
    """Return a subject of whom nothing is known but how the recording begins."""
    return Subject(in_init_pose=first.in_init_pose)


def _matched(subjects: Sequence[Subject], people: Sequence[LocatedPerson]) -> list[Subject]:
    """Return the subject of each of the people: by position, else by height; nothing is known of the others."""
    cost = np.zeros((len(people), len(subjects)))
    for p, person in enumerate(people):
        for s, subject in enumerate(subjects):
            place = _position(subject)
            if place is not None:
                cost[p, s] += float(np.linalg.norm(person.position[:2] - place[:2]))
            if subject.height_m is not None:
                cost[p, s] += abs(person.height_m - subject.height_m)
            cost[p, s] += 1e-6 * abs(p - s)
    who = dict(zip(*scipy.optimize.linear_sum_assignment(cost), strict=True))
    return [subjects[who[p]] if p in who else _unknown(subjects[0]) for p in range(len(people))]
