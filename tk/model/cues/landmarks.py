"""Landmarks: points of the body that a segmenter's network sees in single images, as a term of the cost.

Silhouettes hardly show which way a person faces, which of two crossing legs is the left one, or where an arm in front
of the trunk is. Networks that were trained on photographs see it, to some centimetres.

The error of a landmark in one image is a mixture. With a probability that grows with the visibility that the network
reports, it is normal; its standard deviation falls with the visibility and is proportional to the person's size. Else
the landmark is anywhere on the person. Networks exchange left and right, for the upper or for the lower body: in each
image and for either half the likelihood is a mixture of both assignments. Besides, each landmark has an offset to the
body's point, the same in all images of a frame. It is unknown, with a normal prior; it is integrated out.

A network may also estimate depth, along the line of sight. The silhouette of a forearm that points at a camera says
little; the depth says where it points. The depths of one image are compared by bone, between its two ends, because
their errors grow with the distance from the hips.

An angle that only landmarks show, the head's turn, has a normal prior about zero here. Contours do not move it: without
landmarks it stays as it is.
"""

from __future__ import annotations

from copy import copy
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.cone_arrays import NEAREST_M
from tk.kernels.landmark_terms import LandmarkArrays, landmark_costs, landmark_information
from tk.kernels.mask_values import PERSON
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.body_points import LANDMARKS, POINTS, SEGMENT
from tk.model.body.cone_body import ConeBody, build_cone_body
from tk.model.body.initial_pose import GREATEST_STATURE, LEAST_STATURE, resting_figures
from tk.model.body.joints import HIPS, JOINTS, SHOULDERS, side_of
from tk.model.cameras.camera import Rig
from tk.model.cameras.triangulation import triangulate_joints
from tk.model.setup import AVERAGE_STATURE_M
from tk.optim.quadratic import Quadratic

Float = NDArray[np.float64]

NAME = "landmarks"  #: of the cue
# Standard deviation of a landmark in an image, metres along each axis at the person's distance, for a person of average
# stature: SEEN_M with visibility 1, HIDDEN times as much with visibility 0; and the share of landmarks that are right.
SEEN_M, HIDDEN, RIGHT_SEEN, RIGHT_HIDDEN = 0.023, 4.0, 0.95, 0.5
# Depth between the ends of a bone, as a network estimates it: it keeps this share of the depth (of shoulders and hips;
# of the limbs' bones), because a cautious estimate is too near to the mean. Standard deviation, metres, at a visibility
# of 1, and how many times as much at a visibility of 0.
DEPTH_SHARE, DEPTH_M, DEPTH_HIDDEN = (0.9, 0.6), 0.055, 1.8
# Density of a wrong landmark, 1/m²: it lies anywhere on a standing person; and of a wrong depth, 1/m.
WRONG_DENSITY = 2.0
# The next two are assumed; neither they nor INDEPENDENT have been calibrated by the share of right choices yet.
# Probability that a network exchanges left and right of one half of the body in an image.
EXCHANGED = 0.05
# Probability that all landmarks of an image are wrong: the network shows somebody else.
ELSEWHERE = 0.02
# Standard deviation of a landmark's offset from the body's point along each axis, metres: medians of recordings differ
# by so much, see tk.model.body.body_points.
OFFSET_M = 0.02
# Least visibility of landmarks whose box is compared with the box of a mask, and least overlap of both boxes.
LEAST_VISIBLE, LEAST_OVERLAP = 0.2, 0.2
# Factors of the standard deviations with which a proposal minimises the landmarks' cost: a pose that is far away is
# attracted, too. Steps with each. Largest change of an angle in a step, radians.
WIDENED, STEPS, LONGEST_STEP = (16.0, 8.0, 4.0, 2.0, 1.0), 3, 0.6
# Share of each diagonal element that is added to it at first, and the factor by which the share then changes.
DAMPING, DAMPING_CHANGE = 0.01, 5.0
# Statures from which the most likely one is searched for: 32 % apart, a pose that fits one is near that of its
# neighbours.
STATURES = 5
# Weight of the landmarks in the contours' equations of a frame, see tk.model.cues.cue.
WEIGHT = 5.0
# Share of the landmarks' likelihood that counts: a network's errors in neighbouring landmarks go together.
INDEPENDENT = 0.5

