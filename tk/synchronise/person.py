"""Offsets from what moves: signals of each camera, and with known cameras the motion in each epipolar plane.

Without a calibration, the amount of motion and its vertical part are compared. With one, motion at a point of the world
lies in one plane through the centres of two cameras; the motion in each plane, a function of time, is the same in both.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations, product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from tk.model.cameras.camera import Camera
from tk.synchronise.lags import correlate
from tk.synchronise.looks import GRID_HZ, Look
from tk.synchronise.raw import SHORTEST_S
from tk.synchronise.ties import Tie, connected_to

Float = NDArray[np.float64]

#: seconds by which a lag may differ from the best one and be the same: twice the width of most motions. Twice as many
#: change no answer of :mod:`tk.synchronise.faults`; with half of it, one of 11 right folders has a false speed.
NEAR_S = 0.35
#: planes of two cameras; share of the motion beyond the planes at each end
_PLANES, _BEYOND = 48, 0.01
#: least sine of the angle between a ray and the line through both cameras: beside it, planes are not determined
_LEAST_SINE = 0.2
#: highest probability that another lag is the right one. Of 48 cameras whose video showed another recording, it was
#: above 5e-4 for all; rhythms repeat, so that significances have more large values than normal deviates.
DOUBT = 1e-6
#: seconds over which signals without known cameras are compared with their surroundings
_SLOW_S = 1.5


@dataclass(frozen=True)
class Compared:
    """A pair of cameras, compared at each lag.

    Attributes:
        i, j: the cameras.
        first: the first lag, samples of the grid.
        z, r: (L,) significance and coefficient of each lag.
        start_i, start_j: own time of sample 0 of each camera, seconds.
    """

    i: int
    j: int
    first: int
    z: Float
    r: Float
    start_i: float
    start_j: float

    @property
    def highest(self) -> float:
        """Significance of the best lag, in units of what is common among all lags."""
        return float(self.z.max(initial=0.0)) / common_deviation(self.z)

    def at(self, lag: int) -> float:
        """Return the significance of a lag; 0 where the recordings have too little in common."""
        k = lag - self.first
        return float(self.z[k]) if 0 <= k < len(self.z) and np.isfinite(self.z[k]) else 0.0


def compare_signals(signals: Sequence[tuple[float, Float]]) -> list[Compared]:
    """Return every pair of cameras, compared by their signals: see :func:`signals_of`."""
    return [_compared(i, j, signals[i], signals[j]) for i, j in combinations(range(len(signals)), 2)]


def compare_planes(looks: Sequence[Look], cameras: Sequence[Camera], mirrored: int = -1) -> list[Compared]:
    """Return every pair of cameras, compared by the motion in epipolar planes; pairs that share too few planes are
    missing. ``mirrored``: a camera whose images are mirrored before."""
    rays = [rays_of(look, camera, c == mirrored) for c, (look, camera) in enumerate(zip(looks, cameras, strict=True))]
    pairs = list(combinations(range(len(looks)), 2))
    if mirrored >= 0:
        pairs = [pair for pair in pairs if mirrored in pair]

    def one(pair: tuple[int, int]) -> Compared | None:
        i, j = pair
        profiles = _profiles(looks[i], looks[j], rays[i], rays[j], cameras[i].center, cameras[j].center)
        return None if profiles is None else _compared(i, j, *profiles)

    with ThreadPoolExecutor(2) as threads:
        return [found for found in threads.map(one, pairs) if found is not None]


def signals_of(look: Look) -> tuple[float, Float]:
    """Return the own time of the first sample, and signals (N, 2) on the grid: the amount of motion, its vertical
    speed."""
    amount, vertical = [], []
    for k, change in enumerate(look.changes):
        one, two = look.greys[k].astype(np.float32), look.greys[k + 1].astype(np.float32)
        slope = cv2.Sobel(one + two, cv2.CV_32F, 0, 1, ksize=3) / 16
        weight = change > 0
        amount.append(float(np.sqrt(change).sum()))
        along = two - one
        below = float((slope[weight] ** 2).sum())
        vertical.append(-float((along[weight] * slope[weight]).sum()) / (below + 50.0))
    steps = np.diff(look.times_s)
    values = np.stack([np.sqrt(np.array(amount) / steps), np.array(vertical) / steps], axis=1)
    start, grid = on_grid(look.middles_s, values)
    width = _SLOW_S * GRID_HZ
    grid = grid - gaussian_filter1d(grid, width, axis=0, mode="nearest")
    scale = 1.4826 * np.median(np.abs(grid), axis=0) + 0.3 * grid.std(axis=0) + 1e-9
    grid = np.clip(grid / scale, -4, 4)  # one fast motion or glitch must not decide
    return start, grid - grid.mean(axis=0)


def on_grid(times: Float, values: Float) -> tuple[float, Float]:
    """Return the own time of the first sample, and values (N, F) at ``times`` (N,) on the grid."""
    clock = times[0] + np.arange(int((times[-1] - times[0]) * GRID_HZ) + 1) / GRID_HZ
    return float(times[0]), np.stack([np.interp(clock, times, column) for column in values.T], axis=1)


def _compared(i: int, j: int, one: tuple[float, Float], other: tuple[float, Float]) -> Compared:
    lags, r, z = correlate(one[1], other[1], round(SHORTEST_S * GRID_HZ))
    return Compared(i, j, int(lags[0]), z, r, one[0], other[0])


def rays_of(look: Look, camera: Camera, mirrored: bool) -> Float:
    """Return (h, w, 3) viewing directions of the small images' pixels, world frame.

    A calibration of images that are not turned has the other side longer.
    """
    height, width = look.greys.shape[1:]
    unturned = look.turns % 2 == 1 and (camera.width > camera.height) != (width > height)
    shape = (width, height) if unturned else (height, width)
    y, x = np.mgrid[: shape[0], : shape[1]]
    x, y = (x + 0.5) * camera.width / shape[1] - 0.5, (y + 0.5) * camera.height / shape[0] - 0.5
    rays = camera.rays(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(*shape, 3)
    rays = np.rot90(rays, look.turns) if unturned else rays
    return np.asarray(rays[:, ::-1] if mirrored else rays)


def shared_planes(
    a: Look, b: Look, rays_a: Float, rays_b: Float, center_a: Float, center_b: Float
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Return for each pixel (h, w) of both cameras the plane through both centres in which it lies, -1 if it lies in
    none; None if what moves lies in too few planes of both."""
    base = center_b - center_a
    base = base / np.linalg.norm(base)
    side = np.cross(base, np.eye(3)[np.argmin(np.abs(base))])
    side /= np.linalg.norm(side)
    third = np.cross(base, side)
    angles, usable, totals = [], [], []
    for look, rays in ((a, rays_a), (b, rays_b)):
        angles.append(np.arctan2(rays @ third, rays @ side))
        usable.append(np.linalg.norm(np.cross(rays, base), axis=2) > _LEAST_SINE)
        totals.append(np.where(usable[-1], look.moved, 0.0))
    if not all(total.any() for total in totals):
        return None
    middle = float(np.angle((totals[0] * np.exp(1j * angles[0])).sum()))
    angles = [(angle - middle + np.pi) % (2 * np.pi) - np.pi for angle in angles]
    ranges = [_quantiles(angle.ravel(), total.ravel()) for angle, total in zip(angles, totals, strict=True)]
    low, high = max(r[0] for r in ranges), min(r[1] for r in ranges)
    if high - low < 0.3 * max(r[1] - r[0] for r in ranges):
        return None
    found = []
    for angle, use in zip(angles, usable, strict=True):
        plane = np.floor((angle - low) / (high - low) * _PLANES).astype(int)
        found.append(np.where(use & (plane >= 0) & (plane < _PLANES), plane, -1))
    return found[0], found[1]


