"""Who is in a capture: people by number, with their paths on the floor, for `tk inspect`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.io.captures.capture import Capture
from tk.model.cues.ray_costs import RayGrid
from tk.people.choose import in_order
from tk.people.find import LocatedPerson, PeopleFinder
from tk.people.hulls import owners_by_hulls
from tk.run.segmentation import Labels
from tk.trackers.contour_finder import FINE_ROWS
from tk.trackers.protocol import Frame

Float = NDArray[np.float64]

#: looks for people a second. In that time a walker (1.5 m/s) goes less far than people who meet are apart.
_LOOKS_HZ = 5.0
#: looks at most; each takes 0.1 to 0.3 s
_MOST_LOOKS = 60
#: a person may be so far from where he or she was in the last look: a sprint, and an error of the hull
_FASTEST_M_S, _ERROR_M = 3.0, 0.3
#: seconds for which a person may be hidden and keep the number
_HIDDEN_S = 2.0
#: seconds that somebody must be seen to be reported, if the capture is longer
_SEEN_S = 0.5


@dataclass(frozen=True)
class PersonReport:
    """One person over the sampled frames.

    Attributes:
        number: the number that `tk track --people` takes.
        frames: (K,) frames in which the person was found.
        path: (K, 3) m, world, positions in these frames.
        height_m: median extent along up.
        inside: share of these frames in which the person is in the working volume.
        enters: first of these frames in which the person is in the working volume, or None.
        views: (K,) number of cameras that show the person.
        cameras: names of the cameras that show the person in most of these frames.
    """

    number: int
    frames: tuple[int, ...]
    path: tuple[tuple[float, float, float], ...]
    height_m: float
    inside: float
    enters: int | None
    views: tuple[int, ...]
    cameras: tuple[str, ...]

    def line(self, cameras: int) -> str:
        """Return the person's line in the table."""
        x, y, z = self.path[0]
        few, many = min(self.views), max(self.views)
        seen = f"{many}" if few == many else f"{few} to {many}"
        return (
            f"person {self.number}: frames {self.frames[0]} to {self.frames[-1]}, {self.inside:.0%} of them in the "
            f"volume; first at ({x:.1f}, {y:.1f}, {z:.1f}) m; {self.height_m:.1f} m tall; seen by {seen} of {cameras} "
            "cameras"
        )


@dataclass(eq=False)
class _Path:
    """A person who is followed over the looks."""

    found: list[tuple[int, LocatedPerson]] = field(default_factory=list)

    @property
    def last(self) -> tuple[int, LocatedPerson]:
        return self.found[-1]

    @property
    def enters(self) -> int | None:
        """First frame in which the person is in the working volume."""
        return next((index for index, person in self.found if person.inside), None)


