"""Finds a person of whom nothing is known but silhouettes: any pose, any heading, any stature (silhouette paper,
section 4.6: "multiple different poses can be hypothesized and tested").

No frame of the opening is better than another, so the person is looked for in some of them, and followed from each to
both ends, until one is explained well or two tell the same. Whether he or she faces this way or the opposite one, all
of the opening decides: feet, knees and elbows bend one way, and people walk forwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.model.body import gait_poses as gait
from tk.model.body.anthropometry import BodyDimensions
from tk.model.body.cone_body import ConeBody, build_cone_body
from tk.model.body.skeleton import Skeleton
from tk.model.cameras.camera import Rig
from tk.model.cues.ray_costs import Evidence
from tk.model.masks.silhouettes import Pyramid
from tk.trackers.protocol import Observation

if TYPE_CHECKING:
    from tk.trackers.contour_tracker import ContourTracker

Float = NDArray[np.float64]

# Headings and walking phases that are tried.
HEADINGS, PHASES = 8, 8
# Of what they settle to, so many different poses are finished by a search for the limbs: of the best heading, and of
# those that face the other way; with joints that far apart on an average, metres.
FINALISTS, OPPOSITE, APART_M = 4, 2, 0.15
# Frames of the opening in which the person is looked for, one after the other. A pose is believed at once that leaves
# no more than this unexplained (E_S): in the development captures an average body of the right stature leaves 0.15 to
# 0.31 in the right pose, and in a wrong one never less than 0.25.
ANCHORS, CLEAR = 4, 0.2
# Over the opening, what is explained worse than the best by more than this factor is wrong.
AMBIGUOUS = 1.1
# Of those that face alike the best in its frame is believed unless another way is better by this factor: legs that
# change places explain a walk as well, but for noise.
HANDICAP = 1.1
# Whoever faces the other way is followed, too, where that explains the frame nearly as well, by this factor.
NEARLY = 1.4
# A frame explained worse than the anchor by this factor is searched for lost limbs.
WORSE = 1.2
# The stature that the first guess renders.
_AVERAGE_M = 1.7
# A search that finds a better pose is repeated, at most so often.
_SEARCHES = 2


class Way(NamedTuple):
    """How the opening can be explained.

    Attributes:
        poses: (F, D).
        error: their mean E_S.
        handicap: by which that counts more.
    """

    poses: Float
    error: float
    handicap: float = 1.0


def find_person(
    tracker: ContourTracker, frames: Sequence[Observation], pyramids: Sequence[Pyramid], pose: Float | None = None
) -> list[Way]:
    """Poses in F consecutive frames, the best explained ones first, and others that are explained nearly as well: only
    a body fitted to each tells then. The tracker has an average body already.

    Args:
        tracker: see :class:`ContourTracker`.
        frames: F observations, at least one.
        pyramids: their silhouettes.
        pose: (D,) that in the first frame, where it is known; it is followed then.

    Raises:
        CaptureError: nobody is seen in the first frame by two cameras.
    """
    if pose is not None:
        return [_follow(tracker, frames, pyramids, _searched(tracker, frames[0], pyramids[0], pose), 0)]
    skeleton = tracker.body.skeleton
    ways: list[Way] = []
    others: list[tuple[int, Float, float]] = []
    for anchor in np.unique(np.linspace(0, len(frames) - 1, ANCHORS).astype(int)):
        try:
            error, poses = _find(tracker, frames[anchor], pyramids[anchor])
        except CaptureError:
            if anchor == 0:
                raise
            continue
        for pose in poses[1:]:
            turned = _turned(skeleton, pose[None], poses[0])[0]
            others.append((int(anchor), pose, 1.0 if turned else HANDICAP))
        if _is_on(skeleton, ways, anchor, poses[0]):
            break  # found twice
        ways.append(_follow(tracker, frames, pyramids, poses[0], anchor))
        if error < CLEAR:
            break
    for anchor, pose, handicap in others:
        if not _is_on(skeleton, ways, anchor, pose):
            ways.append(_follow(tracker, frames, pyramids, pose, anchor)._replace(handicap=handicap))
    ways.sort(key=lambda way: way.error * way.handicap)
    least = min(way.error for way in ways)
    kept: list[Way] = []
    for way in ways:
        joints = skeleton.joints(way.poses)
        apart = [np.max(skeleton.apart(other.poses, joints)) for other in kept]
        if way.error <= AMBIGUOUS * least and all(distance > APART_M for distance in apart):
            kept.append(way)
    return kept


def _is_on(skeleton: Skeleton, ways: Sequence[Way], frame: int, pose: Float) -> bool:
    """Whether one of the ways passes by a pose (D,) in a frame."""
    joints = skeleton.joints(pose)
    return any(skeleton.apart(way.poses[frame], joints) < APART_M for way in ways)


def _find(tracker: ContourTracker, frame: Observation, pyramid: Pyramid) -> tuple[float, list[Float]]:
    """E_S of the pose (D,) that explains a frame best; the pose, and others that are nearly as good: one that faces the
    other way, and those that few cameras cannot tell from it."""
    skeleton = tracker.body.skeleton
    p_centroid = centroid(tracker.views.rig, pyramid, frame.index)
    settled = tracker.settle(pyramid, gait.hypotheses(skeleton, HEADINGS, PHASES, p_centroid)).states
    order = settled[np.argsort(tracker.mean_residual(pyramid, settled, frame.uncertain), kind="stable")]
    turned = _turned(skeleton, order, order[0])
    finalists = np.array(_distinct(skeleton, order, FINALISTS) + _distinct(skeleton, order[turned], OPPOSITE))
    poses = np.array([_searched(tracker, frame, pyramid, pose) for pose in np.unique(finalists, axis=0)])
    error = tracker.mean_residual(pyramid, poses, frame.uncertain)
    best = int(np.argmin(error))
    others = np.flatnonzero(_turned(skeleton, poses, poses[best]) & (error < NEARLY * error[best]))
    opposite = others[np.argsort(error[others], kind="stable")[:1]]
    alike = np.flatnonzero(error < AMBIGUOUS * error[best])
    rest = np.union1d(opposite, alike)
    rest = rest[np.argsort(error[rest], kind="stable")]
    return float(error[best]), _distinct(skeleton, poses[np.concatenate([[best], rest])], len(poses))


def _follow(
    tracker: ContourTracker, frames: Sequence[Observation], pyramids: Sequence[Pyramid], pose: Float, anchor: int
) -> Way:
    """Poses from that of frame ``anchor`` to both ends."""
    F = len(frames)
    poses = np.tile(pose, (F, 1))
    errors = np.full(F, np.nan)

    def told(i: int, pose: Float) -> float:
        return float(tracker.mean_residual(pyramids[i], pose[None], frames[i].uncertain)[0])

    errors[anchor] = told(anchor, pose)
    every = tracker.contours.search_every
    for step, end in ((1, F), (-1, -1)):
        for i in range(anchor + step, end, step):
            before = poses[i - 2 * step] if abs(i - anchor) > 1 else poses[anchor]
            expected = poses[i - step] + tracker.contours.prediction * (poses[i - step] - before)
            now = tracker.settle(pyramids[i], expected[None]).states[0]
            error = told(i, now)
            if not np.isfinite(error):  # nobody is in sight
                poses[i] = poses[i - step]
                continue
            if every and (error > WORSE * errors[anchor] or abs(i - anchor) % every == 0):
                now = tracker.improved(frames[i], pyramids[i], now)
                error = told(i, now)
            poses[i], errors[i] = now, error
    return Way(poses, float(np.nanmean(errors)))


def _searched(tracker: ContourTracker, frame: Observation, pyramid: Pyramid, pose: Float) -> Float:
    """The pose (D,) with limbs searched for until none is found elsewhere."""
    for _ in range(_SEARCHES):
        found = tracker.improved(frame, pyramid, pose)
        if np.array_equal(found, pose):
            break
        pose = found
    return pose


def _distinct(skeleton: Skeleton, poses: Float, count: int) -> list[Float]:
    """The first poses of (B, D), at most ``count``, whose joints lie apart from each other's."""
    chosen: list[Float] = []
    places: list[Float] = []
    for pose in poses:
        if len(chosen) == count:
            break
        if all(skeleton.apart(pose, other) > APART_M for other in places):
            chosen.append(pose)
            places.append(skeleton.joints(pose))
    return chosen