_OTHER_SIDE = {"_l": "_r", "_r": "_l", "": ""}
_PARTNER = np.array([LANDMARKS.index(n.removesuffix(side_of(n)) + _OTHER_SIDE[side_of(n)]) for n in LANDMARKS])
_LOWER = np.array([name[:-2] in ("hip", "knee", "ankle", "heel", "toe") for name in LANDMARKS])
# Bones whose depth counts: the landmarks at their ends (K, 2).
_BONES = [("shoulder_l", "shoulder_r"), ("hip_l", "hip_r")] + [
    (parent + side, child + side)
    for parent, child in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
    for side in ("_l", "_r")
]
_FROM, _TO = np.array([[LANDMARKS.index(name) for name in bone] for bone in _BONES]).T
_HALF = np.concatenate([_LOWER, _LOWER[_FROM]]).astype(np.int32)  # (L + K,) 0 the upper one
_ACROSS = 2  # of them, first, across the trunk
_SHARE = np.where(np.arange(len(_BONES)) < _ACROSS, *DEPTH_SHARE)  # (K,)
# (L + K, L) the landmarks and their bones as sums of landmarks; (L + K, L L) the products of these sums' factors.
_PLACES = np.eye(len(LANDMARKS))
_PLACES = np.concatenate([_PLACES, _SHARE[:, None] * (_PLACES[_TO] - _PLACES[_FROM])])
_PAIRS = (_PLACES[:, :, None] * _PLACES[:, None, :]).reshape(len(_PLACES), -1)
# The landmarks that show each joint.
_FACE = tuple(name for name in LANDMARKS if POINTS[name].segment == "head")
_MIDDLE = {"pelvis": HIPS, "neck": SHOULDERS, "head_top": _FACE}
_MARKED = {joint: [LANDMARKS.index(name) for name in _MIDDLE.get(joint, (joint,))] for joint in JOINTS}


class LandmarkRows(NamedTuple):
    """Information of the landmarks about N = L + K places, the body's points and its bones, at B poses, with the
    landmarks' offsets integrated out."""

    information: Float  # (B, 3, 3, N) 1/m²
    pull: Float  # (B, 3, N) the same times the distance to the landmarks, 1/m
    jacobian: Float  # (B, L, 3, D) derivatives of the points by the pose

    def normal_equations(self, jacobian: Float) -> tuple[Float, Float]:
        """Return JᵀWJ (B, K, K) and JᵀW times the distances (B, K) of unknowns with derivatives (B, L, 3, K)."""
        B, L, _, K = jacobian.shape
        rows = jacobian.transpose(0, 3, 2, 1).reshape(B, K, 3 * L)
        # a bone joins two points
        matrix = (self.information.reshape(9 * B, -1) @ _PAIRS).reshape(B, 3, 3, L, L)
        matrix = matrix.swapaxes(2, 3).reshape(B, 3 * L, 3 * L)
        return rows @ (matrix @ rows.swapaxes(1, 2)), (rows @ (self.pull @ _PLACES).reshape(B, 3 * L, 1))[..., 0]


