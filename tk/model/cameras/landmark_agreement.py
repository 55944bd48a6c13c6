"""Compares the landmarks of several images: to whom they belong, and whether they confirm a camera.

The landmarks of the other cameras that agree are triangulated. If a camera is right and its landmarks show the same
person, they lie at the projections of these points, up to the network's errors and what these leave open of the points;
else they lie anywhere on a person. The logarithm of the ratio of both likelihoods is the evidence. Wrong masks do not
make the joints of a person agree in all images.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Camera, Rig
from tk.model.cues.landmarks import deviation, log_ratio, right_share

Float = NDArray[np.float64]

#: how far a point may be from where the landmarks leave it open, metres: a person's size
REACH_M = 1.0


def evidence_for_cameras(rig: Rig, landmarks: Sequence[Float]) -> Float:
    """Return (C,) the logarithm of the likelihood ratio, nats, of each camera being right against being wrong; NaN
    without landmarks of one person in it, and in two others that agree.

    Frames of an opening err alike, so they count as one: the mean over the frames is returned.

    Args:
        rig: C cameras.
        landmarks: (N, C, L, 3) of N people in each of some frames: x, y, pixels, and visibility; NaN if unknown.
    """
    total, count = np.zeros(len(rig)), np.zeros(len(rig))
    for people in landmarks:
        found = np.array([[_fits(rig, seen, c, seen[c : c + 1])[0] for c in range(len(rig))] for seen in people])
        known = np.isfinite(found)
        total += np.where(known, found, 0.0).sum(axis=0)
        count += known.any(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def associated(rig: Rig, landmarks: Float) -> Float:
    """Return landmarks (N, C, L, 3) of N people with each image's sets of landmarks given to the people whom they show.

    A network that is asked for a person behind another one may show the one in front. A set that fits nobody is
    dropped. A person on whom no two other images agree keeps the set, because it cannot be tested.
    """
    result = landmarks.copy()
    for c in range(len(rig)):
        fit = np.array([_fits(rig, seen, c, landmarks[:, c]) for seen in landmarks])
        fit = fit.reshape(len(landmarks), len(landmarks))
        free = np.ones(len(landmarks), np.bool_)
        open_to = np.isfinite(fit)
        judged = open_to.any(axis=1)
        result[judged, c] = np.nan
        for k in np.argsort(-np.where(open_to, fit, -np.inf), axis=None, kind="stable"):
            person, given = np.unravel_index(k, fit.shape)
            if open_to[person, given] and fit[person, given] > 0 and free[given] and np.isnan(result[person, c]).all():
                result[person, c], free[given] = landmarks[given, c], False
    return result


class Consensus(NamedTuple):
    """What most cameras show of one person: (C,) cameras that agree, the person's points (L, 3), metres, NaN if
    unknown, and the sum of the cameras' logarithms of likelihood ratios, nats."""

    agree: NDArray[np.bool_]
    points: Float
    support: float


def consensus(rig: Rig, seen: Float) -> Consensus:
    """Return the cameras whose landmarks, of (C, L, 3), show one person.

    Each pair of cameras proposes points; those with the highest likelihood in all cameras are the person's, so people
    who stand close together are separated. Without a pair that agrees, no camera is returned.
    """
    C, L = seen.shape[:2]
    known = np.flatnonzero(np.isfinite(seen[..., 0]).any(axis=1))
    best = Consensus(np.zeros(C, np.bool_), np.full((L, 3), np.nan), 0.0)
    for a, b in combinations(known.tolist(), 2):
        both = _points(rig, seen, (a, b))
        fit = np.array([_fit_of_points(rig[c], seen[c], both) if c in known else np.nan for c in range(C)])
        for own, other in ((a, b), (b, a)):
            fit[own] = _fit_of_points(rig[own], seen[own], _points(rig, seen, (other,), both.at))
        support = float(np.where(fit > 0, fit, 0.0).sum())
        if fit[a] > 0 and fit[b] > 0 and support > best.support:
            best = Consensus(fit > 0, both.at, support)
    return best


def _fits(rig: Rig, seen: Float, c: int, sets: Float) -> Float:
    """Return (N,) the logarithm of the likelihood ratio of each of N sets of landmarks (N, L, 3) in camera c showing
    the person whose landmarks (C, L, 3) the others see; NaN if no two others agree, or a set is empty."""
    others = seen.copy()
    others[c] = np.nan
    agree = consensus(rig, others).agree
    if not agree.any() or not np.isfinite(sets[..., 0]).any():
        return np.full(len(sets), np.nan)
    points = _points(rig, others, np.flatnonzero(agree).tolist())
    return np.array([_fit_of_points(rig[c], own, points) for own in sets])


class _Points(NamedTuple):
    """Points of a person by the landmarks of some cameras: (L, 3), metres, NaN if unknown, (L, 3, 3) covariance, and
    (L,) the probability that all these landmarks are right."""

    at: Float
    covariance: Float
    right: Float


def _points(rig: Rig, seen: Float, cameras: Sequence[int], near: Float | None = None) -> _Points:
    """Triangulate the landmarks (C, L, 3) of some cameras by least squares. What they leave open, such as the depth
    between two cameras that face each other, lies within :data:`REACH_M` of ``near`` (L, 3); None: of the solution."""
    L = seen.shape[1]
    information, pull, known = np.zeros((L, 3, 3)), np.zeros((L, 3)), np.zeros(L, np.int64)
    right = np.ones(L)
    for c in cameras:
        own = np.isfinite(seen[c]).all(axis=1)
        rays = rig[c].rays(seen[c, own, :2])
        across = (np.eye(3) - rays[:, :, None] * rays[:, None, :]) / deviation(seen[c, own, 2])[:, None, None] ** 2
        information[own] += across
        pull[own] += across @ rig[c].center
        known[own] += 1
        right[own] *= right_share(seen[c, own, 2])
    if near is None:
        near = np.full((L, 3), np.nan)
        near[known > 1] = (np.linalg.pinv(information[known > 1]) @ pull[known > 1, :, None])[..., 0]
    covariance = np.asarray(np.linalg.inv(information + np.eye(3) / REACH_M**2))
    at = (covariance @ (pull + near / REACH_M**2)[..., None])[..., 0]
    return _Points(np.where((known > 0)[:, None], at, np.nan), covariance, right)


def _fit_of_points(camera: Camera, own: Float, points: _Points) -> float:
    """Return the logarithm of the likelihood ratio of landmarks (L, 3) in a camera showing points, nats; NaN if no
    point is known."""
    known = np.isfinite(own).all(axis=1) & np.isfinite(points.at).all(axis=1)
    if not known.any():
        return np.nan
    ray = camera.undistort(own[known, :2])
    p_camera = points.at[known] @ camera.rotation.T + camera.translation
    depth = p_camera[:, 2]
    away = ray * depth[:, None] - p_camera[:, :2]
    # rows of the derivative of the position across the camera's axis by the point
    P = camera.rotation[:2] - ray[:, :, None] * camera.rotation[2]
    spread = P @ points.covariance[known] @ P.swapaxes(1, 2)
    return log_ratio(np.where(depth[:, None] > 0, away, np.inf), own[known, 2], spread, points.right[known])
