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
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.kernels.mask_values import PERSON
from tk.model.body.body_points import LANDMARKS, POINTS, SEGMENT, places
from tk.model.body.cone_body import ConeBody
from tk.model.body.initial_pose import figures
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
# Factors of the standard deviations with which a proposal minimises the landmarks' cost, two steps each: a pose that
# is far away is attracted, too. Largest change of an angle in a step, radians.
WIDENED, LONGEST_STEP = (16.0, 8.0, 4.0, 2.0, 1.0), 0.6
# Weight of the landmarks in the contours' equations: these count the edgels of a segment as independent, but clothes
# and wrong pieces of a mask displace all of them together.
WEIGHT = 5.0
# Share of the landmarks' likelihood that counts: a network's errors in neighbouring landmarks go together.
INDEPENDENT = 0.5

_OTHER_SIDE = {"_l": "_r", "_r": "_l", "": ""}
_PARTNER = np.array([LANDMARKS.index(n.removesuffix(side_of(n)) + _OTHER_SIDE[side_of(n)]) for n in LANDMARKS])
_LOWER = np.array([name[:-2] in ("hip", "knee", "ankle", "heel", "toe") for name in LANDMARKS])
_HALVES = np.stack([~_LOWER, _LOWER]).astype(np.float64)  # (2, L)
# Bones whose depth counts: the landmarks at their ends (K, 2), and which of them belong to the upper and lower half.
_BONES = [("shoulder_l", "shoulder_r"), ("hip_l", "hip_r")] + [
    (parent + side, child + side)
    for parent, child in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
    for side in ("_l", "_r")
]
_FROM, _TO = np.array([[LANDMARKS.index(name) for name in bone] for bone in _BONES]).T
_BONE_HALVES = _HALVES[:, _FROM]  # (2, K)
_SHARE = np.where(np.arange(len(_BONES)) < 2, *DEPTH_SHARE)  # (K,)
# (L + K, L) the landmarks and their bones as sums of landmarks; (L + K, L L) the products of these sums' factors.
_PLACES = np.eye(len(LANDMARKS))
_PLACES = np.concatenate([_PLACES, _SHARE[:, None] * (_PLACES[_TO] - _PLACES[_FROM])])
_PAIRS = (_PLACES[:, :, None] * _PLACES[:, None, :]).reshape(len(_PLACES), -1)
# The landmarks that show each joint.
_FACE = tuple(name for name in LANDMARKS if POINTS[name].segment == "head")
_MIDDLE = {"pelvis": HIPS, "neck": SHOULDERS, "head_top": _FACE}
_MARKED = {joint: [LANDMARKS.index(name) for name in _MIDDLE.get(joint, (joint,))] for joint in JOINTS}


class _Match(NamedTuple):
    """N measurements, of landmarks or of depths, in the V images, compared with B poses: each as it is named, and with
    left and right exchanged. All arrays are (B, 2, V, N).

    Attributes:
        ratio: likelihood, relative to that of a wrong measurement.
        right: probability that it is right.
        weight: 1/variance, 1/m².
        away: distances, metres; one array per axis.
    """

    ratio: Float
    right: Float
    weight: Float
    away: tuple[Float, ...]