class LandmarkCue:
    """The landmarks of one person in the V images of a frame, or of F frames: a :class:`~tk.model.cues.cue.Cue`.

    Args:
        rig: the cameras.
        body: the person's body.
        seen: (V, L, 4) or (F, V, L, 4), x, y, pixels, visibility, and depth, metres behind the middle of the hips; NaN
            if unknown. Of F frames: as many as poses.
        size: of the person whom the network sees, relative to the average person: its depths and errors are
            proportional to it; None: of the body.
    """

    weight = WEIGHT

    def __init__(self, rig: Rig, body: ConeBody, seen: Float, size: float | None = None) -> None:
        self._rig, self.body, self._seen = rig, body, seen
        self._elsewhere, self._precision = ELSEWHERE, 1.0
        self._size = size = size or body.dimensions.stature / AVERAGE_STATURE_M
        frames = seen.reshape(-1, *seen.shape[-3:])  # (F, V, L, 4)
        known = known_landmarks(frames)
        at = np.where(known[..., None], _normalised(rig, frames)[..., :2], 0.0)
        visibility = np.where(known, frames[..., 2], 0.0)
        sigma, right = SEEN_M * size * HIDDEN ** (1.0 - visibility), np.where(known, right_share(visibility), 0.0)
        marks = np.concatenate([at, np.stack([right, sigma**-2], axis=-1)], axis=-1)
        # what is hidden in the images is guessed in all of them alike
        mean = visibility.sum(axis=1) / np.maximum(np.count_nonzero(known, axis=1), 1)  # (F, L)
        offset = (OFFSET_M * size * HIDDEN ** (1.0 - mean)) ** 2
        values = (
            body.skeleton.tree,
            body.marked,
            np.column_stack([_FROM, _TO, _SHARE]),
            _HALF,
            _cameras(rig, at, visibility),
            np.stack([marks, marks[..., _PARTNER, :]], axis=2),
            _depths(np.where(known, frames[..., 3], np.nan), visibility, size),
            np.concatenate([offset, _SHARE**2 * (offset[:, _FROM] + offset[:, _TO])], axis=1),
        )
        self._arrays = LandmarkArrays._make(map(np.ascontiguousarray, values))
        # (D,) or (F, D) precision of the angles that only landmarks show, where there are any
        shown = known.any(axis=(1, 2)).reshape(seen.shape[:-3])
        self._prior = shown[..., None] * body.skeleton.by_landmarks**-2.0

    def widened(self, factor: float) -> LandmarkCue:
        """Return the cue with standard deviations times a factor; if it exceeds 1, all images show the person."""
        result = copy(self)
        result._elsewhere = ELSEWHERE if factor == 1.0 else 0.0
        result._precision = factor**-2
        return result

    @property
    def _numbers(self) -> Float:
        """The model's numbers for the kernel."""
        return _numbers(self._elsewhere, self._precision)

    def normal(self, poses: Float) -> Quadratic:
        """Return the negative logarithm of the likelihood, and of the prior of the angles that only landmarks show, as
        a quadratic about each of the poses (B, D), nats."""
        rows = self.rows(poses)
        matrix, gradient = rows.normal_equations(rows.jacobian)
        prior = self._prior[..., None] * np.eye(poses.shape[-1])  # about zero
        return Quadratic(gradient + (matrix @ poses[..., None])[..., 0], matrix + prior)

    def rows(self, poses: Float) -> LandmarkRows:
        """Return the information of the landmarks about the body's points at poses (B, D)."""
        return LandmarkRows(*landmark_information(self._arrays, self._numbers, poses))

    def cost(self, poses: Float) -> Float:
        """Return (B,) the negative logarithm of the landmarks' likelihood at poses (B, D), nats, up to a
        constant of the frame.

        The offsets are integrated out by Laplace's method, about the offsets that one step of Newton's gives. They
        explain what all images have in common; a landmark far off in one image is not explained by them.
        """
        cost = landmark_costs(self._arrays, self._numbers, poses)
        return np.asarray(cost + 0.5 * (self._prior * poses**2).sum(axis=-1))

    def variance(self, poses: Float) -> Float:
        """Return (B, J) variance of the joints' positions along an axis, metres², from the distances between poses
        (B, D) and the triangulated landmarks, beyond the landmarks' own errors.

        Pose or landmark may be right, so half of the squared distance counts. Neck and pelvis have the mean of
        shoulders and hips, the crown that of the face.
        """
        x = points(self.body, poses)
        each = np.broadcast_to(self._seen, (len(poses), *self._seen.shape[-3:]))
        known, found = known_landmarks(each), np.full(x.shape, np.nan)
        if (some := np.flatnonzero(known.any(axis=(1, 2)))).size:
            found[some] = triangulate_joints(self._rig, each[some])[0]
        square = ((x - found) ** 2).sum(axis=-1)
        visibility = np.where(known, each[..., 2], 0.0).sum(axis=-2) / np.maximum(known.sum(axis=-2), 1)
        expected = 3 * (deviation(visibility) * self._size) ** 2
        excess = right_share(visibility) * np.maximum(np.where(np.isfinite(square), square, 0.0) - expected, 0.0) / 6
        return np.stack([excess[:, rows].mean(axis=1) for rows in _MARKED.values()], axis=1)


@cache
def _numbers(elsewhere: float, precision: float) -> Float:
    """Return the model's numbers in the order of :data:`tk.kernels.landmark_terms.WRONG` and those after it."""
    other = np.log(elsewhere) if elsewhere else -np.inf
    shown = np.log(1 - ELSEWHERE)
    return np.array([WRONG_DENSITY, EXCHANGED, shown, other, precision, INDEPENDENT, NEAREST_M, 2 * np.pi])


def _cameras(rig: Rig, at: Float, visibility: Float) -> Float:
    """Return (F, V, 15) transforms (3, 4) from the world to each camera, and directions from it to the person, whose
    landmarks are at (F, V, L, 2) on the plane at distance 1."""
    rotation = np.array([c.rotation for c in rig])
    world = np.concatenate([rotation, np.array([c.translation for c in rig])[..., None]], axis=2).reshape(-1, 12)
    weight = visibility[..., None]
    ahead = np.concatenate([(weight * at).sum(axis=2), weight.sum(axis=2)], axis=2)
    ahead = np.where(ahead[..., 2:] > 0, ahead, [0.0, 0.0, 1.0])
    sight = np.einsum("vji,fvj->fvi", rotation, ahead / np.linalg.norm(ahead, axis=-1, keepdims=True))
    return np.concatenate([np.broadcast_to(world, (*sight.shape[:2], 12)), sight], axis=2)


