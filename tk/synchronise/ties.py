"""Ties between the clocks of cameras, and the offsets and rates that fit them best."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

#: standard deviation of the clock rates of consumer cameras, relative
RATE_SIGMA = 50e-6
#: standard deviation of the time between sound and pictures of a camera, seconds: a way of some metres, and what the
#: device adds
SOUND_SIGMA_S = 0.015
#: two cameras are an outlier, and two methods contradict each other, if ties differ by more than so many sigma; two
#: cameras by more than this, seconds, too
OUTLIER_SIGMA, _OUTLIER_S = 5.0, 0.01


@dataclass(frozen=True)
class Tie:
    """An instant as two cameras recorded it.

    Attributes:
        i, j: the cameras.
        own_i, own_j: its own time in each, seconds.
        sigma_s: standard deviation of the difference, seconds.
        kind: the method: "sound", "flash", "person", "cameras" or "timecode".
    """

    i: int
    j: int
    own_i: float
    own_j: float
    sigma_s: float
    kind: str


@dataclass(frozen=True)
class Clocks:
    """Clocks of C cameras: common time = offset + rate · own time.

    Attributes:
        offsets_s, rates: (C,); NaN for cameras that no tie connects to the reference.
        offset_sigma_s: (C,) standard deviation of the common time in the middle of the ties, seconds.
        rate_sigma: (C,) standard deviations; that of the prior where nothing determines a rate.
        dropped: pairs of cameras and methods that contradict the others.
    """

    offsets_s: Float
    rates: Float
    offset_sigma_s: Float
    rate_sigma: Float
    dropped: tuple[tuple[int, int, str], ...] = ()

    @property
    def connected(self) -> NDArray[np.bool_]:
        """(C,) whether a camera is connected to the reference."""
        return np.isfinite(self.offsets_s)

    def common(self, camera: int, own: float) -> float:
        """Return the common time, seconds, of a camera's own time."""
        return float(self.offsets_s[camera] + self.rates[camera] * own)


def connected_to(reference: int, count: int, pairs: Iterable[tuple[int, int]]) -> NDArray[np.bool_]:
    """Return (count,) which cameras pairs connect to the reference."""
    found, links = {reference}, list(pairs)
    while more := {a for i, j in links for a in (i, j) if (i in found) != (j in found)} - found:
        found |= more
    return np.isin(np.arange(count), list(found))


def solve(count: int, ties: Sequence[Tie], reference: int = 0, skew_sigma_s: float = SOUND_SIGMA_S) -> Clocks:
    """Return the clocks of ``count`` cameras that fit the ties best, by least squares; the reference's offset is 0 and
    its rate 1.

    Pairs of cameras that contradict the others are left out, the worst first, as long as all cameras stay connected.
    """
    kept = _not_counted_twice(ties)
    dropped: list[tuple[int, int, str]] = []
    while True:
        clocks, residuals = _fit(count, kept, reference, skew_sigma_s)
        worst, size = None, 1.0
        for pair in {(tie.i, tie.j, tie.kind) for tie in kept}:
            own = [(r, tie) for r, tie in zip(residuals, kept, strict=True) if (tie.i, tie.j, tie.kind) == pair]
            off = abs(float(np.median([r for r, _ in own])))
            limit = max(_OUTLIER_S, OUTLIER_SIGMA * float(np.median([tie.sigma_s for _, tie in own])))
            rest = [(tie.i, tie.j) for tie in kept if (tie.i, tie.j, tie.kind) != pair]
            same = np.array_equal(connected_to(reference, count, rest), clocks.connected)
            if off > limit * size and same:
                worst, size = pair, off / limit
        if worst is None:
            return replace(clocks, dropped=tuple(dropped))
        dropped.append(worst)
        kept = [tie for tie in kept if (tie.i, tie.j, tie.kind) != worst]


def _not_counted_twice(ties: Sequence[Tie]) -> list[Tie]:
    """Return the ties with larger deviations: the pairs of C cameras are differences of C values, so that pairs beyond
    C - 1 say nothing new."""
    factors = {}
    for kind in {tie.kind for tie in ties}:
        pairs = {(tie.i, tie.j) for tie in ties if tie.kind == kind}
        factors[kind] = (len(pairs) / max(len({c for pair in pairs for c in pair}) - 1, 1)) ** 0.5
    return [replace(tie, sigma_s=tie.sigma_s * max(factors[tie.kind], 1.0)) for tie in ties]


def _fit(count: int, ties: Sequence[Tie], reference: int, skew_sigma_s: float) -> tuple[Clocks, Float]:
    """Return the clocks and the residual of each tie, seconds; 0 of ties between cameras that are not connected."""
    known = connected_to(reference, count, [(tie.i, tie.j) for tie in ties])
    middle = np.zeros(count)  # own times about which rates act, so that offsets and rates are nearly independent
    for c in range(count):
        at = [tie.own_i if tie.i == c else tie.own_j for tie in ties if c in (tie.i, tie.j)] or [0.0]
        middle[c] = (min(at) + max(at)) / 2
    rows, b = np.zeros((len(ties), 3, count)), np.zeros(len(ties))  # offsets, rates - 1, delays of the sound
    for k, tie in enumerate(ties):
        if known[tie.i]:
            for c, own, sign in ((tie.i, tie.own_i, 1.0), (tie.j, tie.own_j, -1.0)):
                rows[k, :, c] = sign, sign * (own - middle[c]), -sign * (tie.kind == "sound")
            b[k] = tie.own_j - tie.own_i
    precision = np.array([tie.sigma_s for tie in ties]) ** -2.0
    A = rows.reshape(len(ties), 3 * count)
    free = np.concatenate([known, np.ones(2 * count, bool)])
    free[[reference, count + reference]] = False
    prior = np.repeat([0.0, RATE_SIGMA**-2, skew_sigma_s**-2], count)
    normal = np.zeros((3 * count, 3 * count))
    normal[np.ix_(free, free)] = np.linalg.inv(((A.T * precision) @ A + np.diag(prior))[np.ix_(free, free)])
    x = normal @ (A.T @ (precision * b))
    sigma = np.sqrt(np.maximum(np.diag(normal), 0.0))
    nan = np.where(known, 0.0, np.nan)
    offsets = x[:count] - x[count : 2 * count] * middle + nan
    clocks = Clocks(offsets, 1.0 + x[count : 2 * count], sigma[:count] + nan, sigma[count : 2 * count])
    return clocks, A @ x - b
