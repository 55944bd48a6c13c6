"""Compare a result of several people with ground truth: who was found, identity switches, and errors per person.

In each frame, people of the result are assigned to people of the ground truth so that the sum of the mean joint
distances is least (:func:`scipy.optimize.linear_sum_assignment`); pairs above :data:`MATCH_M` are no matches. Frames
in which a person of the result is lost or absent do not show this person.

- Miss: a person of the ground truth without a match. False positive: a person of the result without a match.
- Identity switch: a person of the ground truth is matched with another person of the result than in the last match.
- MOTA (Bernardin and Stiefelhagen 2008, "Evaluating multiple object tracking performance: the CLEAR MOT metrics",
  section 2.1.3): 1 - (misses + false positives + switches) / frames of all people of the ground truth. The paper keeps
  matches of the frame before; here each frame is assigned anew, because joint distances separate people well.
- IDF1 (Ristani et al. 2016, "Performance measures and a data set for multi-target, multi-camera tracking", section 3):
  each person of the ground truth gets one person of the result for the whole recording, so that most frames match;
  2 × these frames / (frames of all people of the ground truth + of the result).

Errors of a person are those of the frames with a match, whoever it is matched with; misses and switches are counted
apart. Only frames of the ground truth between the first and the last frame of the result are judged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its packages are imported when they are first used
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.evaluation.joints import Evaluation, evaluate, plain_values
from tk.io.results.data import JointTrack
from tk.io.results.status import has_pose
from tk.model.body.joints import JOINTS

Float = NDArray[np.float64]

#: Largest mean joint distance of a match, m: about the width of a person.
MATCH_M = 0.5


@dataclass(frozen=True)
class PersonScore:
    """How well one person of the ground truth was tracked."""

    person: int  # number in the ground truth
    matched_with: tuple[int, ...]  # numbers in the result, in the order of the first match
    frames: int  # number of judged frames in which the person is present
    matches: int  # number of these frames with a match
    switches: int  # number of identity switches
    errors: Evaluation | None  # errors in the frames with a match; None without any


@dataclass(frozen=True)
class PeopleEvaluation:
    """Accuracy of a result with several people."""

    people: tuple[PersonScore, ...]  # scores of the people of the ground truth
    people_in_result: int  # number of people of the result
    frames: int  # number of judged frames
    # misses, false_positives, switches: numbers over all people
    misses: int
    false_positives: int
    switches: int
    # mota, idf1: as defined above; NaN if the ground truth shows nobody
    mota: float
    idf1: float
    mean_distance_cm: float  # mean joint distance of the matches, cm; NaN without matches

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinity and NaN become None."""
        people = [{**vars(score), "errors": score.errors and score.errors.to_dict()} for score in self.people]
        return dict(plain_values({**vars(self), "match_cm": 100 * MATCH_M, "people": people}))

    def format_table(self) -> str:
        """Return the table that ``tk evaluate`` prints; lines have at most 100 characters."""
        head = f"{'':10}{'result':>8}{'frames':>8}{'missed':>8}{'switches':>10}"
        lines = [f"{head}{'limbs raw':>12}{'without offset':>16}{f'all {len(JOINTS)} raw':>12}{'knees':>8}"]
        lines.append(f"{'':44}{'[cm]':>12}{'[cm]':>16}{'[cm]':>12}{'[°]':>8}")
        for score in self.people:
            found = ", ".join(map(str, score.matched_with)) or "-"
            counts = f"{found:>8}{score.frames:8}{score.frames - score.matches:8}{score.switches:10}"
            lines.append(f"{f'person {score.person}':10}{counts}{_format_errors(score.errors)}")
        lines += [
            "",
            f"MOTA {100 * self.mota:.1f} %, IDF1 {100 * self.idf1:.1f} %; {self.frames} frames: "
            f"{self.misses} misses, {self.false_positives} false positives, {self.switches} switches",
            f"{len(self.people)} people in the truth, {self.people_in_result} in the result; a match is a mean joint "
            f"distance up to {100 * MATCH_M:g} cm",
        ]
        return "\n".join(lines)


