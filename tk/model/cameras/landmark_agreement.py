"""Compares the landmarks of several images: to whom they belong, and whether they confirm a camera.

The landmarks of the other cameras that agree are triangulated. If a camera is right and its landmarks show the same
person, they lie at the projections of these points, up to the network's errors and what these leave open of the points;
else they lie anywhere on a person. The logarithm of the ratio of both likelihoods is the evidence. Wrong masks do not
make the joints of a person agree in all images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.model.body.body_points import LANDMARKS
from tk.model.body.joints import HIPS, SHOULDERS
from tk.model.cameras.camera import Rig
from tk.model.cues.landmarks import deviation, known_landmarks, log_ratio, right_share

Float = NDArray[np.float64]

#: trunks of two people are at least so far apart, metres: the depth of a chest (0.25 m) and an error of a voxel
APART_M = 0.3
#: how far a point may be from where the landmarks leave it open, metres: a person's size
REACH_M = 1.0

_TRUNK = [LANDMARKS.index(name) for name in (*SHOULDERS, *HIPS)]


def evidence_for_cameras(rig: Rig, landmarks: Sequence[Float], turned: Mapping[int, Float] | None = None) -> Float:
    """Return (C,) the logarithm of the likelihood ratio, nats, of each camera being right against being wrong; NaN
    without landmarks of one person in it and in another one.

    A camera is compared with the others that agree; if no two do, with the one that it fits best. One that may be
    turned is compared with those that are not, and its landmarks must be likelier where they are than where they would
    be if it had not been turned: those of a camera that is turned by 3° are still nearer to the projections than other
    points of a person.

    Frames of an opening err alike, so they count as one: the mean over the frames is returned.

    Args:
        rig: C cameras.
        landmarks: (N, C, L, 4) of N people in each of some frames; NaN if unknown.
        turned: of cameras that may be turned the shift (2,), pixels, that undoes it.
    """
    total, count = np.zeros(len(rig)), np.zeros(len(rig))
    for people in landmarks:
        found = np.array([_evidence(rig, seen, turned or {}) for seen in people]).reshape(-1, len(rig))
        known = np.isfinite(found)
        total += np.where(known, found, 0.0).sum(axis=0)
        count += known.any(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _evidence(rig: Rig, seen: Float, turned: Mapping[int, Float]) -> Float:
    """Return :func:`evidence_for_cameras` of landmarks (C, L, 4) of one person in one frame."""
    found = _Pairs.of(_Sets.of(rig, seen)).evidence()
    for c, shift in turned.items():
        cameras = [k for k in range(len(rig)) if k == c or k not in turned]
        back = seen.copy()
        back[c, :, :2] += shift
        beside = Rig(tuple(rig[k] for k in cameras))
        here, there = (
            _Pairs.of(_Sets.of(beside, marked[cameras])).evidence()[cameras.index(c)] for marked in (seen, back)
        )
        found[c] = here - np.fmax(there, 0.0)
    return found


def associated(rig: Rig, landmarks: Float) -> Float:
    """Return landmarks (N, C, L, 4) of N people with each image's sets of landmarks given to the people whom they show.

    A network that is asked for a person behind another one may show the one in front. A set that fits nobody is
    dropped. A person on whom no two other images agree keeps the set, because it cannot be tested.
    """
    result = landmarks.copy()
    people = [_Pairs.of(_Sets.of(rig, seen)) for seen in landmarks]
    for c, camera in enumerate(rig):
        shown = _Sets.of(Rig((camera,) * len(people)), landmarks[:, c]) if people else None
        fit = np.array([pairs.fit_without(c, shown) for pairs in people if shown is not None])
        fit = fit.reshape(len(landmarks), len(landmarks))
        open_to = np.isfinite(fit)
        judged = open_to.any(axis=1)
        free = judged.copy()  # who keeps a set that cannot be tested shares it with nobody
        result[judged, c] = np.nan
        for k in np.argsort(-np.where(open_to, fit, -np.inf), axis=None, kind="stable"):
            person, given = np.unravel_index(k, fit.shape)
            if open_to[person, given] and fit[person, given] > 0 and free[given] and np.isnan(result[person, c]).all():
                result[person, c], free[given] = landmarks[given, c], False
    return result


class Consensus(NamedTuple):
    """What most cameras show of one person: (C,) cameras that agree, the person's points (L, 3) by these cameras,
    metres, NaN if unknown, and the sum of the cameras' logarithms of likelihood ratios, nats."""

    agree: NDArray[np.bool_]
    points: Float
    support: float


def consensus(rig: Rig, seen: Float) -> Consensus:
    """Return the cameras whose landmarks, of (C, L, 4), show one person.

    Each pair of cameras proposes points; those with the highest likelihood in all cameras are the person's, so people
    who stand close together are separated. Without a pair that agrees, no camera is returned.
    """
    return _Pairs.of(_Sets.of(rig, seen)).consensus()


