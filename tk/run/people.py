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
from numpy.typing import NDArray

from tk.errors import CaptureError, ConfigError
from tk.kernels.raycast import FAR, Cast
from tk.model.body.skeleton import JOINTS
from tk.model.cues.ray_costs import RayGrid
from tk.model.masks.image_health import masks_stand_still
from tk.model.people import LocatedPerson, PeopleFinder, order_people
from tk.model.setup import Setup, Subject
from tk.run.choice import Choice, chosen, matched, unknown
from tk.run.identity import EXCHANGED, UNCLEAR, Contact, Contacts, outcome_of
from tk.trackers.camera_monitor import CameraMonitor, opening_agreement
from tk.trackers.protocol import Estimate, Observation, SharingTracker, Tracker, sharing
from tk.trackers.sharing import PixelOwners, assign, cast_points

_LOG = logging.getLogger(__name__)
Float = NDArray[np.float64]

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
# Likeness by the colours above which somebody who enters is a person who has left. On pair and a rendered crossing, by
# colours and body: -0.1 to -0.7 for the same person, -1.6 to -3.7 for the other one.
_SAME_COLORS = -1.1

_DRAWN = "drawn"
_WATCH, _LOST, _ABSENT, _PEOPLE, _BYSTANDERS = "watch/", "lost", "absent", "people/", "bystanders/"
_SUBJECT, _IN_INIT_POSE = "subject", "in_init_pose"  # the number of the subject, -1: unknown
_MODEL, _CONTACTS = "body/", "contacts/"


@dataclass
class Member:
    """A person who is tracked.

    Attributes:
        number: number in the result.
        subject: what is known of the person.
        written: whether the person is in the result. Others are tracked because a body explains their pixels better
            than a hull does.
        lost: whether the last frame is lost.
        absent: whether nobody was seen in the last frame who could be this person.
        drawn: (C, h, w) bool, the body in the last frame that is not lost, see :class:`~tk.trackers.protocol.Estimate`.
    """

    number: int
    subject: Subject
    tracker: Tracker
    monitor: CameraMonitor
    written: bool = True
    lost: bool = False
    absent: bool = False
    drawn: NDArray[np.bool_] | None = None