def planes_sum(motion: NDArray[np.float32], planes: NDArray[np.int64]) -> Float:
    """Return (N, P) the root of the motion (N, h, w) in each plane; ``planes`` (h, w) as in :func:`shared_planes`."""
    inside = planes >= 0
    which = planes[inside]
    sums = np.stack([np.bincount(which, change[inside], _PLANES) for change in motion])
    return np.asarray(np.sqrt(gaussian_filter1d(sums, 1.0, axis=1)))


def _profiles(
    a: Look, b: Look, rays_a: Float, rays_b: Float, center_a: Float, center_b: Float
) -> tuple[tuple[float, Float], tuple[float, Float]] | None:
    """Return the motion in each plane through the centres, (N, P) on the grid, for both cameras; None if they share too
    few planes."""
    shared = shared_planes(a, b, rays_a, rays_b, center_a, center_b)
    if shared is None:
        return None
    found = []
    for look, planes in zip((a, b), shared, strict=True):
        sums = planes_sum(look.changes, planes)
        start, grid = on_grid(look.middles_s, sums / np.sqrt(np.diff(look.times_s))[:, None])
        found.append((start, grid - grid.mean(axis=0)))
    return found[0], found[1]


def _quantiles(values: Float, weights: Float) -> tuple[float, float]:
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    low, high = np.searchsorted(share, [_BEYOND, 1 - _BEYOND])
    return float(values[order][low]), float(values[order][high])