def trunk(points: Float) -> Float:
    """Return (3,) the middle of shoulders and hips of landmarks' points (L, 3), metres; NaN if one is unknown."""
    return np.asarray(points[_TRUNK].mean(axis=0))


def most_likely(rig: Rig, cameras: Sequence[int], seen: Float) -> NDArray[np.int64]:
    """Return the sets of landmarks that show the most likely person, as indices, at most one of each camera; none if no
    two cameras show the same person.

    Any two sets of different cameras propose a person; the best set of each other camera that shows this person
    supports it. People who touch are separated by their limbs, although the middles of their bodies are close in the
    images.

    Args:
        rig: the cameras.
        cameras: (S,) camera of each set.
        seen: (S, L, 4) sets of landmarks; NaN if unknown.
    """
    view = np.asarray(cameras, np.int64)
    found = _Pairs.of(_Sets.of(Rig(tuple(rig[c] for c in view)), seen)) if len(view) else None
    if found is None:
        return view
    apart = view[found.pairs[:, 0]] != view[found.pairs[:, 1]]
    pairs, fit = found.pairs[apart], np.nan_to_num(found.fit[apart])
    # both cameras that propose a person support it by the sets that they propose
    proposing = (np.arange(len(view)) == pairs[..., None]).any(axis=1)
    fit[(view == view[pairs][..., None]).any(axis=1) & ~proposing] = 0.0
    best = np.zeros(fit.shape, np.bool_)
    for own in (np.flatnonzero(view == c) for c in np.unique(view)):
        best[np.arange(len(fit)), own[fit[:, own].argmax(axis=1)]] = True
    best &= fit > 0
    support = np.where(best, fit, 0.0).sum(axis=1) * (best | ~proposing).all(axis=1)
    return np.flatnonzero(best[support.argmax()]) if support.any() else view[:0]


def evidence_of_sets(rig: Rig, cameras: Sequence[int], seen: Float, person: Float) -> Float:
    """Return (S,) the logarithm of the likelihood ratio, nats, of sets of landmarks (S, L, 4) in S cameras showing the
    person whose landmarks (C, L, 4) the C cameras of the rig show; NaN if no two of these agree, or a set is empty."""
    return _Pairs.of(_Sets.of(rig, person)).fit_without(-1, _Sets.of(Rig(tuple(rig[c] for c in cameras)), seen))


class _Sets(NamedTuple):
    """S sets of landmarks, each in an image of its own camera."""

    rotation: Float  # (S, 3, 3) world to camera
    translation: Float  # (S, 3)
    known: NDArray[np.bool_]  # (S, L)
    at: Float  # (S, L, 2) on the plane at distance 1, 0 if unknown
    visibility: Float  # (S, L) 0 if unknown
    information: Float  # (S, L, 3, 3) about the point, across its ray, 1/m²; 0 if unknown
    pull: Float  # (S, L, 3) the same times the camera's centre, 1/m

    @staticmethod
    def of(rig: Rig, seen: Float) -> _Sets:
        """Return the sets (S, L, 4) of S cameras; NaN if unknown."""
        known = known_landmarks(seen)
        at, rays = np.zeros((*known.shape, 2)), np.zeros((*known.shape, 3))
        for k, camera in enumerate(rig):
            at[k, known[k]] = camera.undistort(seen[k, known[k], :2])
            rays[k, known[k]] = camera.rays(seen[k, known[k], :2])
        visibility = np.where(known, seen[..., 2], 0.0)
        weight = np.where(known, deviation(visibility) ** -2, 0.0)[..., None, None]
        information = weight * (np.eye(3) - rays[..., :, None] * rays[..., None, :])
        pull = (information @ rig.centers[:, None, :, None])[..., 0]
        rotation, translation = np.array([c.rotation for c in rig]), np.array([c.translation for c in rig])
        return _Sets(rotation, translation, known, at, visibility, information, pull)

    def of_cameras(self, cameras: Sequence[int] | NDArray[np.int64]) -> _Sets:
        """Return some of the sets."""
        return _Sets(*(values[np.asarray(cameras)] for values in self))

    def showing(self, points: _Points) -> Float:
        """Return the logarithms of the likelihood ratios of the sets showing points, nats; NaN if no point is known.

        Points (..., L, 3) and sets are broadcast against each other.
        """
        p_camera = np.einsum("...ij,...lj->...li", self.rotation, points.at) + self.translation[..., None, :]
        depth = p_camera[..., 2]
        known = self.known & np.isfinite(depth)
        away = np.where((known & (depth > 0))[..., None], self.at * depth[..., None] - p_camera[..., :2], np.inf)
        # rows of the derivative of the position across the camera's axis by the point
        P = self.rotation[..., None, :2, :] - self.at[..., :, None] * self.rotation[..., None, 2:, :]
        spread = P @ points.covariance @ P.swapaxes(-1, -2)
        ratio = log_ratio(away, np.broadcast_to(self.visibility, known.shape), spread, points.right)
        return np.where(known.any(axis=-1), np.where(known, ratio, 0.0).sum(axis=-1), np.nan)