@dataclass(eq=False)  # a hull is an array: bystanders are compared by identity
class Bystander:
    """A person who is not tracked, or not yet.

    Attributes:
        position: (3,) m, centre of the trunk.
        shape: the hull on the grid of the trackers.
        history: the person's own observations of the last frames, if a tracker may be started.
        refused: whether no tracker could be started.
    """

    position: Float
    shape: Cast
    history: list[Observation] = field(default_factory=list)
    refused: bool = False


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
        self._tracked = [self._member(0, setup.subjects[0], first)]
        self._contacts = Contacts()
        self._bystanders: list[Bystander] = []
        self._every = max(1, round(LOOK_EVERY_S * setup.fps))
        self._known_finder: PeopleFinder | None = None
        share = sharing(first)
        self._grid: RayGrid | None = None if share is None else share.choice

    def _member(self, number: int, subject: Subject, tracker: Tracker) -> Member:
        return Member(number, subject, tracker, CameraMonitor(tracker, self._setup, subject))

    @property
    def members(self) -> list[Member]:
        """The people in the result."""
        return [member for member in self._tracked if member.written]

    @property
    def contacts(self) -> list[Contact]:
        """The contacts of the people in the result. With somebody who is not in it, frames cannot be exchanged."""
        numbers, found = {member.number for member in self.members}, []
        for contact in self._contacts.all:
            if numbers.issuperset(contact.people):
                found.append(contact)
            elif not numbers.isdisjoint(contact.people):
                found.append(replace(contact, outcome=UNCLEAR) if contact.outcome == EXCHANGED else contact)
        return found

    @property
    def several(self) -> bool:
        """Whether the result may have several people: each then has rows only for frames in which the person is
        present."""
        return self._choice == "all" or len(self.members) > 1

    @property
    def alone(self) -> bool:
        """Whether nobody but one tracked person has been seen."""
        return len(self._tracked) == 1 and not self._bystanders

    # --- the first frames ---------------------------------------------------------------------------------------------

    def start(self, opening: Sequence[Observation]) -> None:
        """Find the people in the first frame, and start a tracker for each who is chosen.

        Raises:
            CaptureError: a chosen person is not there, too few cameras see the person, or the masks never change.
        """
        if masks_stand_still([f.images for f in opening], [f.masks for f in opening]):
            raise CaptureError("the masks never change, but the images do: the masks do not show who moves")
        subjects = self._setup.subjects
        found = self._find(opening[0].masks, opening[0].uncertain)
        found = order_people(found, self._setup.volume, subjects[0].height_m, subjects[0].position)
        if len(found) <= 1 and self._choice in ("auto", "all", (0,)):
            self._begin(self._tracked[0], opening)
            return
        numbers = chosen(self._choice, found, subjects[0], self._note)
        known = matched(
            subjects[:1] if self._choice == "auto" else subjects, [found[n] for n in numbers], self._setup.up
        )
        self._tracked = [self._member(0, known[0], self._tracked[0].tracker)]
        for k, subject in enumerate(known[1:], 1):
            self._tracked.append(self._member(k, subject, self._make()))  # its kernels are compiled
        if self._grid is None:
            if len(self._tracked) > 1 or len(found) > 1:
                raise ConfigError(
                    f"the method {self._tracked[0].tracker.method} tracks one person who is alone in view"
                )
            self._begin(self._tracked[0], opening)
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
        for member, frames in zip(self._tracked, shares, strict=True):
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

    # --- one frame ----------------------------------------------------------------------------------------------------

    def step(self, frame: Observation) -> dict[int, Tracked]:
        """Return the answers of the members for a frame, by number."""
        if self.alone:
            (member,) = self._tracked
            tracked = self._step(member, frame)
            answers = {member.number: tracked}
            self._look(frame, answers)
            return self._with_absent(answers)
        shown = [*(self._shape(m, True) for m in self._tracked), *(b.shape for b in self._bystanders)]
        owners = self._owners(shown)
        if self._bystanders:
            self._follow(self._bystanders, frame, owners, len(self._tracked))
            owners = self._owners([*shown[: len(self._tracked)], *(b.shape for b in self._bystanders)])
        answers = {}
        before = [self._state_of(m) for m in self._tracked]
        for k, member in enumerate(self._tracked):
            answers[member.number] = self._step(member, owners.share(frame, k, member.lost and not member.absent))
        now = self._owners([*(self._shape(m, False) for m in self._tracked), *(b.shape for b in self._bystanders)])
        for k, member in enumerate(self._tracked):
            if not member.lost and now.changed(owners, frame.masks, k):
                _sharing(member).rewind(before[k])
                self._restore(member, before[k])
                answers[member.number] = self._step(member, now.share(frame, k, False))
        for k, bystander in enumerate(self._bystanders, len(self._tracked)):
            if not bystander.refused:
                bystander.history = [*bystander.history[1 - _HISTORY :], owners.share(frame, k, False)]
        self._judge(frame, answers)
        self._look(frame, answers)
        return self._with_absent(answers)

    def _judge(self, frame: Observation, answers: Mapping[int, Tracked]) -> None:
        """Compare people whose contact has ended with those before it; exchange their trackers if they were mixed
        up."""
        here = [m for m in self._tracked if not m.lost]
        pelvis = {m.number: answers[m.number].estimate.joints[JOINTS.index("pelvis")] for m in here}
        for contact in self._contacts.update(frame.index, pelvis, {m.number: _sharing(m).learned() for m in here}):
            pair = [self._tracked[number] for number in contact.people]
            likeness = np.zeros((2, 2))
            for i, one in enumerate(pair):
                for j, other in enumerate(pair):
                    share, pose = answers[one.number].used, _sharing(one).last_poses()[0]
                    likeness[i, j] = _sharing(other).likeness(share, contact.learned[j], pose)
            contact.outcome = outcome_of(likeness, contact.shorter_m)
            _LOG.debug("contact of %s, frames %d to %d: %s", contact.people, contact.first, contact.last, likeness)
            if contact.outcome == EXCHANGED:
                states = [self._state_of(member) for member in pair]
                for member, state, colors in zip(pair, states[::-1], contact.learned, strict=True):
                    _sharing(member).rewind({**state, **colors})
                    self._restore(member, state)
            contact.learned = ()

    def _with_absent(self, answers: dict[int, Tracked]) -> dict[int, Tracked]:
        """Return the answers of the people in the result, with the status of those who are absent."""
        for number in (m.number for m in self._tracked if m.absent):
            answers[number] = replace(answers[number], estimate=replace(answers[number].estimate, status="absent"))
        return {m.number: answers[m.number] for m in self.members if m.number in answers}

    def _step(self, member: Member, share: Observation) -> Tracked:
        estimate, used = member.monitor.step(share)
        member.lost = estimate.status == "lost"
        if not member.lost:
            member.drawn = estimate.drawn
        return Tracked(estimate, share, used)

    def _shape(self, member: Member, ahead: bool) -> Cast | None:
        return None if member.lost else _sharing(member).rendered(ahead)

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
        for member in self._tracked:
            prefix = f"{_PEOPLE}{member.number}/" if member.number else ""
            state |= {prefix + name: value for name, value in self._state_of(member).items()}
            if not member.written:
                state |= {f"{prefix}{_MODEL}{name}": value for name, value in member.tracker.model().items()}
        for k, b in enumerate(self._bystanders):
            prefix = f"{_BYSTANDERS}{k}/"
            state |= {prefix + "position": b.position, prefix + "depth": b.shape.depth}
        return state | {_CONTACTS + name: value for name, value in self._contacts.state().items()}

    def restore(self, models: Sequence[Mapping[str, Any]], state: Mapping[str, Any]) -> None:
        """Continue a run. Frames of bystanders are not stored, so who has just entered may be tracked later.

        Args:
            models: bodies of the people who are tracked.
            state: of :meth:`state`.
        """
        number = 0
        while own := below(f"{_PEOPLE}{number}/", state) if number else state:
            subject = int(own[_SUBJECT])
            known = self._setup.subjects[subject] if subject >= 0 else Subject(in_init_pose=bool(own[_IN_INIT_POSE]))
            member = self._member(number, known, self._make() if number else self._tracked[0].tracker)
            self._tracked[number:] = [member]
            member.written = number < len(models)
            member.tracker.restore(models[number] if member.written else below(_MODEL, own), own)
            self._restore(member, own)
            number += 1
        self._contacts.restore(below(_CONTACTS, state))
        k = 0
        while found := below(f"{_BYSTANDERS}{k}/", state):
            depth = np.asarray(found["depth"], np.float32)
            shape = Cast((depth < FAR).astype(np.uint8), depth)
            self._bystanders.append(Bystander(np.array(found["position"]), shape))
            k += 1

    def _state_of(self, member: Member) -> dict[str, Any]:
        watch = {_WATCH + name: value for name, value in member.monitor.state().items()}
        drawn = {} if member.drawn is None else {_DRAWN: member.drawn}
        number = next((k for k, known in enumerate(self._setup.subjects) if known is member.subject), -1)
        known = {_SUBJECT: number, _IN_INIT_POSE: member.subject.in_init_pose}
        return {**member.tracker.state(), **watch, **drawn, **known, _LOST: member.lost, _ABSENT: member.absent}

    def _restore(self, member: Member, state: Mapping[str, Any]) -> None:
        member.monitor.restore(below(_WATCH, state))
        member.lost, member.absent = bool(state[_LOST]), bool(state[_ABSENT])
        member.drawn = np.array(state[_DRAWN], np.bool_) if _DRAWN in state else None

    # --- who enters and leaves ----------------------------------------------------------------------------------------

    def _look(self, frame: Observation, answers: dict[int, Tracked]) -> None:
        """Find those who enter, and those who are absent, in the pixels that nobody explains."""
        lost = [m for m in self._tracked if m.lost]
        for member in self._tracked:
            member.absent &= member.lost
        if self._grid is None:
            return
        due = frame.index % self._every == 0 or bool(lost)
        if self.alone:
            residual = answers[self._tracked[0].number].estimate.residual
            known = residual is not None and bool(np.isfinite(residual).any())
            surplus = float(np.nanmean(residual[:, 1])) if residual is not None and known else 0.0
            # at once: it misleads the tracker
            due = (due and bool(lost)) or (surplus > SURPLUS and frame.index % 2 == 0)
        self._admit()
        if not due:
            return
        owners = self._owners([*(self._shape(m, False) for m in self._tracked), *(b.shape for b in self._bystanders)])
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
        areas = [np.count_nonzero(shown & (owners.owner == k), axis=(1, 2)) for k in range(len(self._tracked))]
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
        masks = _sharing(member).screen.sample(frame.masks)
        covered = np.count_nonzero(body, axis=(1, 2))
        return bool((np.count_nonzero(body & (masks < 128), axis=(1, 2)) >= 0.5 * covered).all())

    def _admit(self) -> None:
        """Start trackers for people who have entered, or let the tracker of an absent person find the person again."""
        for bystander in list(self._bystanders):
            if len(bystander.history) < _HISTORY or not self._inside(bystander.position):
                continue
            self._bystanders.remove(bystander)
            shares, bystander.history = bystander.history[::-1], []
            away = [m for m in self._tracked if m.absent and m.written]
            alike = [_sharing(m).likeness(shares[0]) for m in away]
            if alike and max(alike) > _SAME_COLORS:
                member = away[int(np.argmax(alike))]
                member.absent = False  # lost: the pixels that nobody explains are this person's
                continue
            number = len(self._tracked)
            member = self._member(number, unknown(Subject(in_init_pose=False)), self._make())
            member.written = self._choice == "all"
            try:
                self._begin(member, shares)
            except CaptureError as reason:
                _LOG.info("nobody can be tracked there: %s", reason)
                bystander.refused = True
                self._bystanders.append(bystander)
                continue
            self._tracked.append(member)
            if member.written:
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


def below(prefix: str, state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a state whose names begin with a prefix, without it."""
    return {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}


def _sharing(member: Member) -> SharingTracker:
    tracker = sharing(member.tracker)
    assert tracker is not None
    return tracker