def _depths(depth: Float, visibility: Float, size: float) -> Float:
    """Return (F, V, 2, K, 3) depths of the bones, metres, probability of being right, and 1/variance, 1/m², as named,
    and with left and right exchanged, from depth and visibility (F, V, L) of the landmarks."""
    depth, visibility = (np.stack([v, v[..., _PARTNER]], axis=2) for v in (depth, visibility))
    seen = size * (depth[..., _TO] - depth[..., _FROM])
    known, visibility = np.isfinite(seen), np.minimum(visibility[..., _TO], visibility[..., _FROM])
    sigma = DEPTH_M * size * DEPTH_HIDDEN ** (1.0 - visibility)
    return np.stack([np.where(known, seen, 0.0), np.where(known, right_share(visibility), 0.0), sigma**-2], axis=-1)


def known_landmarks(seen: Float) -> NDArray[np.bool_]:
    """Return (...) which landmarks (..., 4) are known; their depth may be unknown."""
    return np.asarray(np.isfinite(seen[..., :3]).all(axis=-1))


def deviation(visibility: Float) -> Float:
    """Return the standard deviation of landmarks about the body's points, metres, by their visibility."""
    return np.asarray(np.hypot(SEEN_M, OFFSET_M) * HIDDEN ** (1.0 - visibility))


def right_share(visibility: Float) -> Float:
    """Return the probability that landmarks are right, by their visibility."""
    return np.asarray(RIGHT_HIDDEN + (RIGHT_SEEN - RIGHT_HIDDEN) * visibility)


def log_ratio(away_m: Float, visibility: Float, spread: Float | None = None, known: Float | None = None) -> Float:
    """Return (...) the logarithm of the likelihood of each landmark being right, against being wrong, nats.

    Args:
        away_m: (..., 2) metres from where it should be, across the view.
        visibility: (...).
        spread: (..., 2, 2) covariance of where it should be; None: it is known. What is open to a right landmark is
            open to a wrong one, too, so an unknown place gives a ratio near 0.
        known: (...) probability that this place is right; None: 1.
    """
    right = right_share(visibility) * (1.0 if known is None else known)
    covariance = deviation(visibility)[..., None, None] ** 2 * np.eye(2) + (0.0 if spread is None else spread)
    finite = np.asarray(np.isfinite(away_m).all(axis=-1))
    away = np.where(finite[..., None], away_m, 0.0)
    square = np.where(finite, (away * np.linalg.solve(covariance, away[..., None])[..., 0]).sum(axis=-1), np.inf)
    wide = covariance + np.eye(2) / (2 * np.pi * WRONG_DENSITY)
    ratio = np.sqrt(np.linalg.det(wide) / np.linalg.det(covariance)) * np.exp(-0.5 * square)
    return np.asarray(INDEPENDENT * np.log(right * ratio + 1.0 - right))


def _normalised(rig: Rig, landmarks: Float) -> Float:
    """Return landmarks (..., V, L, 4), x and y in pixels, with x and y on the plane at distance 1 before a camera."""
    result = np.array(landmarks)
    for c, camera in enumerate(rig):
        known = known_landmarks(landmarks[..., c, :, :])
        if known.any():
            result[..., c, :, :2][known] = camera.undistort(landmarks[..., c, :, :2][known])
    return result


def propose(rig: Rig, body: ConeBody, seen: Float, p_near: Float) -> Float:
    """Return poses (B, D) that landmarks (V, L, 4) of a frame show, the likeliest first.

    The landmarks' cost has several minima, such as a person who faces either way. It is minimised from figures at a
    point (3,), at first with wide distributions.
    """
    poses, cost = _descended(LandmarkCue(rig, body, seen), resting_figures(body.skeleton, p_near))
    return np.asarray(poses[np.argsort(cost, kind="stable")])