class _Points(NamedTuple):
    """Points of a person by the landmarks of some cameras: (..., L, 3), metres, NaN if unknown, (..., L, 3, 3)
    covariance, and (..., L) the probability that all these landmarks are right."""

    at: Float
    covariance: Float
    right: Float

    @staticmethod
    def of(sets: _Sets, near: Float | None = None) -> _Points:
        """Triangulate sets (..., S) by least squares. What they leave open, such as the depth between two cameras that
        face each other, lies within :data:`REACH_M` of ``near`` (..., L, 3); None: of the solution."""
        information, pull = sets.information.sum(axis=-4), sets.pull.sum(axis=-3)
        number = np.count_nonzero(sets.known, axis=-2)
        right = np.where(sets.known, right_share(sets.visibility), 1.0).prod(axis=-2)
        if near is None:
            near = np.where((number > 1)[..., None], (np.linalg.pinv(information) @ pull[..., None])[..., 0], np.nan)
        covariance = np.asarray(np.linalg.inv(information + np.eye(3) / REACH_M**2))
        at = (covariance @ (pull + near / REACH_M**2)[..., None])[..., 0]
        return _Points(np.where((number > 0)[..., None], at, np.nan), covariance, right)


class _Pairs(NamedTuple):
    """What each pair of cameras shows of one person."""

    sets: _Sets  # of the C cameras
    pairs: NDArray[np.int64]  # (P, 2) cameras
    points: Float  # (P, L, 3) metres
    fit: Float  # (P, C) logarithm of each camera's likelihood ratio, nats; NaN without landmarks

    @staticmethod
    def of(sets: _Sets) -> _Pairs:
        """Compare all pairs of the cameras that have landmarks."""
        pairs = np.array(list(combinations(np.flatnonzero(sets.known.any(axis=1)).tolist(), 2)), np.int64).reshape(
            -1, 2
        )
        both = _Points.of(sets.of_cameras(pairs))
        beside = _Points(both.at[:, None], both.covariance[:, None], both.right[:, None])
        fit = sets.showing(beside)
        for own, other in (pairs.T, pairs.T[::-1]):  # each camera is compared with the other alone
            alone = _Points.of(sets.of_cameras(other[:, None]), both.at)
            fit[np.arange(len(pairs)), own] = sets.of_cameras(own).showing(alone)
        return _Pairs(sets, pairs, both.at, fit)

    def agreeing(self, but: int = -1) -> tuple[NDArray[np.bool_], float]:
        """Return :attr:`Consensus.agree` and :attr:`Consensus.support`, those of camera ``but`` left out."""
        fit = np.where((np.arange(len(self.sets.known)) == but) | np.isnan(self.fit), 0.0, self.fit)
        support = np.maximum(fit, 0.0).sum(axis=1)
        support[(np.take_along_axis(fit, self.pairs, axis=1) <= 0).any(axis=1)] = 0.0
        if not (support > 0).any():
            return np.zeros(len(self.sets.known), np.bool_), 0.0
        best = int(np.argmax(support))
        return fit[best] > 0, float(support[best])

    def points_of(self, agree: NDArray[np.bool_]) -> _Points:
        """Return the person's points by some cameras (C,)."""
        return _Points.of(self.sets.of_cameras(np.flatnonzero(agree)))

    def consensus(self) -> Consensus:
        """Return what most cameras show."""
        agree, support = self.agreeing()
        unknown = np.full((self.sets.known.shape[1], 3), np.nan)
        return Consensus(agree, self.points_of(agree).at if agree.any() else unknown, support)

    def evidence(self) -> Float:
        """Return (C,) the logarithm of each camera's likelihood ratio by the others; NaN without another one."""
        found = np.full(len(self.sets.known), np.nan)
        for c in range(len(found)):
            found[c] = self.fit_without(c, self.sets.of_cameras([c]))[0]
            if np.isnan(found[c]) and (beside := self.fit[(self.pairs == c).any(axis=1), c]).size:
                found[c] = np.fmax.reduce(beside)
        return found

    def fit_without(self, but: int, shown: _Sets) -> Float:
        """Return (N,) the logarithm of the likelihood ratio of each of N sets in camera ``but`` showing the person whom
        the others see; NaN if no two others agree, or a set is empty."""
        agree, _ = self.agreeing(but)
        return shown.showing(self.points_of(agree)) if agree.any() else np.full(len(shown.known), np.nan)
