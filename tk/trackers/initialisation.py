"""Find a person in the opening frames from silhouettes alone: any pose, heading and stature (silhouette paper, section
4.6: "multiple different poses can be hypothesized and tested").

The person is searched for in several frames of the opening, and each pose found is tracked to both ends of the opening,
until one trajectory has a low residual or two frames give the same trajectory. The whole opening decides which way the
person faces: feet, knees and elbows bend one way, and people walk forwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.kernels.mask_values import PERSON
from tk.model.body import gait_poses as gait
from tk.model.body.anthropometry import AVERAGE_BODY
from tk.model.body.cone_body import ConeBody, build_cone_body
from tk.model.body.initial_pose import GREATEST_STATURE, LEAST_STATURE
from tk.model.body.skeleton import Skeleton
from tk.model.cameras.camera import Rig
from tk.model.cues.landmarks import propose
from tk.model.cues.ray_costs import Evidence
from tk.model.masks.silhouettes import Pyramid
from tk.model.setup import AVERAGE_STATURE_M
from tk.trackers.protocol import Observation

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder

Float = NDArray[np.float64]

# Headings, and walking phases of each, from which the person is searched for.
HEADINGS, PHASES = 8, 8
# Poses of the landmarks from which the person is searched for, the likeliest ones.
SIGHTED = 4
# Poses that differ by more than this, mean over the joints, metres, are different hypotheses. Coarser than the limb
# search's SAME_POSE_M, because the body is an average one that is not fitted yet. Half and twice the value change no
# mean error of dance and cube (50 frames).
SAME_START_M = 0.15
# Of the poses that the coarsest scale gives for each way of facing, one in REFINED goes on to the finer ones. Of 13
# starts of dance and cube, all have the same pose with 2 as without this; with 3, one has a better pose; with 4, one
# faces the other way.
REFINED = 3
# Poses of the best heading, and of those that face the other way, that are refined by a limb search.
FINALISTS, OPPOSITE = 4, 2
# Frames of the opening in which the person is searched for, in turn. The search ends at a residual (E_S) of CLEAR: on
# the development captures an average body of the right stature has 0.15 to 0.31 in the right pose and never less than
# 0.25 in a wrong one.
ANCHORS, CLEAR = 4, 0.2
# Costs are negative logarithms of a posterior, nats. An average body errs in all frames alike, so the opening counts as
# much as one frame. Hypotheses are kept while their probability is above e^-OPEN of the best one's. Legs that change
# places explain a walk equally well but for noise: the prior of a hypothesis that faces the same way as the best one in
# its frame is e^-EXCHANGE. In a single frame a pose that faces the other way is kept within OPPOSITE_OPEN. The numbers
# correspond, with four views, to the factors 1.1, 1.1 and 1.4 on a residual of 0.25 that were chosen before.
OPEN, EXCHANGE, OPPOSITE_OPEN = 7.0, 6.0, 24.0
# A frame in which the residual is higher than the anchor's by this factor triggers a limb search.
WORSE = 1.2
# A pose with a higher residual explains nothing: twice what an average body of the right stature leaves. Without a
# better one in any of the frames the person is not found.
UNEXPLAINED = 0.6
# A mask smaller than this share of the largest one does not show where the person is, because others hide most of the
# person. A view from above, or from twice as far, shows a quarter.
WHOLE = 0.1
# Alternatives that are followed through the opening, the likeliest of each anchor first: where nothing fits, each takes
# seconds. Half and twice as many change no mean error of dance and cube (50 frames).
FOLLOWED = 8
# A search that finds a better pose is repeated, at most this often.
_SEARCHES = 2


class TrajectoryHypothesis(NamedTuple):
    """Poses that may explain the opening.

    Attributes:
        poses: (F, D).
        cost: negative logarithm of their posterior, mean over the frames, nats.
    """

    poses: Float
    cost: float


def find_person(
    finder: ContourFinder, frames: Sequence[Observation], pyramids: Sequence[Pyramid], pose: Float | None = None
) -> list[TrajectoryHypothesis]:
    """Return trajectory hypotheses over F consecutive frames, best first. Those after the first are nearly as probable;
    the caller fits a body to each of them to decide.

    Args:
        finder: with an average body.
        frames: F observations, at least one.
        pyramids: their silhouettes.
        pose: (D,) pose in the first frame, if known; there is one hypothesis then.

    Raises:
        CaptureError: fewer than two cameras see anybody in the first frame, or no pose explains what they see.
    """
    if pose is not None:
        return _follow(finder, frames, pyramids, [_searched(finder, frames[0], pyramids[0], pose)], 0)
    skeleton = finder.body.skeleton
    hypotheses: list[TrajectoryHypothesis] = []
    alternatives: list[tuple[int, int, Float, float]] = []  # rank in its anchor, anchor, pose, prior in nats
    clear: list[tuple[int, Float, float]] = []  # anchor, pose, prior
    least = np.inf
    for anchor in np.unique(np.linspace(0, len(frames) - 1, ANCHORS).astype(int)):
        try:
            residual, poses = _find(finder, frames[anchor], pyramids[anchor])
        except CaptureError:
            if anchor == 0:
                raise
            continue
        least = min(least, residual)
        if residual > UNEXPLAINED:
            continue
        for rank, pose in enumerate(poses[1:]):
            turned = _turned(skeleton, pose[None], poses[0])[0]
            alternatives.append((rank, int(anchor), pose, 0.0 if turned else EXCHANGE))
        if _contains(skeleton, hypotheses, anchor, poses[0]):
            break  # found from two frames
        if residual < CLEAR and not hypotheses:
            clear = [(int(anchor), poses[0], 0.0)]  # followed with its alternatives: no other anchor is needed
            break
        hypotheses += _follow(finder, frames, pyramids, poses[:1], anchor)
        if residual < CLEAR:
            break
    if not hypotheses and not clear:
        raise CaptureError(
            f"no pose of a person explains the masks: the best one leaves {least:.0%} of their pixels unexplained; "
            "check that the masks show one whole person, and the calibration"
        )
    likeliest = sorted(range(len(alternatives)), key=lambda i: alternatives[i][0])[:FOLLOWED]
    for anchor, group in groupby([*clear, *(alternatives[i][1:] for i in sorted(likeliest))], itemgetter(0)):
        new = [(pose, prior) for _, pose, prior in group if not _contains(skeleton, hypotheses, anchor, pose)]
        followed = _follow(finder, frames, pyramids, [pose for pose, _ in new], anchor)
        hypotheses += [one._replace(cost=one.cost + prior) for one, (_, prior) in zip(followed, new, strict=True)]
    hypotheses.sort(key=lambda hypothesis: hypothesis.cost)
    kept: list[TrajectoryHypothesis] = []
    for hypothesis in hypotheses:
        joints = skeleton.joints(hypothesis.poses)
        apart = [np.max(skeleton.apart(other.poses, joints)) for other in kept]
        if hypothesis.cost <= hypotheses[0].cost + OPEN and all(distance > SAME_START_M for distance in apart):
            kept.append(hypothesis)
    return kept


def _contains(skeleton: Skeleton, hypotheses: Sequence[TrajectoryHypothesis], frame: int, pose: Float) -> bool:
    """Return whether one of the hypotheses has the pose (D,) in a frame."""
    joints = skeleton.joints(pose)
    return any(skeleton.apart(hypothesis.poses[frame], joints) < SAME_START_M for hypothesis in hypotheses)


def _find(finder: ContourFinder, frame: Observation, pyramid: Pyramid) -> tuple[float, list[Float]]:
    """Return the residual (E_S) of the best pose in a frame, and poses (D,): the best one, then one that faces the
    other way and those that few cameras cannot distinguish from it."""
    skeleton = finder.body.skeleton
    p_centroid = centroid(finder.views.rig, pyramid, frame.index)
    levels = range(finder.solver.scales - 1, -1, -1)

    def ordered(poses: Float, levels: Sequence[int]) -> tuple[Float, NDArray[np.bool_]]:
        """Return the poses that these converge to, best first, and whether they face another way than the best."""
        settled = finder.settle(pyramid, poses, levels).states
        order = settled[np.argsort(finder.score(pyramid, settled, frame.uncertain), kind="stable")]
        return order, _turned(skeleton, order, order[0])

    starts = gait.hypotheses(skeleton, HEADINGS, PHASES, p_centroid)
    if pyramid.landmarks is not None:
        sighted = propose(finder.views.rig, finder.body, pyramid.landmarks, p_centroid)
        starts = np.concatenate([starts, sighted[:SIGHTED]])
    coarse, turned = ordered(starts, levels[:1])
    kept = [poses[: -(-len(poses) // REFINED)] for poses in (coarse[~turned], coarse[turned])]
    order, turned = ordered(np.concatenate(kept), levels[1:])
    finalists = np.array(_distinct(skeleton, order, FINALISTS) + _distinct(skeleton, order[turned], OPPOSITE))
    poses = np.array([_searched(finder, frame, pyramid, pose) for pose in np.unique(finalists, axis=0)])
    cost = finder.score(pyramid, poses, frame.uncertain)
    best = int(np.argmin(cost))
    others = np.flatnonzero(_turned(skeleton, poses, poses[best]) & (cost < cost[best] + OPPOSITE_OPEN))
    opposite = others[np.argsort(cost[others], kind="stable")[:1]]
    rest = np.union1d(opposite, np.flatnonzero(cost < cost[best] + OPEN))
    rest = rest[np.argsort(cost[rest], kind="stable")]
    residual = float(finder.mean_residual(pyramid, poses[best : best + 1], frame.uncertain)[0])
    return residual, _distinct(skeleton, poses[np.concatenate([[best], rest])], len(poses))


def _follow(
    finder: ContourFinder,
    frames: Sequence[Observation],
    pyramids: Sequence[Pyramid],
    starts: Sequence[Float],
    anchor: int,
) -> list[TrajectoryHypothesis]:
    """Return the trajectories that follow from poses (D,) in frame ``anchor``, tracked to both ends of the frames."""
    if not starts:
        return []
    F = len(frames)
    poses = np.tile(np.array(starts)[:, None], (1, F, 1))
    residuals, costs = np.full((2, len(starts), F), np.nan)

    def residual_of(i: int, poses: Float) -> Float:
        return finder.mean_residual(pyramids[i], poses, frames[i].uncertain)

    residuals[:, anchor] = residual_of(anchor, poses[:, anchor])
    costs[:, anchor] = finder.score(pyramids[anchor], poses[:, anchor], frames[anchor].uncertain)
    every = finder.search_frames
    for step, end in ((1, F), (-1, -1)):
        for i in range(anchor + step, end, step):
            last = poses[:, i - step]
            before = poses[:, i - 2 * step] if abs(i - anchor) > 1 else poses[:, anchor]
            now = finder.settle(pyramids[i], last + finder.contours.prediction * (last - before)).states
            residual = residual_of(i, now)
            if not np.isfinite(residual).any():  # no camera sees anybody
                poses[:, i] = last
                continue
            high = residual > WORSE * residuals[:, anchor]
            means = np.nanmean(costs, axis=1)  # no search brings back a trajectory that is worse by far
            searched = (high | (abs(i - anchor) % every == 0)) & (means <= means.min() + OPEN) if every else []
            for b in np.flatnonzero(searched):
                now[b] = finder.improved(frames[i], pyramids[i], now[b])
                residual[b] = residual_of(i, now[b : b + 1])[0]
            poses[:, i], residuals[:, i] = now, residual
            costs[:, i] = finder.score(pyramids[i], now, frames[i].uncertain)
    means = np.nanmean(costs, axis=1)
    return [TrajectoryHypothesis(one, float(mean)) for one, mean in zip(poses, means, strict=True)]


def _searched(finder: ContourFinder, frame: Observation, pyramid: Pyramid, pose: Float) -> Float:
    """Return the pose (D,) after limb searches, repeated as long as a search finds a better pose."""
    for _ in range(_SEARCHES):
        found = finder.improved(frame, pyramid, pose)
        if np.array_equal(found, pose):
            break
        pose = found
    return pose


def _distinct(skeleton: Skeleton, poses: Float, count: int) -> list[Float]:
    """Return the first poses of (B, D), at most ``count``, that differ from each other by SAME_START_M."""
    chosen: list[Float] = []
    joints: list[Float] = []
    for pose in poses:
        if len(chosen) == count:
            break
        if all(skeleton.apart(pose, other) > SAME_START_M for other in joints):
            chosen.append(pose)
            joints.append(skeleton.joints(pose))
    return chosen


def _turned(skeleton: Skeleton, poses: Float, pose: Float) -> NDArray[np.bool_]:
    """Return (B,) whether poses (B, D) are turned by more than 90° from ``pose`` (D,)."""
    yaw = skeleton.index("torso_yaw")
    return np.asarray(np.cos(poses[:, yaw] - pose[yaw]) < 0)


def centroid(rig: Rig, pyramid: Pyramid, index: int) -> Float:
    """Return (3,) the point nearest to the rays through the silhouettes' centroids, metres; ``index``: the frame's.

    Raises:
        CaptureError: fewer than two cameras see anybody.
    """
    A, y, count = np.zeros((3, 3)), np.zeros(3), 0
    shown = [np.nonzero(mask >= PERSON) for mask in pyramid.masks[0]]
    least = WHOLE * max(len(ys) for ys, _ in shown)
    for (ys, xs), camera in zip(shown, rig, strict=True):
        if len(ys) <= least:
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


def stature_of(finder: ContourFinder, pyramids: Sequence[Pyramid]) -> float:
    """Return the stature, metres, at which an average body covers as many pixels as the silhouettes do.

    The area hardly changes when a person bends or raises the arms; the silhouette's height does. Girth and clothes
    cause an error of about 6 %. Median over the views of all frames, against the mean area of hanging and spread arms.
    """
    body: ConeBody = build_cone_body(AVERAGE_BODY)
    ratios: list[Float] = []
    for pyramid in pyramids:
        try:
            p_centroid = centroid(finder.views.rig, pyramid, 0)
        except CaptureError:
            continue
        poses = gait.hypotheses(body.skeleton, 4, 0, p_centroid)  # standing, and the Da Vinci pose
        evidence = Evidence.of(finder.screen, pyramid.masks[0])
        _, met = evidence.cast(body, poses)
        drawn = met.label > 0 if evidence.others is None else (met.label > 0) & ~evidence.others
        covered = np.count_nonzero(drawn, axis=(2, 3)).mean(axis=0)
        seen = np.count_nonzero(evidence.person, axis=(1, 2))
        known = (covered > 0) & (seen > 0)
        ratios.append(seen[known] / covered[known])
    ratio = float(np.median(np.concatenate(ratios))) if ratios else 1.0
    return float(np.clip(AVERAGE_STATURE_M * np.sqrt(ratio), LEAST_STATURE, GREATEST_STATURE))