def _descended(cue: LandmarkCue, rest: Float) -> tuple[Float, Float]:
    """Return poses (B, D) that the landmarks attract from poses (B, D), and their costs (B,), nats.

    Levenberg-Marquardt (Marquardt 1963), with a weak prior about the first poses. Which landmarks are right, and whose
    left is left, changes with the pose, so that full steps often lead uphill: they are not made, and the next ones are
    shorter.
    """
    skeleton = cue.body.skeleton
    precision = np.where(skeleton.prismatic, 1.0, np.pi) ** -2.0
    prior, poses = Quadratic.about(rest, precision), rest
    for factor in WIDENED:
        wide, damping = cue.widened(factor), np.full(len(rest), DAMPING)
        cost = wide.cost(poses) + 0.5 * (poses - rest) ** 2 @ precision
        for _ in range(STEPS):
            near = wide.normal(poses) + prior
            stiff = near.matrix * (1.0 + damping[:, None, None] * np.eye(len(precision)))
            step = np.linalg.solve(stiff, near.linear[..., None] - near.matrix @ poses[..., None])[..., 0]
            tried = skeleton.clip(poses + np.clip(step, -LONGEST_STEP, LONGEST_STEP))
            now = wide.cost(tried) + 0.5 * (tried - rest) ** 2 @ precision
            lower = now < cost
            poses, cost = np.where(lower[:, None], tried, poses), np.where(lower, now, cost)
            damping = np.where(lower, damping / DAMPING_CHANGE, damping * DAMPING_CHANGE)
    return poses, cue.cost(poses)


def stature(rig: Rig, seen: Float) -> float | None:
    """Return the stature, metres, of the average body that explains the landmarks (V, L, 4) of a frame best, each in
    its best pose; None if no landmark is seen by two cameras. It does not depend on the pose, as a height does."""
    found = triangulate_joints(rig, seen)[0]
    if not np.isfinite(found).any():
        return None
    p_near = np.nanmedian(found, axis=0)

    def explained(log_stature: float, rest: Float | None = None) -> tuple[float, Float]:
        body = build_cone_body(BodyDimensions.from_stature(float(np.exp(log_stature))))
        # of one size throughout: else the smaller errors and depths of small bodies would make them likelier
        cue = LandmarkCue(rig, body, seen, size=1.0)
        poses, cost = _descended(cue, resting_figures(body.skeleton, p_near) if rest is None else rest)
        return float(cost.min()), poses[np.argsort(cost, kind="stable")[:2]]

    coarse = np.linspace(np.log(LEAST_STATURE), np.log(GREATEST_STATURE), STATURES)
    costs, poses = zip(*map(explained, coarse), strict=True)
    best = int(np.argmin(costs))
    # up to three quarters of the way to its neighbours, from its poses; then the minimum of a parabola
    step = (coarse[1] - coarse[0]) / 4
    fine = coarse[best] + step * np.arange(-3, 4)
    finer = [explained(at, poses[best])[0] for at in fine]
    k = min(max(int(np.argmin(finer)), 1), len(fine) - 2)
    left, middle, right = finer[k - 1 : k + 2]
    shift = 0.5 * (left - right) / max(left - 2 * middle + right, 1e-9)
    return float(np.exp(np.clip(fine[k] + step * np.clip(shift, -1.0, 1.0), coarse[0], coarse[-1])))


def points(body: ConeBody, pose: Float) -> Float:
    """Return the places (..., L, 3) of the landmarks of a body at poses (..., D), in its world, metres."""
    return body.skeleton.points(pose, SEGMENT, body.marked[:, :3])


def of_person(landmarks: Float | None, masks: NDArray[np.uint8]) -> Float | None:
    """Choose, among the landmarks of N people (N, V, L, 4), those (V, L, 4) of the person in masks (V, H, W).

    In each image the box around the visible landmarks is compared with the box around the mask. The person with the
    largest overlap (intersection over union, mean over the images) is chosen; None if it is below
    :data:`LEAST_OVERLAP`. Landmarks in images whose mask is empty become NaN.
    """
    if landmarks is None or not len(landmarks):
        return None
    shown = np.flatnonzero((masks >= PERSON).any(axis=(1, 2)))
    overlap = np.zeros(len(landmarks))
    for v in shown:
        ys, xs = (np.flatnonzero((masks[v] >= PERSON).any(axis=axis)) for axis in (1, 0))
        own = np.array([[xs[0], ys[0]], [xs[-1] + 1, ys[-1] + 1]])
        for n, seen in enumerate(landmarks[:, v]):
            points = seen[known_landmarks(seen) & (seen[:, 2] > LEAST_VISIBLE), :2]
            if len(points) > 1:
                box = np.array([points.min(axis=0), points.max(axis=0)])
                common = np.prod(np.maximum(np.minimum(own[1], box[1]) - np.maximum(own[0], box[0]), 0.0))
                both = np.prod(own[1] - own[0]) + np.prod(box[1] - box[0]) - common
                overlap[n] += common / both
    best = int(np.argmax(overlap))
    if not len(shown) or overlap[best] < LEAST_OVERLAP * len(shown):
        return None
    result = np.full(landmarks.shape[1:], np.nan)
    result[shown] = landmarks[best, shown]
    return result
