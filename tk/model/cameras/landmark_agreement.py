"""Compares the landmarks of several images: to whom they belong, and whether they confirm a camera.

The landmarks of the other cameras are triangulated, by consensus. If a camera is right and its landmarks show the same
person, they lie at the projections of these points, up to the network's errors; else they lie anywhere on a person. The
logarithm of the ratio of both likelihoods is the evidence. Wrong masks do not make the joints of a person agree in all
images.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.triangulation import triangulate_joints
from tk.model.cues.landmarks import log_ratio

Float = NDArray[np.float64]


def evidence_for_cameras(rig: Rig, landmarks: Sequence[Float]) -> Float:
    """Return (C,) the logarithm of the likelihood ratio, nats, of each camera being right against being wrong; NaN
    without landmarks of one person in it and in two others.

    Frames of an opening err alike, so they count as one: the mean over the frames is returned.

    Args:
        rig: C cameras.
        landmarks: (N, C, L, 3) of N people in each of some frames: x, y, pixels, and visibility; NaN if unknown.
    """
    total, count = np.zeros(len(rig)), np.zeros(len(rig))
    for people in landmarks:
        found = np.array([[_fit(rig, seen, c, seen[c]) for c in range(len(rig))] for seen in people])
        known = np.isfinite(found)
        total += np.where(known, found, 0.0).sum(axis=0)
        count += known.any(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def associated(rig: Rig, landmarks: Float) -> Float:
    """Return landmarks (N, C, L, 3) of N people with each image's sets of landmarks given to the people whom they show.

    A network that is asked for a person behind another one may show the one in front. A set that fits nobody is
    dropped. A person whom fewer than two other images show keeps the set, because it cannot be tested.
    """
    result = landmarks.copy()
    for c in range(len(rig)):
        fit = np.array([[_fit(rig, seen, c, other[c]) for other in landmarks] for seen in landmarks])
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


def consensus(rig: Rig, seen: Float) -> tuple[NDArray[np.bool_], Float]:
    """Return (C,) the cameras whose landmarks, of (C, L, 3), show one person, and that person's points (L, 3), metres.

    Each pair of cameras proposes points; those with the highest likelihood in all cameras are the person's, so people
    who stand close together are separated. Without a pair that agrees, no camera is returned.
    """
    C, L = seen.shape[:2]
    known = np.flatnonzero(np.isfinite(seen[..., 0]).any(axis=1))
    best, agree, found = 0.0, np.zeros(C, np.bool_), np.full((L, 3), np.nan)
    for a, b in combinations(known.tolist(), 2):
        pair = np.full(seen.shape, np.nan)
        pair[[a, b]] = seen[[a, b]]
        points, _ = triangulate_joints(rig, pair)
        fit = np.array([_fit_of_points(rig[c], seen[c], points) if c in known else np.nan for c in range(C)])
        support = np.where(fit > 0, fit, 0.0).sum()
        if fit[a] > 0 and fit[b] > 0 and support > best:
            best, agree, found = support, fit > 0, points
    return agree, found


def _fit(rig: Rig, seen: Float, c: int, own: Float) -> float:
    """Return the logarithm of the likelihood ratio of landmarks (L, 3) in camera c showing the person whose landmarks
    (C, L, 3) the others see; NaN if fewer than two others see them."""
    others = seen.copy()
    others[c] = np.nan
    known = np.isfinite(own).all(axis=1)
    if np.count_nonzero(np.isfinite(others[..., 0]).any(axis=1)) < 2 or not known.any():
        return np.nan
    return _fit_of_points(rig[c], own, triangulate_joints(rig, others)[0])


def _fit_of_points(camera: Camera, own: Float, points: Float) -> float:
    """Return the logarithm of the likelihood ratio of landmarks (L, 3) in a camera showing points (L, 3), nats; NaN if
    no point is known."""
    known = np.isfinite(own).all(axis=1) & np.isfinite(points).all(axis=1)
    if not known.any():
        return np.nan
    pixels, depth = camera.project(points[known])
    away = (own[known, :2] - pixels) * (depth / np.sqrt(np.linalg.det(camera.matrix[:2, :2])))[:, None]
    return log_ratio(np.linalg.norm(away, axis=1), own[known, 2])