def evaluate_people(result: Sequence[JointTrack], truth: Sequence[JointTrack]) -> PeopleEvaluation:
    """Compare the people of a result with those of the ground truth.

    Raises:
        ResultError: the two have no frame in common.
    """
    shown = [{int(f): k for k, f in enumerate(track.frames) if _shows(track, k)} for track in result]
    rows = [{int(f): k for k, f in enumerate(track.frames) if _shows(track, k)} for track in truth]
    listed = np.concatenate([track.frames for track in result])
    first, last = (int(listed.min()), int(listed.max())) if len(listed) else (0, -1)
    frames = sorted({int(f) for track in truth for f in track.frames if first <= f <= last})
    if not frames:
        raise ResultError(f"{result[0].path}: has no frame in common with {truth[0].path}")
    matched: list[dict[int, int]] = [{} for _ in truth]  # for each person of the truth: person of the result by frame
    within = np.zeros((len(truth), len(result)), np.int64)  # frames in which two people are within MATCH_M
    distances_m: list[float] = []
    found = 0
    for frame in frames:
        true = [person for person, known in enumerate(rows) if frame in known]
        here = [person for person, known in enumerate(shown) if frame in known]
        found += len(here)
        distance = np.array(
            [
                [_distance(truth[t].positions[rows[t][frame]], result[r].positions[shown[r][frame]]) for r in here]
                for t in true
            ]
        ).reshape(len(true), len(here))
        near = distance <= MATCH_M
        within[np.ix_(true, here)] += near
        # two people too far apart cost more than all matches together, so the number of matches is the largest possible
        for i, j in zip(*scipy.optimize.linear_sum_assignment(np.where(near, distance, 1e6)), strict=True):
            if near[i, j]:
                matched[true[i]][frame] = here[j]
                distances_m.append(float(distance[i, j]))
    people = tuple(
        PersonScore(
            person=person,
            matched_with=tuple(dict.fromkeys(matches.values())),
            frames=sum(frame in rows[person] for frame in frames),
            matches=len(matches),
            switches=int(np.count_nonzero(np.diff(list(matches.values())))),
            errors=_errors(matches, result, shown, truth[person], rows[person]),
        )
        for person, matches in enumerate(matched)
    )
    present, switches = sum(score.frames for score in people), sum(score.switches for score in people)
    misses, false_positives = present - len(distances_m), found - len(distances_m)
    kept = int(within[scipy.optimize.linear_sum_assignment(within, maximize=True)].sum())
    return PeopleEvaluation(
        people=people,
        people_in_result=len(result),
        frames=len(frames),
        misses=misses,
        false_positives=false_positives,
        switches=switches,
        mota=1.0 - (misses + false_positives + switches) / present if present else float("nan"),
        idf1=2 * kept / (present + found) if present else float("nan"),
        mean_distance_cm=100 * float(np.mean(distances_m)) if distances_m else float("nan"),
    )


def _shows(track: JointTrack, row: int) -> bool:
    """Return whether a row shows the person: it has a pose and at least one known joint."""
    has = track.status is None or bool(has_pose(track.status[row : row + 1])[0])
    return has and bool(np.isfinite(track.positions[row]).all(axis=1).any())


def _distance(a: Float, b: Float) -> float:
    """Return the mean distance, m, of the joints (J, 3) that both know; infinite without any."""
    lengths = np.linalg.norm(a - b, axis=1)
    known = np.isfinite(lengths)
    return float(lengths[known].mean()) if known.any() else float("inf")


def _errors(
    matches: Mapping[int, int],
    result: Sequence[JointTrack],
    shown: Sequence[Mapping[int, int]],
    truth: JointTrack,
    rows: Mapping[int, int],
) -> Evaluation | None:
    """Return the errors of a person in the frames with a match."""
    if not matches:
        return None
    frames = np.array(list(matches))
    places = [(result[person], shown[person][frame]) for frame, person in matches.items()]
    positions = np.array([track.positions[row] for track, row in places])
    unknown = np.full(positions.shape[1], np.nan)
    sigma = np.array([unknown if track.sigma is None else track.sigma[row] for track, row in places])
    found = JointTrack(
        result[0].path, frames, positions, sigma=None if all(track.sigma is None for track in result) else sigma
    )
    return evaluate(found, JointTrack(truth.path, frames, truth.positions[[rows[int(frame)] for frame in frames]]))


def _format_errors(errors: Evaluation | None) -> str:
    if errors is None:
        return f"{'-':>12}{'-':>16}{'-':>12}{'-':>8}"
    raw, corrected, knees = errors.raw, errors.corrected, errors.flexion["knees"].mean_deg
    return f"{raw.limbs.mean_cm:12.2f}{corrected.limbs.mean_cm:16.2f}{raw.all.mean_cm:12.2f}{knees:8.1f}"