@dataclass(frozen=True)
class Aligned:
    """Lags of all cameras that fit all pairs best.

    Attributes:
        ties: of the pairs within each group, refined to a fraction of a frame.
        groups: cameras whose lags with each other are certain.
    """

    ties: tuple[Tie, ...]
    groups: tuple[frozenset[int], ...]

    def sure(self, camera: int) -> bool:
        """Return whether the lag of a camera is certain with at least another one."""
        return any(camera in group for group in self.groups)


def align(pairs: Sequence[Compared], count: int, intervals_s: Sequence[float], kind: str) -> Aligned:
    """Return the lags of ``count`` cameras with the highest sum of significances, and which of them are certain."""
    by_pair = {(pair.i, pair.j): pair for pair in pairs}
    best: tuple[float, dict[int, int]] = (-np.inf, {})
    for pair in pairs:
        for lag in _peaks(pair.z, 3):
            placed = _place(count, by_pair, {pair.i: 0, pair.j: -(lag + pair.first)})
            score = sum(by_pair[key].at(placed[key[0]] - placed[key[1]]) for key in _within(by_pair, placed))
            if score > best[0]:
                best = score, placed
    placed = best[1]
    beside = round(max(NEAR_S, 3 * max(intervals_s)) * GRID_HZ)
    groups = tuple(_certain(frozenset(placed), by_pair, placed, beside))
    ties = [
        _tie(by_pair[i, j], placed[i] - placed[j], intervals_s, kind) for group in groups
        for i, j in _within(by_pair, group)
    ]  # fmt: skip
    return Aligned(tuple(tie for tie in ties if tie is not None), groups)


def _within(pairs: Iterable[tuple[int, int]], cameras: Container[int]) -> list[tuple[int, int]]:
    return [(i, j) for i, j in pairs if i in cameras and j in cameras]


def _certain(
    cameras: frozenset[int], pairs: dict[tuple[int, int], Compared], placed: dict[int, int], beside: int
) -> list[frozenset[int]]:
    """Return the groups of cameras whose lags with each other are certain.

    The cameras are a tree of the pairs that fit best. Each pair in it is a cut: all pairs between its two sides say
    whether another lag between the sides fits nearly as well. If one does, the sides are looked at separately.
    """
    if len(cameras) < 2:
        return []
    tree: list[tuple[int, int]] = []
    for key in sorted(_within(pairs, cameras), key=lambda key: -pairs[key].at(placed[key[0]] - placed[key[1]])):
        if not connected_to(key[0], max(cameras) + 1, tree)[key[1]]:
            tree.append(key)
    worst, sides = DOUBT, None
    for key in tree:
        side = cameras & set(np.flatnonzero(connected_to(key[0], max(cameras) + 1, [e for e in tree if e != key])))
        start, total = _total({c: placed[c] for c in side}, pairs, {c: placed[c] for c in cameras - side})
        if (doubt := _doubt(total, -start, beside)) > worst:
            worst, sides = doubt, side
    if sides is None and len(tree) == len(cameras) - 1:
        return [cameras]
    if sides is None:  # some pairs could not be compared
        sides = frozenset(np.flatnonzero(connected_to(min(cameras), max(cameras) + 1, tree)).tolist())
    return [group for part in (sides, cameras - sides) for group in _certain(part, pairs, placed, beside)]


def _doubt(total: Float, k: int, beside: int) -> float:
    """Return the probability that not lag ``k`` is the right one, nor one ``beside`` it. The likelihood of a lag is
    that of its significance as a normal deviate, in units of what is common among all lags."""
    log = np.maximum(total / common_deviation(total), 0.0) ** 2 / 2
    likelihood = np.exp(log - log.max())
    return float(1 - likelihood[max(k - beside, 0) : k + beside + 1].sum() / likelihood.sum())


