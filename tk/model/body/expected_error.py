"""The expected error of raw joint positions, as a range: from sigma, and from offsets that sigma does not contain.

The position of a joint differs from the anatomical joint by an error that varies from frame to frame, which sigma
describes, and by an offset that is constant in the body: the body model's knee is not exactly where the person's knee
is. The mean distance of an offset o and an independent normal error with the standard deviation s along each axis is
about the root of o² and 8/π s² (exact where either is zero).

The offset depends on the person, and sigma is too small or too large in a recording. Neither can be measured without
ground truth. So the mean offset of a kind of joint is taken from recordings with ground truth, and the expected error
is a range: a further person's mean error is in it with a probability of 90 %.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tk.model.body.joints import ROWS

Float = NDArray[np.float64]

# Mean error divided by the expected one: 90 % prediction interval of a further recording (Student, of the logarithms)
# for the mean of all joints, and 5 to 95 % for a single joint's mean.
_ALL_JOINTS = np.array([0.54, 1.73])
_ONE_JOINT = np.array([0.48, 2.40])
#: squared mean length of a normal vector with standard deviation 1 along each axis.
MEAN_LENGTH = 8 / np.pi


def expected_errors(sigma_m: Float, names: Sequence[str]) -> Float:
    """Return the expected distance (..., J) of joints from their true positions, metres.

    NaN where sigma (..., J) or the kind of the joint is unknown.
    """
    offset_m = np.array([ROWS[name].offset_m if name in ROWS else np.nan for name in names])
    return np.asarray(np.sqrt(MEAN_LENGTH * sigma_m**2 + offset_m**2))


def mean_range(expected_m: Float) -> Float | None:
    """Return the range (2,), metres, of the mean of these expected errors, NaN ones left out; None if all are NaN.

    Args:
        expected_m: (F, J) of all joints, or (F,) of one joint.
    """
    known = expected_m[np.isfinite(expected_m)]
    factors = _ALL_JOINTS if expected_m.ndim == 2 else _ONE_JOINT
    return factors * known.mean() if len(known) else None


def in_cm(range_m: Float) -> str:
    """Return a range in words."""
    return f"{100 * range_m[0]:.1f} to {100 * range_m[1]:.1f} cm"
