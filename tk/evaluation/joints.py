"""Compute the errors of a result against ground truth (``tk evaluate``).

Frames are matched by their source index. Failures of a tracker always count:

- A joint that is NaN in the result has an infinite error. Means over it are infinite (``null`` in JSON). Medians and
  PCK stay meaningful: the error is above every threshold.
- A frame whose status is *lost* or *absent* counts as a miss of every joint for PCK. Its distances are part of the
  means, because the user gets its positions.
- A frame that is missing between the first and the last frame of the result counts as a frame of NaN. Frames of the
  ground truth before and after the result are counted and not judged.
- A joint that is NaN in the ground truth is counted and not judged. A frame in which all are NaN has no ground truth:
  the person is absent.

Different definitions of a joint (skin or bone, hip centre or hip marker) cause a constant offset, which is no tracking
error. The corrected figures remove it: the median over the frames that are not lost of ``R_t^T (estimate - truth)``,
for each joint and axis, where the columns of ``R_t`` are the trunk axes of the ground truth. With these axes, an
offset that is constant vanishes exactly, also for the trunk, and a wrong hip of the estimate does not change the other
joints. Kehl 2006 reports no errors in centimetres, so this definition is our own.

Flexion, the longest run and σ are defined in :mod:`tk.evaluation.details`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tk.errors import ResultError
from tk.evaluation.details import (
    LIMB_ERROR_CM,
    FlexionError,
    Run,
    SigmaShares,
    flexion_errors,
    longest_run,
    sigma_shares,
)
from tk.io.results.data import JointTrack
from tk.io.results.reader import read_joints, read_truth
from tk.io.results.status import Status, has_pose
from tk.model.body.joints import HINGE_KINDS, HIPS, JOINTS, LIMB_JOINTS, SHOULDERS

Float = NDArray[np.float64]

PCK_CM = (5, 10, 15)
_LABELS = {"all": f"all {len(JOINTS)}", "limbs": f"{len(LIMB_JOINTS)} limb"}


@dataclass(frozen=True)
class Score:
    """Errors of some joints over all judged frames."""

    # mean_cm, median_cm: mean and median distance, cm; infinite if NaN joints count, NaN without joints to judge
    mean_cm: float
    median_cm: float
    pck: Mapping[int, float]  # share of the joints with an error below each threshold, by threshold in cm


@dataclass(frozen=True)
class Scores:
    """Scores of ``all`` joints, of the ``limbs`` joints, and of each of ``joints`` by name."""

    all: Score
    limbs: Score
    joints: Mapping[str, Score]


@dataclass(frozen=True)
class Evaluation:
    """Accuracy of a result."""

    raw: Scores  # raw errors
    corrected: Scores  # errors without each joint's median offset in the trunk's frame
    offsets_cm: Mapping[str, tuple[float, float, float]]  # median offset of each joint: forward, left, up, cm
    judged: int  # number of judged frames: frames of both files, and frames missing inside the result
    missing_inside: int  # number of frames of the ground truth that are missing between the result's first and last
    missing_outside: int  # number of frames of the ground truth before the result's first or after its last
    without_truth: int  # number of frames of the result without ground truth
    lost: int  # number of judged frames whose status is lost or absent
    suspect: int  # number of judged frames whose status is suspect; they count like tracked ones
    nan_frames: int  # number of judged frames with at least one NaN joint in the result, missing frames included
    unknown_joints: int  # number of joint positions of judged frames that are NaN in the ground truth
    # mean rate: all frames of the result over their total wall time; None if not recorded
    frames_per_second: float | None
    median_frames_per_second: float | None  # rate of the median frame, which excludes start-up and compilation
    # errors of the flexion by `knee_l` … `elbow_r`, and of all `knees` and `elbows`
    flexion: Mapping[str, FlexionError]
    # longest_limb_error, longest_limb_error_raw: longest run of frames with a limb joint more than 15 cm off, without
    # the joints' offsets and raw
    longest_limb_error: Run
    longest_limb_error_raw: Run
    # shares of the errors within 1 and 2 σ, of `all` joints and of the `limbs`; None without σ
    sigma: Mapping[str, SigmaShares] | None

    @property
    def lost_share(self) -> float:
        """Return the share of lost frames among the judged frames."""
        return self.lost / self.judged

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, with shares added; infinity and NaN become None."""
        values = asdict(self) | {"lost_share": self.lost_share, "nan_share": self.nan_frames / self.judged}
        return dict(plain_values(values))

    def format_table(self) -> str:
        """Return the table that ``tk evaluate`` prints; lines have at most 100 characters."""
        thresholds = "".join(f"{f'PCK{cm}':>8}" for cm in PCK_CM)
        half = f"{'mean':>8}{'median':>8}{thresholds}"
        lines = [
            f"{'':12}{'raw [cm, %]':>{len(half)}}  {'without offset [cm, %]':>{len(half)}}",
            f"{'':12}{half}  {half}",
        ]
        named = [(_LABELS[name], getattr(self.raw, name), getattr(self.corrected, name)) for name in _LABELS]
        named += [(name, self.raw.joints[name], self.corrected.joints[name]) for name in JOINTS]
        for name, raw, corrected in named:
            lines.append(f"{name:12}{_format_score(raw)}  {_format_score(corrected)}")
        lines += ["", *self._details(), ""]
        lines.append(
            f"{self.judged} frames judged: {self.lost} lost ({100 * self.lost_share:.1f} %), {self.suspect} suspect, "
            f"{self.nan_frames} with NaN or missing joints"
        )
        if self.missing_inside:
            lines.append(f"{self.missing_inside} frames are missing inside the result; they count as errors")
        if self.missing_outside:
            lines.append(f"{self.missing_outside} frames of the truth are outside the result; they are not judged")
        if self.without_truth:
            lines.append(f"{self.without_truth} frames of the result have no truth; they are not judged")
        if self.unknown_joints:
            lines.append(f"{self.unknown_joints} joint positions are unknown in the truth; they are not judged")
        if self.frames_per_second is not None and self.median_frames_per_second is not None:
            lines.append(
                f"{self.frames_per_second:.1f} frames/s, {self.median_frames_per_second:.1f} by the median frame"
            )
        return "\n".join(lines)

    def _details(self) -> list[str]:
        """Return a line each for flexion, the longest run and the shares within σ."""
        parts = [
            f"{kind}s {self.flexion[f'{kind}s'].mean_deg:.1f}° "
            f"(left {self.flexion[f'{kind}_l'].mean_deg:.1f}°, right {self.flexion[f'{kind}_r'].mean_deg:.1f}°)"
            for kind in HINGE_KINDS
        ]
        run = self.longest_limb_error
        where = f", {run.first} to {run.last}" if run.frames else ""
        lines = [
            f"flexion, mean error: {', '.join(parts)}",
            f"longest run with a limb joint over {LIMB_ERROR_CM:g} cm off, without offset: {run.frames} frames{where}",
        ]
        for name, shares in (self.sigma or {}).items():
            within, expected = shares.corrected, shares.expected
            lines.append(
                f"{_LABELS[name]}: {100 * within[1]:.1f} % within 1 σ, {100 * within[2]:.1f} % within 2 σ, "
                f"without offset (if normal: {100 * expected[1]:.1f} %, {100 * expected[2]:.1f} %)"
            )
        return lines


