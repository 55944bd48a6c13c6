"""Triangulates points from a few views with outliers: consensus of pairs of cameras, then weighted DLT.

Hartley & Zisserman, *Multiple View Geometry* (2nd ed., 2004), section 12.2 (linear triangulation); RANSAC (Fischler &
Bolles 1981) with all pairs of cameras instead of random ones, because a rig has few.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Rig

Float = NDArray[np.float64]

# Joints with less confidence than this are ignored: Pose2Sim's default.
LEAST_CONFIDENCE = 0.3
# Largest reprojection error, as a share of the person's larger side in the image. Human annotators of joints err by
# 3 to 5 % of the square root of the person's area (Ronchi & Perona, ICCV 2017, of COCO), about 2 to 3 % of the larger
# side; this is twice as much.
GATE = 0.05
# Rays that meet at a smaller angle do not determine the depth, degrees: an error of 1 px of 500 is 3 % of the distance.
_LEAST_ANGLE_DEG = 4.0


class _Triangulator:
    """The cameras of a rig, for observations without lens distortion."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.projections = np.array([np.column_stack([c.rotation, c.translation]) for c in rig])  # (C, 3, 4)
        self.focal_px = np.array([np.sqrt(abs(np.linalg.det(c.matrix[:2, :2]))) for c in rig])
        self.centers = rig.centers

    def normalised(self, camera: int, pixels: Float) -> Float:
        """Return normalised coordinates (N, 2) of pixels (N, 2), some NaN."""
        result = np.full((len(pixels), 2), np.nan)
        seen = np.isfinite(pixels).all(axis=1)
        result[seen] = self.rig[camera].undistort(pixels[seen])
        return result

    def errors_px(self, points: Float, camera: int, seen: Float) -> Float:
        """Return (N,) reprojection errors, pixels, of points (N, 3) and normalised observations (N, 2); inf if either
        is unknown or the point lies behind the camera."""
        q = points @ self.projections[camera, :, :3].T + self.projections[camera, :, 3]
        with np.errstate(invalid="ignore", divide="ignore"):
            error = self.focal_px[camera] * np.linalg.norm(q[:, :2] / q[:, 2:] - seen, axis=1)
            return np.where((q[:, 2] > 0) & np.isfinite(error), error, np.inf)

    def triangulate(self, seen: Float, weight: Float) -> Float:
        """Return points (N, 3) of normalised observations (C, N, 2) with weights (C, N); NaN with fewer than two."""
        known = (weight > 0) & np.isfinite(seen).all(axis=2)
        w = np.where(known, weight, 0.0)[..., None, None]
        xy = np.where(known[..., None], seen, 0.0)
        rows = xy[..., None] * self.projections[:, None, 2:3] - self.projections[:, None, :2]  # (C, N, 2, 4)
        A = np.moveaxis(w * rows, 0, 1).reshape(seen.shape[1], -1, 4)
        X = np.linalg.svd(A)[2][:, -1]
        with np.errstate(invalid="ignore", divide="ignore"):
            points = X[:, :3] / X[:, 3:]
        good = (known.sum(axis=0) >= 2) & np.isfinite(points).all(axis=1)
        return np.where(good[:, None], points, np.nan)

    def angle_deg(self, points: Float, a: int, b: int) -> Float:
        """Return (N,) the angles between the rays from two cameras to points (N, 3), degrees."""
        to = [points - self.centers[c] for c in (a, b)]
        to = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in to]
        angle: Float = np.degrees(np.arccos(np.clip((to[0] * to[1]).sum(axis=1), -1, 1)))
        return angle


