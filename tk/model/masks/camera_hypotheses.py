"""The most probable explanation of the opening's masks: cameras are right, some are wrong, or two videos are exchanged.

The states of a camera are those of :mod:`tk.trackers.judgement`, with the same rates: right, poor mask, wrong. Every
explanation is compared with the one in which nothing belongs together, so a mask of a wrong camera counts nothing. The
logarithms of these ratios are added:

- Pairs of outlines. If both cameras are right, errors are normal. If one is wrong, an error of any size is possible.
  A poor mask misses pieces, or shows pieces of other things, so its errors have one sign in all pairs. A turned camera
  has both signs.
- Shares of masks outside the hull of the right cameras. The hull is larger than the person, so a share of zero confirms
  nothing, and a large one contradicts.
- Landmarks. They confirm a camera whose mask misleads. Without them, such a camera is left out, as a wrong one.

A majority of the cameras must be right: the probability that less are speaks for refusing them all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.model.cues.landmarks import ELSEWHERE

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

# A camera becomes wrong once in eleven minutes, a mask poor once in half a minute; both last five seconds. These rates
# are assumed, and so is the share of the frames with a poor mask in which it misleads.
WRONG_HZ, END_HZ, POOR_HZ, MISLEADS = 0.0015, 0.2, 0.03, 0.05
#: Shares of the time in which a camera is wrong, and its mask poor.
WRONG, POOR = WRONG_HZ / END_HZ, POOR_HZ / (END_HZ + POOR_HZ)
#: Error of correct masks and cameras: three standard deviations of a pair's error, as a share of the person's size,
#: without a pixel of either mask; and the mean share of a mask outside the hull of the others.
ERROR = 0.015
# Mean size of a piece that a poor mask of the opening misses or shows, as a share of the person's size or area.
_PIECE = 0.05
# Cameras are left out, or used, if the others are right with this probability; else all are refused.
_CERTAIN = 0.9
_NEVER = np.finfo(np.float64).tiny
_RIGHT, _MISLEADING = np.log1p(-WRONG - POOR), np.log(POOR * MISLEADS)


class Verdict(NamedTuple):
    """The cameras that are wrong; the two cameras whose videos are exchanged, or None; whether all are refused."""

    wrong: tuple[int, ...]
    exchanged: tuple[int, int] | None
    refused: bool


class PairNats(NamedTuple):
    """(C, C) logarithms of the likelihood ratios of each pair of cameras showing one person, nats; 0 if unknown.

    They are for three cases: both masks are good; the first one misses pieces; it shows pieces of other things.
    """

    good: Float
    missing: Float
    surplus: Float

    @staticmethod
    def of(error: Float, tolerance: Float) -> PairNats:
        """Compare errors.

        Args:
            error: (C, C, 2) by how much the first outline extends beyond the second on both sides, as a share of the
                person's size; NaN if unknown.
            tolerance: (C, C) three standard deviations of such an error.
        """
        away, sigma = np.abs(error), tolerance[..., None] / 3
        any_size = _PIECE / (_PIECE + away) ** 2 / 2
        normal = np.exp(-((away / sigma) ** 2) / 2) / (np.sqrt(2 * np.pi) * sigma)
        piece = np.exp(-away / _PIECE) / _PIECE
        known = np.isfinite(error)
        found = []
        for density in (normal, (normal + piece * (error < 0)) / 2, (normal + piece * (error > 0)) / 2):
            ratio = np.log(np.maximum(density, _NEVER)) - np.log(any_size)
            # both sides of a pair share the errors of its masks: they count as one
            mean = np.where(known, ratio, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
            found.append(np.where(known.any(axis=-1), np.logaddexp(mean, np.log(WRONG)), 0.0))
        return PairNats(*found)


class Explanation(NamedTuple):
    """The cameras that are wrong, and the logarithm of the probability, up to a constant, nats."""

    wrong: tuple[int, ...]
    nats: float


def most_probable(
    pairs: PairNats,
    seen: Bool,
    landmarks: Float,
    outside: Callable[[tuple[int, ...]], Float],
    exchange: Callable[[int, int], PairNats | None],
) -> Verdict:
    """Return the verdict on C cameras.

    Args:
        pairs: the errors of all pairs.
        seen: (C,) cameras whose masks show anything. The others are not judged.
        landmarks: (C,) logarithm of the likelihood ratio of each camera being right, nats; NaN if there is none.
        outside: returns (C,) the share of each mask outside the hull of the other ones among some cameras; NaN if there
            is none. It is asked only where this can change the verdict.
        exchange: returns the errors after the videos of two cameras are exchanged; None if they cannot be.
    """
    C, number = len(seen), int(np.count_nonzero(seen))
    # the network may have shown somebody else
    known = np.isfinite(landmarks)
    ratio = np.where(known, landmarks, 0.0)
    confirmed = np.logaddexp(np.log1p(-ELSEWHERE) + ratio, np.log(ELSEWHERE)) * known
    found = list(_explanations(pairs, seen, confirmed, known, outside))
    if known.any():  # all masks mislead
        found.append(Explanation((), float(C * _MISLEADING + confirmed.sum())))
    total: dict[tuple[int, ...], float] = {}
    for wrong, nats in found:
        total[wrong] = float(np.logaddexp(total.get(wrong, -np.inf), nats))
    refused = sum(comb(number, k) * WRONG**k for k in range((number + 1) // 2, number + 1)) if number > 1 else _NEVER
    exchanged = _exchanged(pairs, seen, confirmed, max(*total.values(), np.log(refused)), exchange)
    if exchanged is not None:
        return Verdict((), exchanged, True)
    whole = np.logaddexp.reduce([*total.values(), np.log(refused)])
    for wrong in sorted(total, key=lambda w: (len(w), -total[w])):
        within = np.logaddexp.reduce([nats for other, nats in total.items() if set(other) <= set(wrong)])
        if within - whole > np.log(_CERTAIN):
            return Verdict(wrong, None, False)
    return Verdict((), None, True)


def _explanations(
    pairs: PairNats, seen: Bool, landmarks: Float, known: Bool, outside: Callable[[tuple[int, ...]], Float]
) -> Iterator[Explanation]:
    """Yield the explanations that may matter, with ever more cameras whose masks are not good, but a minority. Sets
    are extended from as many of the likeliest ones as there are cameras, because there are too many sets."""
    C, judged = len(seen), np.flatnonzero(seen).tolist()
    best, kept = -np.inf, [frozenset[int]()]
    for size in range(max((len(judged) + 1) // 2, 1)):
        if size:
            kept = list({others | {c} for others in kept for c in judged if c not in others})
        bounds = {o: _explained(pairs, o, landmarks, known, lambda _: np.zeros(C)) for o in kept}
        kept.sort(key=lambda others: (-bounds[others].nats, sorted(others)))
        for others in kept:
            if bounds[others].nats < best + np.log(WRONG):  # shares only lower it
                break
            explanation = bounds[others] = _explained(
                pairs, others, landmarks, known, lambda good: np.nan_to_num(outside(tuple(sorted(good))))
            )
            best = max(best, explanation.nats)
            yield explanation
        kept = sorted(kept, key=lambda others: (-bounds[others].nats, sorted(others)))[:C]


def _explained(
    pairs: PairNats,
    others: frozenset[int],
    landmarks: Float,
    known: Bool,
    outside: Callable[[frozenset[int]], Float],
) -> Explanation:
    """Return the explanation in which the masks of some cameras are not good, and all other masks are.

    Each of these masks is poor, or its camera is wrong.
    """
    C = len(landmarks)
    rest = frozenset(range(C)) - others
    good, shares = sorted(rest), outside(rest)
    exact, pieces = _nats(shares, ERROR), _nats(shares, _PIECE)
    nats = len(good) * _RIGHT + (landmarks + exact)[good].sum() + np.triu(pairs.good, 1)[np.ix_(good, good)].sum()
    wrong = []
    for c in sorted(others):
        lost = outside(rest | {c})[good].mean()  # of the others' masks, if this one carves
        missing = pairs.missing[c, good].sum() + exact[c] + _nats(lost, _PIECE)
        surplus = pairs.surplus[c, good].sum() + pieces[c] + _nats(lost, ERROR)
        right = np.log(POOR * (1.0 - MISLEADS) / 2) + np.logaddexp(missing, surplus)
        apart = np.log(WRONG)
        if known[c]:
            right = np.logaddexp(right, _MISLEADING) + landmarks[c]
        else:
            apart = np.logaddexp(apart, _MISLEADING)
        nats += np.logaddexp(right, apart)
        if apart > right:
            wrong.append(c)
    return Explanation(tuple(wrong), float(nats))


def _nats(outside: Float | np.floating, mean: float) -> Float:
    """Return the logarithm of the likelihood of shares outside a hull, relative to a share of zero, nats. It is bounded
    by that of two faults at once."""
    return np.asarray(np.log(np.exp(-outside / mean) + WRONG**2))


def _exchanged(
    pairs: PairNats, seen: Bool, landmarks: Float, best: float, exchange: Callable[[int, int], PairNats | None]
) -> tuple[int, int] | None:
    """Return the two cameras whose exchanged videos explain the masks better than ``best``, nats; None if no two do.
    Only cameras that contradict the others can be exchanged."""
    C, result = len(seen), None
    contradict = np.flatnonzero(pairs.good.sum(axis=1) < 0).tolist()
    for a, b in combinations(contradict, 2):
        found = exchange(a, b)
        # one tested partner agrees by chance
        if found is None or (found.good[[a, b]] != 0).sum(axis=1).min() < 2:
            continue
        # landmarks of exchanged videos contradict those of the others: they say nothing
        said = np.where(np.isin(np.arange(C), (a, b)), 0.0, np.maximum(landmarks, 0.0))
        explained = _explanations(found, seen, said, np.zeros(C, np.bool_), lambda _: np.zeros(C))
        nats = float(np.log(WRONG) + np.logaddexp.reduce([e.nats for e in explained if not e.wrong]))
        if nats > best:
            best, result = nats, (a, b)
    return result