def evaluate_files(result: str | os.PathLike[str], truth: str | os.PathLike[str]) -> Evaluation:
    """Compare a result file with a ground truth file; see :func:`evaluate`."""
    return evaluate(read_joints(result), read_truth(truth)[0])


def evaluate(result: JointTrack, truth: JointTrack) -> Evaluation:
    """Compare a result with ground truth.

    Raises:
        ResultError: the two have no frame in common, or the result has no frames.
    """
    present = truth.frames[np.isfinite(truth.positions).all(axis=2).any(axis=-1)]
    if not np.isin(result.frames, present).any():
        raise ResultError(
            f"{result.path}: has no frame in common with {truth.path}: "
            f"{_span(result.frames)} in the one, {_span(present)} in the other"
        )
    inside = (truth.frames >= result.frames.min()) & (truth.frames <= result.frames.max())
    frames = truth.frames[inside]
    row_of = {int(frame): row for row, frame in enumerate(result.frames)}
    rows = np.array([row_of.get(int(frame), -1) for frame in frames])
    found = rows >= 0
    p_truth = truth.positions[inside]
    p_result = np.full_like(p_truth, np.nan)
    p_result[found] = result.positions[rows[found]]
    lost, suspect = np.zeros((2, len(frames)), dtype=bool)
    if result.status is not None:
        status = result.status[rows[found]]
        lost[found], suspect[found] = ~has_pose(status), status == Status.SUSPECT

    known = np.isfinite(p_truth).all(axis=2)
    judged = known.any(axis=1)
    failed = ~np.isfinite(p_result).all(axis=2)
    difference = np.where((known & ~failed)[..., None], p_result - p_truth, np.nan)  # (F, J, 3)
    axes = trunk_axes(p_truth)
    in_trunk = np.einsum("fki,fjk->fji", axes, difference)
    offsets = _median_where_finite(in_trunk[~lost])  # (J, 3)
    known_trunk = known & np.isfinite(axes.sum(axis=(1, 2)))[:, None]
    distances = {"raw": _distances(difference, known), "corrected": _distances(in_trunk - offsets, known_trunk)}
    limbs = [JOINTS.index(name) for name in LIMB_JOINTS]
    sigma: Float | None = None
    if result.sigma is not None:
        sigma = np.full(known.shape, np.nan)
        sigma[found] = result.sigma[rows[found]]
    mean_rate, median_rate = _frames_per_second(result.seconds)
    return Evaluation(
        raw=_scores(distances["raw"], lost),
        corrected=_scores(distances["corrected"], lost),
        offsets_cm={name: _triple(100 * offset) for name, offset in zip(JOINTS, offsets, strict=True)},
        judged=int(judged.sum()),
        missing_inside=int((judged & ~found).sum()),
        missing_outside=int((~inside).sum()),
        without_truth=int((~np.isin(result.frames, present)).sum()),
        lost=int((judged & lost).sum()),
        suspect=int((judged & suspect).sum()),
        nan_frames=int((failed & known).any(axis=1).sum()),
        unknown_joints=int((~known[judged]).sum()),
        frames_per_second=mean_rate,
        median_frames_per_second=median_rate,
        flexion=flexion_errors(p_result, p_truth),
        longest_limb_error=longest_run(frames, distances["corrected"][:, limbs]),
        longest_limb_error_raw=longest_run(frames, distances["raw"][:, limbs]),
        sigma=None
        if sigma is None
        else {
            name: sigma_shares(sigma[:, chosen], distances["raw"][:, chosen], distances["corrected"][:, chosen])
            for name, chosen in (("all", list(range(len(JOINTS)))), ("limbs", limbs))
        },
    )


