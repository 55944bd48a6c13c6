"""Beyond distances: flexion in degrees, how long a limb is astray, whether a result knows how sure it is.

- Flexion is the angle between a joint's two bones, 0 when the limb is straight, from the joint positions of result and
  truth alike. It is never negative: a knee bent backwards counts as bent.
- A limb joint is *astray* when it is more than 15 cm off; the longest run of consecutive judged frames with one or more
  of them tells a moment's error from a limb that was lost.
- ``/joints/sigma`` is one standard deviation along each axis, the same in all directions. An error is within k σ when
  its length in space is at most k σ. Of normal errors 19.9 % are within 1 σ and 73.9 % within 2 σ (three dimensions:
  not the 68 % and 95 % of one). A larger share means that the result is surer than it says, a smaller one that it is
  less sure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.model.body.joints import HINGE_KINDS, HINGES, JOINTS

Float = NDArray[np.float64]

ASTRAY_CM = 15.0


@dataclass(frozen=True)
class FlexionError:
    """How far flexion is off, degrees; infinite where NaN joints of the result make it so, NaN with nothing to judge.

    Attributes:
        mean_deg, median_deg: of the absolute difference.
        bias_deg: the mean of result less truth where both are known: positive if the result bends more.
    """

    mean_deg: float
    median_deg: float
    bias_deg: float


@dataclass(frozen=True)
class Run:
    """Consecutive judged frames, ``first`` to ``last``; both None if there are 0 ``frames``."""

    frames: int
    first: int | None
    last: int | None


@dataclass(frozen=True)
class SigmaShares:
    """How many errors are within so many standard deviations.

    Attributes:
        raw, corrected: share by the number of standard deviations, of the errors as they are and with the joints'
            constant offsets taken off; NaN with nothing to judge.
        expected: of normal errors.
        judged: how many joint positions that is.
        without: how many more have no σ.
        median_cm: of σ.
    """

    raw: Mapping[int, float]
    corrected: Mapping[int, float]
    expected: Mapping[int, float]
    judged: int
    without: int
    median_cm: float


def flexion_deg(p_world: Float) -> dict[str, Float]:
    """Flexion of the :data:`HINGES` of joints (F, 15, 3): degrees (F,); NaN where a bone is unknown or of no length."""
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
    """By hinge, and of ``knees`` and ``elbows`` together, from joints (F, 15, 3) of the same frames."""
    found, true = flexion_deg(p_result), flexion_deg(p_truth)
    groups = {name: (name,) for name in HINGES} | {f"{kind}s": sides for kind, sides in HINGE_KINDS.items()}
    return {
        name: _flexion_error(np.concatenate([found[n] for n in names]), np.concatenate([true[n] for n in names]))
        for name, names in groups.items()
    }


def longest_run(frames: NDArray[np.int64], limbs: Float) -> Run:
    """The longest run of frames in which a limb joint is astray.

    Args:
        frames: (F,) the judged frames.
        limbs: (F, 12) distances of the limb joints, metres; infinite where the result fails, NaN: not to be judged.
    """
    order = np.argsort(frames)
    astray = np.any(limbs > ASTRAY_CM / 100, axis=1)[order]  # NaN is not
    best = current = 0
    end = -1
    for row, is_astray in enumerate(astray):
        current = current + 1 if is_astray else 0
        if current > best:
            best, end = current, row
    if best == 0:
        return Run(0, None, None)
    return Run(best, int(frames[order[end - best + 1]]), int(frames[order[end]]))


def sigma_shares(sigma: Float, raw: Float, corrected: Float) -> SigmaShares:
    """How many errors are within 1 and 2 σ.

    Args:
        sigma: (F, J) one standard deviation along each axis, metres; NaN where unknown.
        raw, corrected: (F, J) distances, metres; infinite where the result fails, NaN where not to be judged.
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
    """The probability that a normal error in space is no longer than so many of its standard deviations an axis:
    the distribution function of the Maxwell distribution."""
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