def triangulate_joints(rig: Rig, joints: Float) -> tuple[Float, NDArray[np.bool_]]:
    """Triangulate joints that several cameras see, and find the cameras that agree.

    Args:
        rig: C cameras.
        joints: (..., C, J, 3 or more) pixels x, y and confidence of one person, in one frame or in several; NaN where a
            joint is not visible. Further columns do not count.

    Returns:
        Points (..., J, 3), metres, NaN where no two cameras agree; and (..., C, J) bool, the inliers.
    """
    rays, (*frames, C, count) = _Triangulator(rig), joints.shape[:-1]
    each = joints[..., :3].reshape(-1, C, count, 3)  # (F, C, J, 3)
    gate = np.repeat([[_gate_px(each[f, c]) for f in range(len(each))] for c in range(C)], count, axis=1)  # (C, F J)
    every = each.swapaxes(0, 1).reshape(C, -1, 3)
    J = every.shape[1]
    seen = np.stack([rays.normalised(c, every[c, :, :2]) for c in range(C)])
    weight = _weights(every)
    best, agreeing = np.full(J, -np.inf), np.zeros((C, J), bool)
    for a, b in combinations(range(C), 2):
        pair = np.zeros((C, J))
        pair[[a, b]] = weight[[a, b]]
        points = rays.triangulate(seen, pair)
        errors = np.stack([rays.errors_px(points, c, seen[c]) for c in range(C)])
        inside = (errors < gate) & (weight > 0)
        with np.errstate(invalid="ignore"):
            valid = inside[a] & inside[b] & (rays.angle_deg(points, a, b) > _LEAST_ANGLE_DEG)
        support = _support(errors, gate, weight).sum(axis=0)
        better = valid & (support > best)
        best[better], agreeing[:, better] = support[better], inside[:, better]
    points = rays.triangulate(seen, np.where(agreeing, weight, 0.0))
    agreeing = agreeing.reshape(C, -1, count).swapaxes(0, 1)
    return points.reshape(*frames, count, 3), agreeing.reshape(*frames, C, count)


def same_person(rig: Rig, people: Sequence[Float], inside: tuple[Float, Float]) -> Float:
    """Choose, among the people detected in each image, the best visible person.

    Each pair of people in two images is a hypothesis: it is triangulated and compared with the people of all images.

    Args:
        rig: C cameras.
        people: of each camera (P, J, 3), pixels x, y and confidence; NaN where a joint is not visible; P may be 0.
        inside: lower and upper corner (3,) of the box, metres, that contains the median of the person's joints.

    Returns:
        (C, J, 3) the person in each camera, NaN in cameras without the person; all NaN if fewer than two show one.
    """
    rays = _Triangulator(rig)
    C = len(rig)
    J = max((person.shape[1] for person in people), default=0)
    seen = [
        rays.normalised(c, p[:, :, :2].reshape(-1, 2)).reshape(len(p), J, 2) if len(p) else np.zeros((0, J, 2))
        for c, p in enumerate(people)
    ]
    weights = [_weights(p) for p in people]
    gates = [np.array([_gate_px(person) for person in p]) for p in people]
    best, chosen = 0.0, [-1] * C
    for a, b in combinations(range(C), 2):
        for i, j in ((i, j) for i in range(len(seen[a])) for j in range(len(seen[b]))):
            pair, weight = np.full((C, J, 2), np.nan), np.zeros((C, J))
            pair[a], pair[b], weight[a], weight[b] = seen[a][i], seen[b][j], weights[a][i], weights[b][j]
            points = rays.triangulate(pair, weight)
            placed = np.isfinite(points).all(axis=1)
            middle = np.median(points[placed], axis=0) if placed.any() else np.full(3, np.nan)
            if not ((inside[0] <= middle) & (middle <= inside[1])).all():
                continue
            total, found = 0.0, [-1] * C
            for c in range(C):
                if not len(seen[c]):
                    continue
                supports = [
                    _support(rays.errors_px(points, c, xy), gate, w).sum()
                    for xy, w, gate in zip(seen[c], weights[c], gates[c], strict=True)
                ]
                k = int(np.argmax(supports))
                if supports[k] > 0:
                    total, found[c] = total + float(supports[k]), k
            if total > best and found[a] == i and found[b] == j:
                best, chosen = total, found
    result = np.full((C, J, 3), np.nan)
    for c, k in enumerate(chosen):
        if k >= 0:
            result[c] = people[c][k]
    return result


def _support(errors: Float, gate: Float, weight: Float) -> Float:
    """Return the support of observations for points by their reprojection errors (MSAC: Torr & Zisserman, CVIU 2000).

    It is the weight at an error of 0 and falls with the error's square to 0 at the gate.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(errors < gate, weight * (1.0 - (errors / gate) ** 2), 0.0)


def _weights(joints: Float) -> Float:
    """Return (..., J) confidences of at least :data:`LEAST_CONFIDENCE`, 0 elsewhere."""
    confidence = np.where(np.isfinite(joints).all(axis=-1), joints[..., 2], 0.0)
    return np.where(confidence >= LEAST_CONFIDENCE, np.minimum(confidence, 1.0), 0.0)


def _gate_px(person: Float) -> float:
    """Return the largest reprojection error of an inlier of a person (J, 3), pixels."""
    confident = person[_weights(person) > 0, :2]
    return GATE * float(np.ptp(confident, axis=0).max()) if len(confident) else 0.0
