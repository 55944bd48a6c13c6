"""`tk sync`, all steps: read, compare by each method, decide, and look."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError, VideoError
from tk.io.captures.timing import Stamps, slowest_rate
from tk.model.cameras.camera import Camera
from tk.synchronise.decide import Decision, decide, timecode_ties
from tk.synchronise.faults import (
    SURE,
    exchanged_videos,
    other_speed_or_order,
    sound_in_other_order,
    still_parts,
    unchecked_chapters,
)
from tk.synchronise.flash import compare_events
from tk.synchronise.looks import LOOKED_S, Look, first_motion, look_at
from tk.synchronise.person import Compared, align, compare_planes, compare_signals, signals_of
from tk.synchronise.raw import Recording
from tk.synchronise.sound import hear, read_track
from tk.synchronise.ties import Clocks, Tie, connected_to, solve
from tk.synchronise.travel import without_travel_time

Float = NDArray[np.float64]

#: methods that find offsets; the user can choose
METHODS = ("sound", "flash", "person", "timecode")
#: by how much better the motion of a camera fits with its images mirrored, if they are: 1.4 and more; else 0.7 to 0.95
_MIRRORED = 1.2
_OTHER_SOUND = "its sound is another one"


@dataclass
class Synchronised:
    """The result.

    Attributes:
        recordings: the cameras; the first is the reference.
        decision: clocks, methods, notes.
        looks: small images of each camera.
    """

    recordings: list[Recording]
    decision: Decision
    looks: list[Look]

    @property
    def clocks(self) -> Clocks:
        """The clocks of all cameras."""
        return self.decision.clocks

    @property
    def fps(self) -> float:
        """Rate of the slowest camera, 1/s: that of the capture if `capture.toml` has none."""
        return slowest_rate(
            [
                Stamps(recording.paths[0], offset_s + rate * recording.times_s, common=True)
                for recording, offset_s, rate in zip(
                    self.recordings, self.clocks.offsets_s, self.clocks.rates, strict=True
                )
            ]
        )


def synchronise(
    recordings: list[Recording],
    cameras: Sequence[Camera] = (),
    methods: Sequence[str] = METHODS,
    begin_s: float | None = None,
    progress: Callable[[str], object] = str,
) -> Synchronised:
    """Find the clocks of all cameras by sound, flashes, and motion, which check each other.

    Args:
        recordings: the cameras; the first is the reference.
        cameras: their calibration; empty if it is unknown.
        methods: methods of :data:`METHODS` that are used.
        begin_s: own time of the first camera at which pictures are looked at; None: at its start.
        progress: called with what is done next.

    Raises:
        VideoError: a video cannot be decoded, or shows the same picture all the time.
    """
    count = len(recordings)
    ties: list[Tie] = []
    linked = np.zeros(count, np.bool_)
    faulty: dict[int, str] = {}
    reasons: dict[int, list[str]] = {c: [] for c in range(count)}
    if "sound" in methods:
        progress("comparing the sound")
        with ThreadPoolExecutor(2) as threads:
            tracks = list(threads.map(read_track, recordings))
        heard = hear(tracks)
        faulty |= sound_in_other_order(heard)
        found = [tie for each in heard.values() for tie in each.ties]
        ties += found
        linked = max((connected_to(c, count, [(t.i, t.j) for t in found]) for c in range(count)), key=np.sum)
        for c in np.flatnonzero(~linked).tolist():
            silent = tracks[c] is None or tracks[c].silent
            reasons[c].append("it has no sound" if silent else _OTHER_SOUND)
    looks = _look(recordings, ties, begin_s, progress)
    if cameras and ties:
        ties = without_travel_time(ties, cameras, looks)
    if "flash" in methods:
        ties += compare_events(looks)
    mirrored: list[int] = []
    progress("comparing what moves")
    with ThreadPoolExecutor(2) as threads:
        signals = list(threads.map(signals_of, looks))
    if "person" in methods:
        kind = "cameras" if cameras else "person"
        pairs = compare_planes(looks, cameras) if cameras else compare_signals(signals)
        intervals = [recording.interval_s for recording in recordings]
        aligned = align(pairs, count, intervals, kind)
        ties += aligned.ties
        unsure = [c for c in range(count) if not aligned.sure(c)]
        if cameras and count > 2:
            mirrored = [c for c in unsure if is_mirrored(c, looks, cameras, pairs, intervals)]
        for c in unsure:
            still = "nothing moves in it" if not looks[c].changes.any() else "its motion fits none of the others"
            reasons[c].append("its picture is mirrored" if c in mirrored else still)
    if "timecode" in methods:
        ties += timecode_ties(recordings)
    decision = decide(recordings, ties, reasons)
    for c in mirrored:
        faulty[c] = "its picture is mirrored, by the calibration; turn mirroring off in the camera"
    clocks = decision.clocks
    if not clocks.connected[1:].any():  # the first camera may be the wrong one: the others are compared
        clocks = max((solve(count, ties, root) for root in range(count)), key=lambda each: int(each.connected.sum()))
    faulty = other_speed_or_order(recordings, signals, clocks, ties) | faulty
    if cameras and not faulty and (places := exchanged_videos(recordings, looks, cameras, decision.clocks)):
        right, (a, b) = places
        if right < 1 - SURE:
            faulty[a] = (
                f"its video and that of {recordings[b].name} look exchanged: what moves is then at one place for all "
                "cameras; exchange the names of both"
            )
        elif right < SURE:
            decision.notes.append(
                f"{recordings[a].where}: the motion does not tell whether its video and that of {recordings[b].name} "
                f"are exchanged (probability {1 - right:.2g}); compare both with the calibration in tk inspect"
            )
    decision.notes.extend(
        f"{recordings[c].where}: {_OTHER_SOUND} than that of the others; {decision.methods[c]} alone gives its offset"
        for c in range(count) if _OTHER_SOUND in reasons[c] and linked.sum() > 1 and decision.methods[c]
    )  # fmt: skip
    decision.notes.extend(unchecked_chapters(recordings, signals, clocks, ties))
    decision.notes.extend(still_parts(recordings, looks, clocks))
    decision.faulty.update(faulty)
    return Synchronised(recordings, decision, looks)


def by_hand(recordings: list[Recording], offsets_s: dict[str, float], begin_s: float | None) -> Synchronised:
    """Return the clocks of offsets, seconds, that the user gives for every camera; the common time is that of the
    first one.

    Raises:
        CaptureError: a camera is unknown or missing.
    """
    names = [recording.name for recording in recordings]
    for name in offsets_s:
        if name not in names:
            raise CaptureError(f"--offsets: there is no camera {name!r}; the cameras are {', '.join(names)}")
    for name in names:
        if name not in offsets_s:
            raise CaptureError(f"--offsets: camera {name} is missing; give one for each of {', '.join(names)}")
    count = len(names)
    nan = np.full(count, np.nan)
    offsets = np.array([offsets_s[name] - offsets_s[names[0]] for name in names])
    clocks = Clocks(offsets, np.ones(count), nan, nan)
    decision = Decision(clocks, ["by hand"] * count)
    ties = [Tie(0, c, offsets[c], 0.0, 1.0, "hand") for c in range(1, count)]
    return Synchronised(recordings, decision, _look(recordings, ties, begin_s, str))


def _look(
    recordings: Sequence[Recording], ties: Sequence[Tie], begin_s: float | None, progress: Callable[[str], object]
) -> list[Look]:
    """Return small images of each camera: where ties connect it to the first, of the part that both show."""
    progress("looking at the pictures")
    first, last = recordings[0].span
    if begin_s is None and last - first > LOOKED_S:
        begin_s = first_motion(recordings[0])
    ahead = {0: 0.0}  # own time of the first camera minus that of another
    for _ in recordings:
        for tie in ties:
            for a, b, own_a, own_b in ((tie.i, tie.j, tie.own_i, tie.own_j), (tie.j, tie.i, tie.own_j, tie.own_i)):
                if a in ahead and b not in ahead:
                    ahead[b] = ahead[a] + own_a - own_b
    start = max(recordings[c].span[0] + shift for c, shift in ahead.items())
    start = start if begin_s is None else max(start, begin_s)

    def look(c: int) -> Look:
        recording = recordings[c]
        own = start - ahead[c] if c in ahead else None
        if own is None or len(ahead) == 1:  # nothing is known: from the start, or from where the user says
            own = None if begin_s is None else max(begin_s - 60.0, recording.span[0])
        if own is not None and own > recording.span[1] - 1.0:
            own = None
        return look_at(recording, own, LOOKED_S)

    with ThreadPoolExecutor(2) as threads:
        looks = list(threads.map(look, range(len(recordings))))
    for recording, each in zip(recordings, looks, strict=True):
        if each.constant:
            first, last = float(each.times_s[0]), float(each.times_s[-1])
            when = f"from {first:.0f} s to {last:.0f} s; give --from where the person moves"
            partly = last - first < 0.9 * (recording.span[1] - recording.span[0])
            raise VideoError(
                f"{recording.paths[0]}: {recording.where}: shows the same picture "
                f"{when if partly else 'all the time; record it again'}, or leave it out with --cameras"
            )
    return looks


def is_mirrored(
    camera: int,
    looks: Sequence[Look],
    cameras: Sequence[Camera],
    pairs: Sequence[Compared],
    intervals_s: Sequence[float],
) -> bool:
    """Return whether a camera whose lag is uncertain has a certain one with its images mirrored."""
    others = [pair for pair in pairs if camera not in (pair.i, pair.j)]
    turned = compare_planes(looks, cameras, mirrored=camera)
    own = [pair.highest for pair in pairs if camera in (pair.i, pair.j)]
    if not turned or (own and np.mean([pair.highest for pair in turned]) < _MIRRORED * np.mean(own)):
        return False
    return align([*others, *turned], len(cameras), intervals_s, "cameras").sure(camera)