class PeopleWatch:
    """Follows the people of a capture over its sampled frames, in order.

    Args:
        capture: the capture.
        span: frames that are looked at.

    Attributes:
        entered: frame of the first look in which the working volume was not empty; 0 if it is the first of all, None
            before it. People who are then in the volume have the first numbers, as in `tk track`, see
            :func:`tk.people.choose.in_order`; then come those who enter it later, in this order, and last those who
            never do.
    """

    def __init__(self, capture: Capture, span: range) -> None:
        self._capture = capture
        self._finder = PeopleFinder(capture.rig, capture.volume, capture.up)
        self._start = capture.init_frame if capture.init_frame in span else span.start
        self._every = max(1, round(capture.fps / _LOOKS_HZ), -(-(span.stop - self._start) // _MOST_LOOKS))
        self._paths: list[_Path] = []
        self._open: list[_Path] = []
        self._looks = 0
        self.entered: int | None = None
        self._first: list[_Path] = []  # the people in the volume in that look

    def wants(self, index: int) -> bool:
        """Return whether to :meth:`look` at a frame."""
        return index >= self._start and (index - self._start) % self._every == 0

    def look(self, index: int, labels: Labels) -> None:
        """Find the people in what a frame shows, and assign them to the paths so far.

        The assignment has the least sum of distances on the way from the last positions (Kuhn 1955).
        """
        masks, uncertain, landmarks = labels.masks, labels.uncertain, labels.landmarks
        self._looks += 1
        hidden = _HIDDEN_S * self._capture.fps
        self._open = [path for path in self._open if index - path.last[0] <= max(hidden, self._every)]
        near = [person for at, person in (path.last for path in self._open) if at == index - self._every]
        found = self._finder.find(masks, uncertain, near, landmarks=landmarks)
        enter = self.entered is None and not self._finder.is_empty(masks, found)
        if enter:
            self.entered = index if index > self._start else 0
            frame = Frame(index, np.empty((len(masks), 0, 0, 3), np.uint8), masks, uncertain, landmarks=landmarks)
            found = in_order(self._finder, self._capture.setup(), [frame], found)
        before = np.array([path.last[1].position for path in self._open]).reshape(-1, 3)
        now = np.array([person.position for person in found]).reshape(-1, 3)
        distance = np.linalg.norm(before[:, None] - now[None], axis=2)
        seconds = np.array([index - path.last[0] for path in self._open]) / self._capture.fps
        reach = np.minimum(_FASTEST_M_S * seconds, _FASTEST_M_S) + _ERROR_M
        fits = distance <= reach[:, None]
        rows, columns = scipy.optimize.linear_sum_assignment(np.where(fits, distance, 1e3))
        taken = {int(k): self._open[i] for i, k in zip(rows, columns, strict=True) if fits[i, k]}
        for k, person in enumerate(found):
            if k not in taken:
                taken[k] = _Path()
                self._paths.append(taken[k])
                self._open.append(taken[k])
            taken[k].found.append((index, person))
        if enter:
            # if cameras contradict each other, everybody may seem to be outside
            self._first = [taken[k] for k, person in enumerate(found) if person.inside or k == 0]

    @cached_property
    def _grid(self) -> RayGrid:
        return RayGrid(self._capture.rig, FINE_ROWS)

    def of_first(self, index: int, masks: NDArray[np.uint8], landmarks: Float | None) -> NDArray[np.uint8]:
        """Return the masks (C, H, W) of a frame, whose landmarks are (N, C, L, 4), with the pixels of everybody but
        person 0 as those of others."""
        rig, path = self._capture.rig, self._numbered()[0].found
        last = min(path, key=lambda look: abs(look[0] - index))[1]
        found = self._finder.find(masks, landmarks=landmarks)
        by_distance = sorted(found, key=lambda person: float(np.linalg.norm(person.position - last.position)))
        whole = Frame(index, np.empty((len(rig), 0, 0, 3), np.uint8), masks)
        return owners_by_hulls(rig, self._grid, by_distance, whole).share(whole, 0).masks

    def people(self) -> tuple[PersonReport, ...]:
        """Return the people. Somebody who was seen only for a moment is left out; the numbers of the people in the look
        :attr:`entered` stay."""
        least = min(1 + round(_SEEN_S * self._capture.fps / self._every), self._looks)
        kept = [path for path in self._numbered() if path in self._first or len(path.found) >= least]
        return tuple(self._report(k, path) for k, path in enumerate(kept) if len(path.found) >= least)

    def _numbered(self) -> list[_Path]:
        """Return the paths in the order of their numbers, see :attr:`entered`."""
        later = [path for path in self._paths if path not in self._first]
        return self._first + sorted(later, key=lambda path: np.inf if path.enters is None else path.enters)

    def _report(self, number: int, path: _Path) -> PersonReport:
        found, people = path.found, [person for _, person in path.found]
        shown = np.mean([person.views for person in people], axis=0)
        return PersonReport(
            number=number,
            frames=tuple(index for index, _ in found),
            path=tuple((float(x), float(y), float(z)) for x, y, z in (person.position for person in people)),
            height_m=float(np.median([person.height_m for person in people])),
            inside=float(np.mean([person.inside for person in people])),
            enters=path.enters,
            views=tuple(int(person.views.sum()) for person in people),
            cameras=tuple(name for name, share in zip(self._capture.rig.names, shown, strict=True) if share > 0.5),
        )


def many_people(people: Sequence[PersonReport], entered: int) -> list[str]:
    """Return what several people, or a volume that is empty before the frame ``entered``, mean for tracking, one line
    each."""
    lines = []
    if entered:
        lines.append(
            f"the volume is empty before about frame {entered}: tk track begins there; earlier frames are absent"
        )
    if len(people) < 2:
        return lines
    inside = [person for person in people if person.enters is not None]
    others = [person.number for person in inside[1:] if person.enters == inside[0].enters]
    choose = f"--people {others[0]} takes person {others[0]}, " if others else ""
    lines.append(
        f"{len(people)} people are in view, {len(inside)} of them in the volume: tk track takes person 0, {choose}"
        "--people all takes everybody in the volume"
    )
    for person in people:
        if person.enters is None:
            lines.append(
                f"person {person.number} stays outside the volume, in {', '.join(person.cameras)}: tk track does not "
                "take these pixels for the subject's"
            )
        elif person.enters > min(p.enters for p in inside if p.enters is not None):
            lines.append(
                f"person {person.number} enters the volume at about frame {person.enters}: --people {person.number} "
                "takes this person from then on"
            )
    return lines