class LandmarkRows(NamedTuple):
    """Information of the landmarks about N = L + K places, the body's points and its bones (:func:`_with_bones`), at B
    poses, with the landmarks' offsets integrated out."""

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
    """

    weight = WEIGHT

    def __init__(self, rig: Rig, body: ConeBody, seen: Float) -> None:
        self._rig, self._skeleton, self._seen = rig, body.skeleton, seen
        self._elsewhere, self._precision = float(np.log(ELSEWHERE)), 1.0
        seen = _normalised(rig, seen)
        self._place = places(body.dimensions) @ body.skeleton.T_world_body.T
        self._size = size = body.dimensions.stature / AVERAGE_STATURE_M
        known = known_landmarks(seen)
        visibility = np.where(known, seen[..., 2], 0.0)
        self._sigma = SEEN_M * size * HIDDEN ** (1.0 - visibility)  # (..., V, L)
        self._right = np.where(known, right_share(visibility), 0.0)
        self._at = np.where(known[..., None], seen[..., :2], 0.0)
        # what is hidden in the images is guessed in all of them alike
        images = np.maximum(np.count_nonzero(known, axis=-2), 1)
        mean = visibility.sum(axis=-2) / images  # (..., L)
        offset = (OFFSET_M * size * HIDDEN ** (1.0 - mean)) ** 2
        self._offset = np.concatenate([offset, _SHARE**2 * (offset[..., _FROM] + offset[..., _TO])], axis=-1)
        self._depth = np.where(known, seen[..., 3], np.nan)
        self._visibility = visibility
        # (D,) or (F, D) precision of the angles that only landmarks show, where there are any
        self._prior = np.any(known, axis=(-2, -1))[..., None] * body.skeleton.by_landmarks**-2.0

    def widened(self, factor: float) -> LandmarkCue:
        """Return the cue with standard deviations times a factor; if it exceeds 1, all images show the person."""
        result = copy(self)
        result._elsewhere = float(np.log(ELSEWHERE)) if factor == 1.0 else -np.inf
        result._precision = factor**-2
        return result

    @cached_property
    def _sight(self) -> Float:
        """(..., V, 3) directions from the cameras to the person, world."""
        at = np.concatenate([self._at, np.ones_like(self._at[..., :1])], axis=-1)
        shown = (self._visibility[..., None] * at).sum(axis=-2)
        ahead = np.where(shown[..., 2:] > 0, shown, [0.0, 0.0, 1.0])
        return np.einsum("vji,...vj->...vi", self._cameras[0], ahead / np.linalg.norm(ahead, axis=-1, keepdims=True))

    @cached_property
    def _cameras(self) -> tuple[Float, Float]:
        """(V, 3, 3), (V, 3) from the world to each camera."""
        return np.array([c.rotation for c in self._rig]), np.array([c.translation for c in self._rig])

    @cached_property
    def _marks(self) -> tuple[Float, Float, Float, Float]:
        """(..., 2, V, L) x and y on the plane at distance 1, probability of being right, and 1/variance, 1/m², of the
        landmarks as named, and with left and right exchanged."""
        values = (self._at[..., 0], self._at[..., 1], self._right, self._sigma**-2)
        x, y, right, weight = (np.stack([value, value[..., _PARTNER]], axis=-3) for value in values)
        return x, y, right, weight

    @cached_property
    def _depths(self) -> tuple[Float, Float, Float]:
        """(..., 2, V, K) depths of the bones, metres, probability of being right, and 1/variance, 1/m², as named, and
        with left and right exchanged."""
        depth, visibility = (np.stack([v, v[..., _PARTNER]], axis=-3) for v in (self._depth, self._visibility))
        seen = self._size * (depth[..., _TO] - depth[..., _FROM])
        known, visibility = np.isfinite(seen), np.minimum(visibility[..., _TO], visibility[..., _FROM])
        sigma = DEPTH_M * self._size * DEPTH_HIDDEN ** (1.0 - visibility)
        return np.where(known, seen, 0.0), np.where(known, right_share(visibility), 0.0), sigma**-2

    @cached_property
    def _directions(self) -> tuple[Float, Float]:
        """(9, 4 V), (..., 9, V) what the information about a point is linear in: see :meth:`_information`."""
        x, y, z = np.swapaxes(self._cameras[0], 0, 1)  # (V, 3) each

        def product(a: Float, b: Float) -> Float:
            return (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:-1], 9)

        across = [product(x, x) + product(y, y), -product(x, z) - product(z, x), -product(y, z) - product(z, y)]
        along = product(self._sight, self._sight)
        return np.concatenate([*across, product(z, z)]).T.copy(), np.ascontiguousarray(along.swapaxes(-1, -2))

    def normal(self, poses: Float) -> Quadratic:
        """Return the negative logarithm of the likelihood, and of the prior of the angles that only landmarks show, as
        a quadratic about each of the poses (B, D), nats."""
        rows = self.rows(poses)
        matrix, gradient = rows.normal_equations(rows.jacobian)
        prior = self._prior[..., None] * np.eye(poses.shape[-1])  # about zero
        return Quadratic(gradient + (matrix @ poses[..., None])[..., 0], matrix + prior)

    def rows(self, poses: Float) -> LandmarkRows:
        """Return the information of the landmarks about the body's points at poses (B, D)."""
        x = self._skeleton.points(poses, SEGMENT, self._place)
        found, pull = self._information(x.swapaxes(1, 2))[1:]
        inverse = INDEPENDENT * _inverse_with(found, self._offset)[0]
        jacobian = self._skeleton.point_jacobian(poses, SEGMENT, x)
        # both are symmetric and commute
        return LandmarkRows(_product(inverse[:, None], found), _product(inverse, pull), jacobian)

    def cost(self, poses: Float) -> Float:
        """Return (B,) the same at poses (B, D), nats, up to a constant of the frame.

        The offsets are integrated out by Laplace's method, about the offsets that one step of Newton's gives. They
        explain what all images have in common; a landmark far off in one image is not explained by them.
        """
        x, L = self._skeleton.points(poses, SEGMENT, self._place).swapaxes(1, 2), len(LANDMARKS)
        cost, information, pull = self._information(x)
        variance = self._offset[..., :L]
        inverse, determinant = _inverse_with(information[..., :L], variance)
        variance = variance[..., None, :]
        offset = variance * _product(inverse, pull[..., :L])
        moved = self._likelihood(x + offset)[0] + 0.5 * (offset**2 / variance).sum(axis=(-2, -1))
        volume = 0.5 * np.log(determinant).sum(axis=-1)
        # where the step leaves a landmark's normal part, it is too long, and no offset is better
        cost = INDEPENDENT * (np.minimum(moved, cost) + volume)
        return np.asarray(cost + 0.5 * (self._prior * poses**2).sum(axis=-1))

    def variance(self, poses: Float) -> Float:
        """Return (B, J) variance of the joints' positions along an axis, metres², from the distances between poses
        (B, D) and the triangulated landmarks, beyond the landmarks' own errors.

        Pose or landmark may be right, so half of the squared distance counts. Neck and pelvis have the mean of
        shoulders and hips, the crown that of the face.
        """
        x = self._skeleton.points(poses, SEGMENT, self._place)
        each = np.broadcast_to(self._seen, (len(poses), *self._seen.shape[-3:]))
        known, points = known_landmarks(each), np.full(x.shape, np.nan)
        for b in np.flatnonzero(known.any(axis=(1, 2))):
            points[b] = triangulate_joints(self._rig, each[b])[0]
        square = ((x - points) ** 2).sum(axis=-1)
        visibility = np.where(known, each[..., 2], 0.0).sum(axis=-2) / np.maximum(known.sum(axis=-2), 1)
        expected = 3 * (deviation(visibility) * self._size) ** 2
        excess = right_share(visibility) * np.maximum(np.where(np.isfinite(square), square, 0.0) - expected, 0.0) / 6
        return np.stack([excess[:, rows].mean(axis=1) for rows in _MARKED.values()], axis=1)

    def _information(self, x: Float) -> tuple[Float, Float, Float]:
        """Return the landmarks' likelihood if the body's points are at x (B, 3, L): its negative logarithm (B,), if all
        landmarks were independent; the information (B, 3, 3, L + K) about each point and each bone, and its product
        (B, 3, L + K) with the distance to the landmarks.

        An image shows a point's position across the ray: with the point at (u, v) on the plane at distance 1, the
        derivatives are the rows (1, 0, -u) and (0, 1, -v) in the camera's frame.
        """
        (B, _, L), V = x.shape, len(self._rig)
        cost, q, marks, depths, named = self._likelihood(x)
        w = named @ _HALVES * marks.right * marks.weight  # (B, 2, V, L)
        u, v = q[:, :, 0] / q[:, :, 2], q[:, :, 1] / q[:, :, 2]
        total, (pull_x, pull_y) = w[:, 0] + w[:, 1], ((w * away).sum(axis=1) for away in marks.away)
        moments = np.stack([total, total * u, total * v, total * (u * u + v * v)], axis=1)  # (B, 4, V, L)
        across, along = self._directions
        pulls = np.stack([pull_x, pull_y, -u * pull_x - v * pull_y], axis=2).reshape(B, 3 * V, L)
        w = named @ _BONE_HALVES * depths.right * depths.weight  # (B, 2, V, K)
        information = [across @ moments.reshape(B, 4 * V, L), along @ w.sum(axis=1)]
        bone_pull = np.swapaxes(self._sight, -1, -2) @ (w * depths.away[0]).sum(axis=1)
        pull = [self._cameras[0].reshape(3 * V, 3).T @ pulls, bone_pull]
        return cost, np.concatenate(information, axis=2).reshape(B, 3, 3, -1), np.concatenate(pull, axis=2)

    def _likelihood(self, x: Float) -> tuple[Float, Float, _Match, _Match, Float]:
        """Return the negative logarithm (B,) of :meth:`_information`; the points (B, V, 3, L) in the cameras' frames,
        with a depth of 1 behind a camera; what landmarks and depths are compared with; and the probability
        (B, 2, V, halves) that an image shows the person with each half as named, and exchanged."""
        (B, _, L), V = x.shape, len(self._rig)
        rotation, translation = self._cameras
        q = (rotation.reshape(3 * V, 3) @ x).reshape(B, V, 3, L) + translation[:, :, None]
        behind = q[:, :, 2] <= 0.1
        q[:, :, 2][behind] = 1.0
        marks, depths = self._match(q, behind), self._match_depth(_with_bones(x)[..., L:])
        halves = np.stack(
            [
                np.prod(marks.ratio[..., points], axis=-1) * np.prod(depths.ratio[..., bones], axis=-1)
                for points, bones in zip(_HALVES > 0, _BONE_HALVES > 0, strict=True)
            ],
            axis=-1,
        )  # (B, 2, V, halves)
        halves *= np.array([1.0 - EXCHANGED, EXCHANGED])[:, None, None]
        total = halves[:, 0] + halves[:, 1]
        image = np.log(total).sum(axis=-1) + np.log(1.0 - ELSEWHERE)  # (B, V)
        image_total = np.logaddexp(image, self._elsewhere)
        named = halves / total[:, None] * np.exp(image - image_total)[:, None, :, None]
        return -image_total.sum(axis=-1), q, marks, depths, named

    def _match(self, q: Float, behind: NDArray[np.bool_]) -> _Match:
        """Compare the landmarks with points (B, V, 3, L) in the cameras' frames, of which some are ``behind``
        (B, V, L)."""
        x, y, right, weight = self._marks
        right, weight = np.where(behind[:, None], 0.0, right), self._precision * weight
        q_x, q_y, depth = (q[:, None, :, axis] for axis in range(3))
        away = x * depth - q_x, y * depth - q_y
        inside = right * weight / (2 * np.pi) * np.exp(-0.5 * weight * (away[0] ** 2 + away[1] ** 2))
        both = inside + (1.0 - right) * WRONG_DENSITY
        return _Match(both / WRONG_DENSITY, inside / both, weight, away)

    def _match_depth(self, bones: Float) -> _Match:
        """Compare the depths with bones (B, 3, K), as :func:`_with_bones` has them."""
        seen, right, weight = self._depths
        weight = self._precision * weight
        away = seen - (self._sight @ bones)[:, None]
        inside = right * np.sqrt(weight / (2 * np.pi)) * np.exp(-0.5 * weight * away**2)
        both = inside + (1.0 - right) * WRONG_DENSITY
        return _Match(both / WRONG_DENSITY, inside / both, weight, (away,))


