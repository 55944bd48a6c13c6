"""Connect cameras that see the board at the same instants: first poses of all cameras and boards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.calibration.bundle import State
from tk.calibration.intrinsics import Fitted
from tk.calibration.poses import IDENTITY, Pose, angle_deg
from tk.errors import CalibrationError

Float = NDArray[np.float64]

#: two estimates of the pose of a board in a camera agree if they differ by less than this: 12 % of its distance, 7°
_AGREE = 0.12


@dataclass(frozen=True)
class Link:
    """Two cameras that see the board at the same instants."""

    one: int
    other: int
    shared: tuple[int, ...]  # instants
    agreeing: tuple[int, ...]  # instants whose estimates of the pose agree
    pose: Pose  # from the frame of ``other`` to that of ``one``

    @property
    def consistent(self) -> bool:
        """Whether enough of the instants agree: two, and a third of all. A single instant cannot be checked."""
        return len(self.agreeing) >= min(2, len(self.shared)) and 3 * len(self.agreeing) >= len(self.shared)


def find_links(fitted: Sequence[Fitted]) -> list[Link]:
    """Return the pairs of cameras with shared instants."""
    links = []
    for a in range(len(fitted)):
        for b in range(a + 1, len(fitted)):
            shared = sorted(set(fitted[a].poses) & set(fitted[b].poses))
            if shared:
                links.append(_link(a, b, shared, fitted[a].poses, fitted[b].poses))
    return links


def _link(a: int, b: int, shared: Sequence[int], one: Mapping[int, Pose], other: Mapping[int, Pose]) -> Link:
    poses = [one[i] @ other[i].inverse() for i in shared]
    apart = np.array([[_apart(pose @ other[i], one[i]) for i in shared] for pose in poses])
    best = int(np.argmin(np.minimum(apart, _AGREE).sum(axis=1)))
    near = np.flatnonzero(apart[best] < _AGREE)
    return Link(a, b, tuple(shared), tuple(shared[int(k)] for k in near), poses[best])


def _apart(p: Pose, q: Pose) -> float:
    """Return by how much two poses of a board in a camera differ: the distance of its places as a share of its distance
    from the camera, and the angle between its directions in radians."""
    move = np.linalg.norm(p.translation - q.translation) / np.linalg.norm(q.translation)
    return float(np.hypot(move, np.radians(angle_deg(p.rotation, q.rotation))))


def connect(names: Sequence[str], fitted: Sequence[Fitted], links: Sequence[Link]) -> State:
    """Return first poses: the first camera's frame is the world. The strongest links are used.

    Raises:
        CalibrationError: a camera is connected to nobody, or contradicts the others.
    """
    usable = sorted((link for link in links if link.consistent), key=lambda link: -len(link.agreeing))
    cameras: dict[int, Pose] = {0: IDENTITY}
    while len(cameras) < len(fitted):
        for link in usable:
            if link.one in cameras and link.other not in cameras:
                cameras[link.other] = link.pose.inverse() @ cameras[link.one]
                break
            if link.other in cameras and link.one not in cameras:
                cameras[link.one] = link.pose @ cameras[link.other]
                break
        else:
            raise CalibrationError(_unconnected(names, fitted, links, set(cameras)))
    boards: dict[int, Pose] = {}
    for instant in sorted({instant for one in fitted for instant in one.poses}):
        seen = {c: one.poses[instant] for c, one in enumerate(fitted) if instant in one.poses}
        candidates = [cameras[c].inverse() @ pose for c, pose in seen.items()]
        # the one that fits most cameras' views
        boards[instant] = min(
            candidates,
            key=lambda board: sum(min(_apart(cameras[c] @ board, pose), _AGREE) for c, pose in seen.items()),
        )
    return State(tuple(one.lens for one in fitted), tuple(cameras[c] for c in range(len(fitted))), boards)


def _unconnected(names: Sequence[str], fitted: Sequence[Fitted], links: Sequence[Link], known: set[int]) -> str:
    """Return why some cameras cannot be connected: the smaller group is named."""
    rest = [c for c in range(len(names)) if c not in known]
    lonely = rest if len(rest) <= len(known) else sorted(known)
    across = [link for link in links if (link.one in lonely) != (link.other in lonely)]
    if across:
        link = max(across, key=lambda one: len(one.shared))
        a, b = (link.one, link.other) if link.one in lonely else (link.other, link.one)
        return (
            f"camera {names[a]}: contradicts camera {names[b]}: of {len(link.shared)} shared instants only "
            f"{len(link.agreeing)} agree on where they stand to each other; its images are of other instants (a late "
            "video, swapped files), or are mirrored; synchronise the videos (tk sync) and look at its sync.png"
        )
    which = ", ".join(names[c] for c in lonely)
    single = len(lonely) == 1
    views = sum(len(fitted[c].poses) for c in lonely)
    return (
        f"camera{'' if single else 's'} {which}: connected to nobody: {'it sees' if single else 'they see'} the board "
        f"in {views} images, none of them at an instant in which another camera sees it; show the board where both do"
    )
