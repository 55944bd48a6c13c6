"""Errors of flexion, the longest run of frames with a large limb error, and the share of errors within σ.

- Flexion is the angle between a joint's two bones, 0 for a straight limb, computed from joint positions for both the
  result and the ground truth. It is never negative: a knee bent backwards counts as bent.
- A limb joint has a large error if it is more than 15 cm off. The longest run is the largest number of consecutive
  judged frames in which at least one limb joint has a large error. It separates short errors from a lost limb.
- ``/joints/sigma`` is one standard deviation along each axis, the same in all directions. An error is within k σ if its
  length in space is at most k σ. Of normally distributed errors in three dimensions, 19.9 % are within 1 σ and 73.9 %
  within 2 σ (not the 68 % and 95 % of one dimension). A larger share means that σ is too large, a smaller share that σ
  is too small.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body.joints import HINGE_KINDS, HINGES, JOINTS

Float = NDArray[np.float64]

#: A limb joint with a larger error counts as wrong, cm; the largest PCK threshold. The longest run depends on it.
LIMB_ERROR_CM = 15.0


@dataclass(frozen=True)
class FlexionError:
    """Error of flexion, degrees; infinite if the result has NaN joints, NaN without frames to judge."""

    # mean_deg, median_deg: mean and median of the absolute difference
    mean_deg: float
    median_deg: float
    bias_deg: float  # mean of result minus ground truth where both are known; positive if the result bends more


@dataclass(frozen=True)
class Run:
    """Consecutive judged frames, ``first`` to ``last``; both None if ``frames`` is 0."""

    frames: int
    first: int | None
    last: int | None


@dataclass(frozen=True)
class SigmaShares:
    """Shares of the errors that are within k standard deviations."""

    # raw, corrected: share by k, of the raw errors and of the errors without the joints' constant offsets; NaN without
    # positions to judge
    raw: Mapping[int, float]
    corrected: Mapping[int, float]
    expected: Mapping[int, float]  # share by k of normally distributed errors
    judged: int  # number of joint positions with σ
    without: int  # number of joint positions without σ
    median_cm: float  # median of σ, cm


def flexion_deg(p_world: Float) -> dict[str, Float]:
    """Return the flexion (F,) of each hinge, degrees, from joints (F, J, 3); NaN if a bone is unknown or zero."""
    at = {name: p_world[:, index] for index, name in enumerate(JOINTS)}
    found = {}
    for name, (before, after) in HINGES.items():
        upper, lower = at[name] - at[before], at[after] - at[name]
        across = np.linalg.norm(np.cross(upper, lower), axis=1)
        along = np.sum(upper * lower, axis=1)
        with np.errstate(invalid="ignore"):
            is_bone = np.minimum(np.linalg.norm(upper, axis=1), np.linalg.norm(lower, axis=1)) > 1e-6
        found[name] = np.where(is_bone, np.degrees(np.arctan2(across, along)), np.nan)
    return found


def flexion_errors(p_result: Float, p_truth: Float) -> dict[str, FlexionError]:
    """Return the errors by hinge, and of all ``knees`` and ``elbows``, from joints (F, J, 3) of the same frames."""
    found, true = flexion_deg(p_result), flexion_deg(p_truth)
    groups = {name: (name,) for name in HINGES} | {f"{kind}s": sides for kind, sides in HINGE_KINDS.items()}
    return {
        name: _flexion_error(np.concatenate([found[n] for n in names]), np.concatenate([true[n] for n in names]))
        for name, names in groups.items()
    }


def longest_run(frames: NDArray[np.int64], limbs: Float) -> Run:
    """Return the longest run of frames in which a limb joint has an error above :data:`LIMB_ERROR_CM`.

    Args:
        frames: (F,) the judged frames.
        limbs: (F, 12) errors of the limb joints, metres; infinite if the result has no position, NaN if not judged.
    """
    order = np.argsort(frames)
    wrong = np.any(limbs > LIMB_ERROR_CM / 100, axis=1)[order]  # False for NaN
    best = current = 0
    end = -1
    for row, is_wrong in enumerate(wrong):
        current = current + 1 if is_wrong else 0
        if current > best:
            best, end = current, row
    if best == 0:
        return Run(0, None, None)
    return Run(best, int(frames[order[end - best + 1]]), int(frames[order[end]]))


def sigma_shares(sigma: Float, raw: Float, corrected: Float) -> SigmaShares:
    """Return the shares of the errors within 1 and 2 σ.

    Args:
        sigma: (F, J) m, standard deviation along one axis; NaN if unknown.
        raw, corrected: (F, J) errors, metres; infinite if the result has no position, NaN if not judged.
    """
    known = np.isfinite(sigma) & ~np.isnan(raw)

    def share(distances: Float, count: int) -> float:
        judged = known & ~np.isnan(distances)
        return float((distances[judged] <= count * sigma[judged]).mean()) if judged.any() else math.nan

    return SigmaShares(
        raw={count: share(raw, count) for count in (1, 2)},
        corrected={count: share(corrected, count) for count in (1, 2)},
        expected={count: normal_share(count) for count in (1, 2)},
        judged=int(known.sum()),
        without=int((~np.isfinite(sigma) & ~np.isnan(raw)).sum()),
        median_cm=float(100 * np.median(sigma[known])) if known.any() else math.nan,
    )


def normal_share(count: float) -> float:
    """Return the probability that a normal error in space is at most ``count`` standard deviations of one axis long.

    It is the distribution function of the Maxwell distribution.
    """
    return math.erf(count / math.sqrt(2)) - math.sqrt(2 / math.pi) * count * math.exp(-(count**2) / 2)


def _flexion_error(found: Float, true: Float) -> FlexionError:
    judged = ~np.isnan(true)
    if not judged.any():
        return FlexionError(math.nan, math.nan, math.nan)
    signed = (found - true)[judged]
    absolute = np.where(np.isnan(signed), np.inf, np.abs(signed))
    known = signed[~np.isnan(signed)]
    return FlexionError(
        float(absolute.mean()), float(np.median(absolute)), float(known.mean()) if len(known) else math.nan
    )