def _product(matrix: Float, values: Float) -> Float:
    """Return the products (..., 3, N) of N matrices (..., 3, 3, N) with vectors (..., 3, N)."""
    first, second, third = (matrix[..., k, :] * values[..., None, k, :] for k in range(3))
    return first + second + third


def _inverse_with(information: Float, variance: Float) -> tuple[Float, Float]:
    """Return the inverse (B, 3, 3, N) and the determinant (B, N) of 1 + information · variance, of symmetric matrices
    (B, 3, 3, N) and numbers (N,) or (B, N)."""
    a, b, c, d, e, f = (variance * information[:, i, k] + (i == k) for i in range(3) for k in range(i, 3))
    rows = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * rows[0] + b * rows[1] + c * rows[2]
    inverse = np.stack([rows[k] for k in (0, 1, 2, 1, 3, 4, 2, 4, 5)], axis=1) / determinant[:, None]
    return inverse.reshape(information.shape), determinant


def _with_bones(values: Float) -> Float:
    """Return values (..., L) of the landmarks, and those of the bones, (..., L + K): the part of the difference between
    their ends that a network's depth keeps."""
    return np.concatenate([values, _SHARE * (values[..., _TO] - values[..., _FROM])], axis=-1)


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
    point (3,), by Gauss-Newton, at first with wide distributions.
    """
    skeleton = body.skeleton
    start = figures(skeleton, p_near)
    prior = Quadratic.about(start, np.where(skeleton.prismatic, 1.0, np.pi) ** -2.0)
    poses, cue = start, LandmarkCue(rig, body, seen)
    for factor in WIDENED:
        cue = cue.widened(factor)
        for _ in range(2):
            cost = cue.normal(poses) + prior
            step = np.linalg.solve(cost.matrix, cost.linear[..., None])[..., 0] - poses
            poses = skeleton.clip(poses + np.clip(step, -LONGEST_STEP, LONGEST_STEP))
    return np.asarray(poses[np.argsort(cue.cost(poses), kind="stable")])


def points(body: ConeBody, pose: Float) -> Float:
    """Return the places (L, 3) of the landmarks of a body at a pose (D,), in its world, metres."""
    return body.skeleton.points(pose, SEGMENT, places(body.dimensions) @ body.skeleton.T_world_body.T)


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