def trunk_axes(p_world: Float) -> Float:
    """Return the trunk axes (F, 3, 3) of joints (F, J, 3): the columns point forward, left and up.

    Up points from the pelvis to the neck. Left is the sum of the vectors from right to left hip and shoulder, made
    perpendicular to up; forward completes a right-handed frame. NaN if the trunk is unknown or degenerate.
    """
    joint = {name: p_world[:, index] for index, name in enumerate(JOINTS)}
    up = _unit(joint["neck"] - joint["pelvis"])
    left = joint[HIPS[0]] - joint[HIPS[1]] + joint[SHOULDERS[0]] - joint[SHOULDERS[1]]
    left = _unit(left - np.sum(left * up, axis=1, keepdims=True) * up)
    return np.stack([np.cross(left, up), left, up], axis=2)


def _unit(vectors: Float) -> Float:
    """Return the vectors (F, 3) scaled to length one; NaN for zero vectors."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 1e-6, lengths, np.nan)


def _median_where_finite(values: Float) -> Float:
    """Return the median (J, 3) over the finite values of each joint (F, J, 3); NaN without finite values."""
    result = np.full(values.shape[1:], np.nan)
    for joint in range(values.shape[1]):
        finite = values[np.isfinite(values[:, joint]).all(axis=1), joint]
        if len(finite):
            result[joint] = np.median(finite, axis=0)
    return result


def _distances(difference: Float, known: NDArray[np.bool_]) -> Float:
    """Return distances (F, J), metres: infinite if the result has no position, NaN if the ground truth has none."""
    lengths = np.linalg.norm(difference, axis=2)
    return np.where(known, np.where(np.isnan(lengths), np.inf, lengths), np.nan)


def _scores(distances: Float, lost: NDArray[np.bool_]) -> Scores:
    def score(names: Iterable[str]) -> Score:
        chosen = distances[:, [JOINTS.index(name) for name in names]]
        judged = ~np.isnan(chosen)
        hit = ~lost[:, None] & judged
        values = 100 * chosen[judged]
        if len(values) == 0:
            return Score(math.nan, math.nan, dict.fromkeys(PCK_CM, math.nan))
        pck = {cm: float((100 * chosen[hit] < cm).sum() / len(values)) for cm in PCK_CM}
        return Score(float(values.mean()), float(np.median(values)), pck)

    return Scores(score(JOINTS), score(LIMB_JOINTS), {name: score([name]) for name in JOINTS})


def _frames_per_second(seconds: Float | None) -> tuple[float | None, float | None]:
    """Return the rate over all frames and of the median frame; None if wall times are not stored."""
    if seconds is None or len(seconds) == 0 or not np.isfinite(seconds).all() or not np.median(seconds) > 0:
        return None, None
    return float(len(seconds) / seconds.sum()), float(1 / np.median(seconds))


def _format_score(score: Score) -> str:
    shares = "".join(f"{100 * share:8.1f}" for share in score.pck.values())
    return f"{score.mean_cm:8.2f}{score.median_cm:8.2f}{shares}"


def plain_values(value: Any) -> Any:
    """Return the value with infinity and NaN replaced by None, which JSON can represent."""
    if isinstance(value, Mapping):
        return {str(key): plain_values(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [plain_values(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _triple(values: Float) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _span(frames: NDArray[np.int64]) -> str:
    return f"frames {frames.min()} to {frames.max()}" if len(frames) else "no frames"
