"""The running baseline of the residual, from which a tracker and the camera monitor decide what is wrong.

The residual of a view is its missing area (body outside the mask) plus its surplus area (mask outside the body), as a
share of the person's pixels (E_S). Its level depends on the masks, the clothes and the view, so it is compared with its
own running mean and spread: ``excess = (residual − mean) / spread``.

A baseline learns what is wrong from the first frame as normal. So the residual is also compared with an absolute level,
that of correct recordings. Its measure is the *displacement* of a view, twice the geometric mean of missing and surplus
area: a body in the wrong place has both, a second person only surplus area. Missing area beyond the surplus area does
not count: furniture hides a part of the person, or the mask is torn.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from tk.model.cues.part_colors import RATE
from tk.model.stateful import Stateful

Float = NDArray[np.float64]

# Spread of a residual in a view at the start, and the least that is assumed: median of recordings, share of the person.
LEAST_SPREAD = 0.028
# An excess above this in one view, in spreads, is an outlier. The mean over the views counts it as this value, so that
# a torn mask in one of three or more views makes no frame's residual high.
OUTLIER = 5.0
# Displacement in the mean over the views: mean in correct recordings, standard deviation of its logarithm (most of it
# lies between recordings), and the frames that are judged together.
LEVEL, LEVEL_SPREAD, RECENT = 0.083, 0.28, 5


def displacements(residual: Float) -> Float:
    """Return (..., V) the displacement of each view, of residuals (..., V, 2), missing and surplus area."""
    missing, surplus = residual[..., 0], residual[..., 1]
    return np.asarray(2.0 * np.sqrt(np.minimum(missing, surplus) * surplus))


def mean_error(residual: Float) -> Float:
    """Return (...) E_S, the mean over the views that see anybody, of residuals (..., V, 2); NaN if none does."""
    return _mean_of_seen(residual.sum(axis=-1))


def displacement(residual: Float) -> Float:
    """Return (...) the mean of :func:`displacements` over the views that see anybody; NaN if none does."""
    return _mean_of_seen(displacements(residual))


def _mean_of_seen(by_view: Float) -> Float:
    seen = np.isfinite(by_view)
    total, count = np.where(seen, by_view, 0.0).sum(axis=-1), np.count_nonzero(seen, axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def variance_factor(residual: Float) -> Float:
    """Return (...) by how much larger the variance of a pose is than in a correct recording, at least 1, of residuals
    (..., V, 2).

    It is the a-posteriori variance factor of least squares: the variance is scaled by the ratio of the squared residual
    to the expected one (Förstner and Wrobel, *Photogrammetric Computer Vision*, 2016, section 4.2.3).
    """
    return np.asarray(np.fmax(displacement(residual) / LEVEL, 1.0) ** 2)


@dataclass(frozen=True)
class BaselineState:
    """Of V views: mean (V, 2) of both areas, spread (V,) of E_S, and the number of frames without a high residual."""

    mean: Float
    spread: Float
    frames: NDArray[np.int64]


class ResidualBaseline(Stateful[BaselineState]):
    """Running mean and spread of the residual of each of V views.

    Args:
        views: V.
        false_alarm: probability with which the residual of a right pose counts as high, in one frame.

    Attributes:
        threshold: the excess, in spreads, that a normal variable exceeds with this probability.
        mean: (V, 2) of missing and surplus area; NaN for a view that has seen nobody yet.
        spread: (V,) of E_S.
    """

    State = BaselineState

    def __init__(self, views: int, false_alarm: float) -> None:
        self.threshold = NormalDist().inv_cdf(1.0 - false_alarm)
        self.mean, self.spread = np.full((views, 2), np.nan), np.full(views, LEAST_SPREAD)
        self._frames = np.zeros(views, np.int64)  # without a high residual, by view

    def excess(self, error: Float) -> Float:
        """Return by how many spreads E_S (V,), or each area (V, 2), exceeds its mean; NaN for a view without
        anybody."""
        spread = self.spread if error.ndim == 1 else self.spread[:, None]
        return np.asarray((error - self._means(error)) / spread)

    def _means(self, error: Float) -> Float:
        """Return the means of E_S (V,), or of each area (V, 2). A view without a baseline gets the median of the
        others, and in the first frame the median of the residuals, because a camera that is wrong from the start must
        not become its own baseline."""
        mean = self.mean if error.ndim == 2 else self.mean.sum(axis=1)
        known, seen = np.isfinite(self.mean[:, 0]), np.isfinite(error.reshape(len(error), -1)[:, 0])
        if known.all() or not (known.any() or seen.any()):
            return mean
        mean = mean.copy()
        mean[~known] = np.median(mean[known] if known.any() else error[seen], axis=0)
        return mean

    def mean_excess(self, error: Float) -> float:
        """Return the mean excess of the views that see anybody, each at most :data:`OUTLIER`; inf if none does."""
        excess = np.minimum(self.excess(error), OUTLIER)
        seen = np.isfinite(excess)
        return float(excess[seen].mean()) if seen.any() else np.inf

    def high(self, error: Float) -> bool:
        """Return whether E_S (V,) is high in the mean over the views: the pose is probably wrong."""
        return self.mean_excess(error) > self.threshold

    def jumped(self, residual: Float) -> bool:
        """Return whether the displacement, of a residual (V, 2), is an outlier in all views at once: the person is
        elsewhere, as after a cut."""
        excess = self.excess(displacements(residual))
        seen = np.isfinite(excess)
        return bool(seen.any() and (excess[seen] > OUTLIER).all())

    def learn(self, residual: Float) -> None:
        """Update the baseline with a frame's residual (V, 2); the mean of the first frames is a plain mean. E_S counts
        as one spread above the mean at most, so that a wrong pose does not become the baseline soon."""
        error = residual.sum(axis=1)
        seen = np.isfinite(error)
        mean = self._means(residual)
        deviation = residual - mean
        rise = deviation.sum(axis=1)
        high = rise > self.spread
        deviation[high] *= (self.spread[high] / rise[high])[:, None]
        right = seen & (not self.high(error))
        rate = np.where(right, np.maximum(RATE, 1 / (2 + self._frames)), RATE)
        self._frames = self._frames + right
        mean = mean + rate[:, None] * deviation
        # a high residual is no sample of what is normal; it would widen the spread until it counts as normal itself.
        # the mean absolute deviation of a normal variable is √(2/π) standard deviations
        spread = self.spread + RATE * (np.sqrt(np.pi / 2) * np.abs(np.minimum(rise, self.spread)) - self.spread)
        self.mean = np.where(seen[:, None], mean, self.mean)
        self.spread = np.where(right, np.maximum(spread, LEAST_SPREAD), self.spread)