def _place(count: int, pairs: dict[tuple[int, int], Compared], placed: dict[int, int]) -> dict[int, int]:
    """Return the positions of all cameras: each further one where it fits those before best, then all once more. The
    lag between cameras i and j is the difference of their positions."""
    placed = dict(placed)
    for repeat in range(2):
        waiting = [c for c in range(count) if c not in placed] if repeat == 0 else list(placed)
        while waiting:
            tried = []
            for c in waiting:
                start, total = _total({c: 0}, pairs, {k: at for k, at in placed.items() if k != c})
                if len(total):
                    tried.append((float(total.max()), c, start + int(np.argmax(total))))
            if not tried:
                break
            _, c, at = max(tried) if repeat == 0 else tried[0]
            placed[c] = at
            waiting.remove(c)
    return placed


def _total(side: dict[int, int], pairs: dict[tuple[int, int], Compared], rest: dict[int, int]) -> tuple[int, Float]:
    """Return the first shift of the cameras of one side, and by shift the significance of all pairs with the rest."""
    parts: list[tuple[int, Float]] = []
    for c, other in product(side, rest):
        pair = pairs.get((min(c, other), max(c, other)))
        if pair is None:
            continue
        apart = rest[other] - side[c]  # + shift: the lag of c after the other
        first = apart + pair.first if c < other else apart - (pair.first + len(pair.z) - 1)
        parts.append((first, pair.z if c < other else pair.z[::-1]))
    if not parts:
        return 0, np.zeros(0)
    start = min(first for first, _ in parts)
    total = np.zeros((2, max(first + len(z) for first, z in parts) - start))
    for first, z in parts:
        total[:, first - start : first - start + len(z)] += np.where(np.isfinite(z), [z, np.ones(len(z))], 0.0)
    return start, total[0] / np.sqrt(np.maximum(total[1], 1))


def _peaks(z: Float, most: int) -> list[int]:
    """Return the highest lags that lie apart by half a second."""
    left, found = np.array(z), []
    for _ in range(most):
        k = int(np.argmax(left))
        if not np.isfinite(left[k]):
            break
        found.append(k)
        left[max(0, k - GRID_HZ // 2) : k + GRID_HZ // 2] = -np.inf
    return found


def common_deviation(significance: Float) -> float:
    """Return the deviation of the significances of all lags that two recordings share; 1 without any."""
    shared = significance[np.isfinite(significance) & (significance != 0)]
    return 1.4826 * float(np.median(np.abs(shared))) + 1e-9 if len(shared) else 1.0


def _tie(pair: Compared, lag: int, intervals_s: Sequence[float], kind: str) -> Tie | None:
    """Return the tie at the peak near a lag: the maximum of a parabola over an interval on each side. Its deviation is
    that of the likelihood, which the curve of the significance gives."""
    interval = max(intervals_s[pair.i], intervals_s[pair.j])
    reach = max(round(1.5 * interval * GRID_HZ), 2)
    k = lag - pair.first
    low, high = max(k - reach, 0), min(k + reach + 1, len(pair.r))
    if high - low < 3:
        return None
    k = low + int(np.argmax(pair.r[low:high]))
    half = max(round(interval * GRID_HZ), 2)
    near = np.arange(max(k - half, 0), min(k + half + 1, len(pair.r)))
    curve, slope, _ = np.polyfit(near - k, pair.r[near], 2)
    if curve >= 0 or not pair.z[k] > 0:
        return None
    lag_s = (k + float(np.clip(-slope / (2 * curve), -half, half)) + pair.first) / GRID_HZ
    bend = -2 * curve / pair.r[k] * pair.z[k]
    sigma = common_deviation(pair.z) / float(np.sqrt(pair.z[k] * bend)) / GRID_HZ
    # the middle of the samples that both have
    count_j = 1 - pair.first
    count_i = len(pair.z) + 1 - count_j
    own = (max(0.0, lag_s) + min(count_i / GRID_HZ, lag_s + count_j / GRID_HZ)) / 2
    return Tie(pair.i, pair.j, pair.start_i + own, pair.start_j + own - lag_s, sigma, kind)
