"""What the methods say together: which are certain, where they contradict each other, and the clocks."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tk.errors import ClockError
from tk.synchronise.raw import Recording
from tk.synchronise.ties import OUTLIER_SIGMA, SOUND_SIGMA_S, Clocks, Tie, connected_to, solve

Float = NDArray[np.float64]

#: methods, the most precise first; pictures decide over sound, and timecode counts where nothing else is certain
METHODS = ("cameras", "flash", "person", "sound", "timecode")
#: names of the methods in tables
SHOWN = {"cameras": "motion, known cameras", "person": "motion"}
#: seconds above which sound and pictures are not of one recording
_OTHER_S = 0.25
#: seconds after which timecode begins again with 0
_DAY_S = 86400.0


@dataclass
class Decision:
    """The clocks, and how they were found.

    Attributes:
        clocks: of all cameras.
        methods: the method of each camera.
        notes: lines for the user.
        unsure: why cameras are not synchronised, by camera; empty if all are.
        faulty: what is wrong with the video of a camera, so that no offset helps, and the remedy.
    """

    clocks: Clocks
    methods: list[str]
    notes: list[str] = field(default_factory=list)
    unsure: dict[int, str] = field(default_factory=dict)
    faulty: dict[int, str] = field(default_factory=dict)


def decide(recordings: Sequence[Recording], ties: Sequence[Tie], reasons: dict[int, list[str]]) -> Decision:
    """Return the clocks that fit the ties of all methods, after the methods have checked each other.

    Args:
        recordings: the cameras; the first is the reference.
        ties: those that each method is certain of.
        reasons: what the methods miss, by camera.
    """
    count = len(recordings)
    by_kind = {kind: [tie for tie in ties if tie.kind == kind] for kind in METHODS}
    alone = {kind: solve(count, own) for kind, own in by_kind.items() if own}
    notes: list[str] = []
    unsure: dict[int, str] = {}
    kept = dict(by_kind)
    pictures = [kind for kind in ("cameras", "flash", "person") if kind in alone]
    for n, one in enumerate(pictures):
        for other in pictures[n + 1 :]:
            for c, apart, sigma in _differences(recordings, by_kind[one], by_kind[other]):
                interval = recordings[c].interval_s
                if abs(apart) > max(OUTLIER_SIGMA * sigma, 1.5 * interval):
                    unsure[c] = (
                        f"{SHOWN.get(one, one)} and {SHOWN.get(other, other)} contradict each other by "
                        f"{_seconds(apart)}"
                    )
    seen = [tie for kind in pictures for tie in by_kind[kind]]
    for c, apart, sigma in _differences(recordings, by_kind["sound"], seen):
        if abs(apart) > _OTHER_S + 3 * sigma:
            unsure[c] = f"its sound and its pictures contradict each other by {_seconds(apart)}"
        elif abs(apart) > OUTLIER_SIGMA * np.hypot(sigma, SOUND_SIGMA_S):
            notes.append(
                f"{recordings[c].where}: its sound is {_seconds(abs(apart))} {'late' if apart > 0 else 'early'}, more "
                f"than the way of the sound and devices explain; the pictures decide"
            )
            kept["sound"] = [tie for tie in kept["sound"] if c not in (tie.i, tie.j)]
    certain = [tie for kind in METHODS[:-1] for tie in kept[kind]]
    for c, apart, sigma in _differences(recordings, by_kind["timecode"], certain):
        if abs(apart) > max(OUTLIER_SIGMA * sigma, 2 * recordings[c].interval_s):
            notes.append(f"{recordings[c].where}: its timecode differs by {_seconds(apart)}, and is not used")
    used = certain
    if by_kind["timecode"] and not connected_to(0, count, [(tie.i, tie.j) for tie in certain]).all():
        used = [*certain, *by_kind["timecode"]]
        notes.append("timecode alone gives the offsets of some cameras; nothing checks it, so look at sync.png")
    clocks = solve(count, used)
    dropped: dict[str, list[str]] = {}
    for i, j, kind in clocks.dropped:
        dropped.setdefault(kind, []).append(f"{recordings[i].name} and {recordings[j].name}")
    for kind, pairs in dropped.items():
        notes.append(f"{SHOWN.get(kind, kind)} of {', '.join(pairs)} contradicts the other pairs, and is not used")
    for c in np.flatnonzero(~clocks.connected).tolist():
        unsure.setdefault(c, "; ".join(reasons.get(c, [])) or "nothing connects it to the others")
    return Decision(clocks, [_method(c, used, clocks) for c in range(count)], notes, unsure)


def refused(recordings: Sequence[Recording], decision: Decision) -> ClockError:
    """Return the error about cameras that are faulty or not certain, one line."""
    for c, text in decision.faulty.items():
        return ClockError(f"{recordings[c].where}: {text}")
    first = min(decision.unsure, key=lambda c: (recordings[c].name == recordings[0].name, c))
    others = [recordings[c].name for c in decision.unsure if c != first and c != 0]
    hint = _creation_times(recordings, first)
    return ClockError(
        f"{recordings[first].where}: not sure when it was recorded: {decision.unsure[first]}"
        + (f"; neither are {', '.join(others)}" if others else "")
        + f"; give --offsets {shlex.quote(_offsets(recordings, decision))} by hand{hint}"
    )


def _offsets(recordings: Sequence[Recording], decision: Decision) -> str:
    """Return the value of ``--offsets`` with what is known, and SECONDS in the other places."""
    known = np.isfinite(decision.clocks.offsets_s) & (0 not in decision.unsure)
    known[list(decision.unsure)] = False
    seconds = [f"{s:.4f}" if k else "SECONDS" for s, k in zip(decision.clocks.offsets_s, known, strict=True)]
    names = [recording.name for recording in recordings]
    return ",".join([f"{names[0]}=0", *(f"{name}={s}" for name, s in zip(names[1:], seconds[1:], strict=True))])


def timecode_ties(recordings: Sequence[Recording]) -> list[Tie]:
    """Return a tie of each camera with the first by timecode, if all have one and they differ."""
    codes = [recording.timecode_s for recording in recordings]
    known = [code for code in codes if code is not None]
    if len(known) < len(codes) or (not np.ptp(known) > 0 and max(known) == 0):
        return []
    first = recordings[0]
    ties = []
    for c, (recording, code) in enumerate(zip(recordings[1:], known[1:], strict=True), 1):
        ahead = (code - known[0] + _DAY_S / 2) % _DAY_S - _DAY_S / 2  # the recording began so much later
        sigma = max(first.interval_s, recording.interval_s)
        ties.append(Tie(0, c, first.times_s[0] + ahead, recording.times_s[0], sigma, "timecode"))
    return ties


def _differences(
    recordings: Sequence[Recording], one: Sequence[Tie], other: Sequence[Tie]
) -> list[tuple[int, float, float]]:
    """Return cameras that two methods place differently: camera, by how much later ``one`` has it, and sigma, seconds.

    The cameras that both methods connect are compared with their median, so that one wrong camera is named, not the
    reference.
    """
    count = len(recordings)
    if not one or not other:
        return []
    found = []
    for root in range(count):
        both = connected_to(root, count, [(t.i, t.j) for t in one]) & connected_to(
            root, count, [(t.i, t.j) for t in other]
        )
        members = np.flatnonzero(both).tolist()
        if len(members) < 2 or members[0] != root:
            continue
        # the skew of the sound is estimated
        a, b = (solve(count, ties, root, skew_sigma_s=1e-9) for ties in (one, other))
        middle = [float(np.mean(recordings[c].span)) for c in members]
        apart = np.array([b.common(c, at) - a.common(c, at) for c, at in zip(members, middle, strict=True)])
        apart -= np.median(apart) if len(apart) > 2 else apart[0]
        sigma = np.hypot(a.offset_sigma_s, b.offset_sigma_s)
        found += [(c, float(x), float(sigma[c])) for c, x in zip(members, apart, strict=True)]
    return found


def _method(c: int, ties: Sequence[Tie], clocks: Clocks) -> str:
    """Return the methods of a camera, those that decide first."""
    dropped = set(clocks.dropped)
    kinds = {tie.kind for tie in ties if c in (tie.i, tie.j) and (tie.i, tie.j, tie.kind) not in dropped}
    return ", ".join(SHOWN.get(kind, kind) for kind in METHODS if kind in kinds)


def _seconds(value: float) -> str:
    return f"{value:.2f} s" if abs(value) >= 1 else f"{1000 * value:.0f} ms"


def _creation_times(recordings: Sequence[Recording], c: int) -> str:
    """Return what the creation times in the files say, as a hint: whole seconds, of the start or the end."""
    one, other = recordings[0].created, recordings[c if c else 1].created
    if one is None or other is None or (one.tzinfo is None) != (other.tzinfo is None):
        return ""
    return f" (the files were created {(other - one).total_seconds():+.0f} s apart, at their start or end)"