def _turned(skeleton: Skeleton, poses: Float, pose: Float) -> NDArray[np.bool_]:
    """(B,) whether poses (B, D) face away from where ``pose`` (D,) does, by more than a right angle."""
    yaw = skeleton.index("torso_yaw")
    return np.asarray(np.cos(poses[:, yaw] - pose[yaw]) < 0)


def centroid(rig: Rig, pyramid: Pyramid, index: int) -> Float:
    """(3,) the point nearest to the rays through the silhouettes' centroids, metres; ``index`` is the frame's number.

    Raises:
        CaptureError: fewer than two cameras see anybody.
    """
    A, y, count = np.zeros((3, 3)), np.zeros(3), 0
    for mask, camera in zip(pyramid.masks[0], rig, strict=True):
        ys, xs = np.nonzero(mask >= 128)
        if len(xs) == 0:
            continue
        ray = camera.rays([[xs.mean(), ys.mean()]])[0]
        across = np.eye(3) - np.outer(ray, ray)
        A += across
        y += across @ camera.center
        count += 1
    if count < 2:
        raise CaptureError(
            f"initialisation: {count} of {len(rig)} masks of frame {index} show anybody, two are "
            "needed: check the masks, or choose another first frame"
        )
    return np.asarray(np.linalg.solve(A, y), np.float64)


def stature_of(tracker: ContourTracker, pyramids: Sequence[Pyramid]) -> float:
    """The stature whose average body covers as much of the pictures as the silhouettes do, metres.

    Areas hardly change when somebody bends or raises the arms, as the silhouette's height does; girth and clothes make
    it err by 6 %. The median over the views of all frames, against the mean area of hanging and of spread arms.
    """
    body: ConeBody = build_cone_body(BodyDimensions.from_stature(_AVERAGE_M), preset=tracker.contours.body)
    group = np.zeros(len(body.parts), np.int32)
    ratios: list[Float] = []
    for pyramid in pyramids:
        try:
            p_centroid = centroid(tracker.views.rig, pyramid, 0)
        except CaptureError:
            continue
        poses = gait.hypotheses(body.skeleton, 4, 0, p_centroid)  # standing, and the Da Vinci pose
        evidence = Evidence.of(tracker.screen, pyramid.masks[0])
        met = evidence.cast(body, group, poses, export=True)[1]
        assert met is not None
        covered = np.count_nonzero(met.label, axis=(2, 3)).mean(axis=0)
        seen = np.count_nonzero(evidence.person, axis=(1, 2))
        known = (covered > 0) & (seen > 0)
        ratios.append(seen[known] / covered[known])
    ratio = float(np.median(np.concatenate(ratios))) if ratios else 1.0
    return float(np.clip(_AVERAGE_M * np.sqrt(ratio), 0.8, 2.4))
