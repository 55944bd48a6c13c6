"""Find a person in the opening frames from silhouettes, and from landmarks where there are any: any pose, heading and
stature (silhouette paper, section 4.6: "multiple different poses can be hypothesized and tested").

The person is searched for in several frames of the opening, and each pose found is tracked to both ends of the opening,
until one trajectory has a low residual or two frames give the same trajectory. The whole opening decides which way the
person faces: feet, knees and elbows bend one way, and people walk forwards
(:func:`~tk.trackers.hypotheses.walking`).
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
from tk.model.body.joints import HIPS, JOINTS, SHOULDERS
from tk.model.body.limb_candidates import DISTINCT_M
from tk.model.body.skeleton import Skeleton, distinct
from tk.model.cues import landmarks as landmark_cue
from tk.model.cues.ray_costs import Evidence
from tk.model.masks.silhouettes import Pyramid
from tk.model.setup import AVERAGE_STATURE_M
from tk.trackers.hypotheses import DROPPED, TrajectoryHypothesis, walking
from tk.trackers.proposals import anywhere, landmarks, opposite
from tk.trackers.proposals.anywhere import centroid

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]

# Poses whose opposite heading is proposed, too.
OPPOSITE = 2
# Frames of the opening in which the person is searched for, in turn, and the residual (E_S) at which the search ends.
ANCHORS, CLEAR = 4, 0.2
# Alternatives that are followed through the opening, the likeliest of each anchor first: where nothing fits, each takes
# seconds.
FOLLOWED = 8
# A given height is refused if the stature that the frames show differs by more than this factor. With true heights the
# factor is 0.955 to 1.077 by the areas in nine recordings, and 0.88 to 1.01 by the landmarks in 14 frames; children's
# proportions and wide clothes need more. A visual hull that is lower by more than this shows a person who
# bends, so its height is no estimate of the stature.
MOST_STATURE_RATIO = 1.35
#: the joints that a limb search does not move
TRUNK = [JOINTS.index(name) for name in ("pelvis", "neck", *SHOULDERS, *HIPS)]


def find_person(
    finder: ContourFinder, seen: Sequence[Seen], pose: Float | None = None, begun: FoundPoses | None = None
) -> list[TrajectoryHypothesis]:
    """Return trajectory hypotheses over F consecutive frames, best first. Those after the first are nearly as probable;
    the caller fits a body to each of them to decide.

    Args:
        finder: with an average body.
        seen: what F frames show, at least one, without images.
        pose: (D,) pose in the first frame, if known; there is one hypothesis then.
        begun: what :func:`find_in` has found in the first frame, if it was called before.

    Raises:
        CaptureError: fewer than two cameras see anybody in the first frame, or no pose explains what they see.
    """
    alone = len(seen) == 1
    begun = begun or find_in(finder, seen[0], pose, alone)
    if pose is not None:
        return _follow(finder, seen, begun.poses, 0)
    skeleton = finder.body.skeleton
    hypotheses: list[TrajectoryHypothesis] = []
    alternatives: list[tuple[int, int, Float]] = []  # rank in its anchor, anchor, pose
    clear: list[tuple[int, Float]] = []  # anchor, pose
    least = np.inf
    for anchor in np.unique(np.linspace(0, len(seen) - 1, ANCHORS).astype(int)):
        try:
            residual, poses = begun if anchor == 0 else find_in(finder, seen[anchor], None, alone)
        except CaptureError:
            continue
        least = min(least, residual)
        if residual > finder.settings.lost_error:
            continue
        alternatives += [(rank, int(anchor), pose) for rank, pose in enumerate(poses[1:])]
        if _contains(skeleton, hypotheses, anchor, poses[0]):
            break  # found from two frames
        if residual < CLEAR and not hypotheses:
            clear = [(int(anchor), poses[0])]  # followed with its alternatives: no other anchor is needed
            break
        hypotheses += _follow(finder, seen, poses[:1], anchor)
        if residual < CLEAR:
            break
    if not hypotheses and not clear:
        raise CaptureError(
            f"no pose of a person explains the masks: the best one leaves {least:.0%} of their pixels unexplained; "
            "check that the masks show one whole person (not two who touch: start where they are apart), and the "
            "calibration"
        )
    likeliest = sorted(range(len(alternatives)), key=lambda i: alternatives[i][0])[:FOLLOWED]
    for anchor, group in groupby([*clear, *(alternatives[i][1:] for i in sorted(likeliest))], itemgetter(0)):
        new = [pose for _, pose in group if not _contains(skeleton, hypotheses, anchor, pose)]
        hypotheses += _follow(finder, seen, new, anchor)
    hypotheses = _likely(hypotheses)
    return [hypotheses[i] for i in distinct(skeleton.joints(np.array([one.poses for one in hypotheses])), DISTINCT_M)]


def _likely(hypotheses: Sequence[TrajectoryHypothesis]) -> list[TrajectoryHypothesis]:
    """Return the hypotheses that are not improbable, best first."""
    ranked = sorted(hypotheses, key=lambda hypothesis: hypothesis.cost)
    return [one for one in ranked if one.cost <= ranked[0].cost + DROPPED]


def weighed(
    finder: ContourFinder, hypotheses: Sequence[TrajectoryHypothesis], before: Seen, after: Seen
) -> list[TrajectoryHypothesis]:
    """Return the hypotheses that are not improbable, best first, when more is known of the first frame.

    A hypothesis costs the mean of its frames, because they err alike; what one frame shows beside that counts like a
    measurement in all of them.

    Args:
        finder: with an average body.
        hypotheses: of :func:`find_person`.
        before, after: what the first frame showed, and shows.
    """
    poses = np.array([one.poses[0] for one in hypotheses])
    more = after.evidence.cost(finder.body, poses) - before.evidence.cost(finder.body, poses)
    return _likely([one._replace(cost=one.cost + float(add)) for one, add in zip(hypotheses, more, strict=True)])


def _contains(skeleton: Skeleton, hypotheses: Sequence[TrajectoryHypothesis], frame: int, pose: Float) -> bool:
    """Return whether one of the hypotheses has the pose (D,) in a frame."""
    joints = skeleton.joints(pose)
    return any(skeleton.apart(hypothesis.poses[frame], joints) < DISTINCT_M for hypothesis in hypotheses)


class FoundPoses(NamedTuple):
    """The residual (E_S) of the best pose in a frame, and poses (B, D): the best one, then those that are not
    improbable beside it."""

    residual: float
    poses: Float


def find_in(finder: ContourFinder, seen: Seen, pose: Float | None, alone: bool) -> FoundPoses:
    """Return what is found in one frame.

    Args:
        finder, seen, pose: as for :func:`find_person`.
        alone: no other frame follows, which would correct the limbs.

    Raises:
        CaptureError: fewer than two cameras see anybody; with a given pose, none does.
    """
    if pose is not None:
        if not (seen.pyramid.masks[0] >= PERSON).any():
            raise CaptureError(
                f"initialisation: no mask of frame {seen.frame.index} shows anybody: check the masks, or give the pose "
                "of another frame"
            )
        return FoundPoses(0.0, finder.improved(seen, pose)[None])
    skeleton = finder.body.skeleton
    found = np.concatenate([anywhere.propose(finder, seen), landmarks.propose(finder, seen)])
    both = [opposite.propose(finder, seen, pose, range(finder.solver.scales)[::-1]) for pose in found[:OPPOSITE]]
    found = np.concatenate([found, *both])
    found = found[distinct(skeleton.joints(found), DISTINCT_M)]
    # A limb search moves limbs only: it brings a pose to where it brings a likelier one with the same trunk. A pose of
    # a single frame gets worse by that.
    before, trunk = seen.evidence.cost(finder.body, found), skeleton.joints(found)[:, TRUNK]
    alike = np.linalg.norm(trunk[:, None] - trunk[None], axis=-1).max(axis=-1) < DISTINCT_M
    if not alone:
        found = found[~(alike & (before[:, None] > before + DROPPED)).any(axis=1)]
    poses = np.array([finder.improved(seen, pose) for pose in found])
    cost = seen.evidence.cost(finder.body, poses)
    order = np.argsort(cost, kind="stable")
    kept = poses[order[cost[order] < cost.min() + DROPPED]]
    kept = kept[distinct(skeleton.joints(kept), DISTINCT_M)]
    return FoundPoses(float(finder.mean_residual(seen.pyramid, kept[:1], seen.frame.uncertain)[0]), kept)


def _follow(
    finder: ContourFinder, seen: Sequence[Seen], starts: Sequence[Float] | Float, anchor: int
) -> list[TrajectoryHypothesis]:
    """Return the trajectories that follow from poses (D,) in frame ``anchor``, tracked to both ends of the frames."""
    if not len(starts):
        return []
    F, skeleton = len(seen), finder.body.skeleton
    poses = np.tile(np.array(starts)[:, None], (1, F, 1))
    costs = np.full((len(starts), F), np.nan)
    costs[:, anchor] = seen[anchor].evidence.cost(finder.body, poses[:, anchor])
    every = finder.search_frames
    for step, end in ((1, F), (-1, -1)):
        for i in range(anchor + step, end, step):
            last = poses[:, i - step]
            before = poses[:, i - 2 * step] if abs(i - anchor) > 1 else poses[:, anchor]
            now = finder.settle(seen[i].pyramid, last + finder.settings.prediction * (last - before)).states
            cost = seen[i].evidence.cost(finder.body, now)
            if not np.isfinite(cost).any():  # no camera sees anybody
                poses[:, i] = last
                continue
            means = np.nanmean(costs, axis=1)  # no search brings back a trajectory that is worse by far
            searched = (abs(i - anchor) % every == 0) & (means <= means.min() + DROPPED) if every else []
            for b in np.flatnonzero(searched):
                now[b] = finder.improved(seen[i], now[b])
                cost[b] = seen[i].evidence.cost(finder.body, now[b : b + 1])[0]
            poses[:, i], costs[:, i] = now, cost
    means = np.nanmean(costs, axis=1) + walking(skeleton, poses)
    return [TrajectoryHypothesis(one, float(mean)) for one, mean in zip(poses, means, strict=True)]


def stature_of(finder: ContourFinder, pyramids: Sequence[Pyramid], hull_m: float | None = None) -> float:
    """Return the stature, metres, that frames show.

    Landmarks show it in any pose; those of one frame do, the one in which they are most visible, because frames err
    alike. Without landmarks, it is the stature at which an average body covers as many pixels as the silhouettes do:
    median over the views of all frames, against the mean area of hanging and spread arms. The area hardly changes when
    a person bends or raises the arms. Clothes enlarge it, raised arms enlarge the height of the visual hull; who bends
    has a low hull.

    Args:
        finder: of the cameras.
        pyramids: of the frames.
        hull_m: height of the visual hull in the first frame, metres, if known.
    """
    rig = finder.views.rig
    marked = [pyramid.measured[landmark_cue.NAME] for pyramid in pyramids if landmark_cue.NAME in pyramid.measured]
    if marked and (shown := finder.marked_stature(max(marked, key=lambda seen: np.nansum(seen[..., 2])))):
        return shown
    body: ConeBody = build_cone_body(AVERAGE_BODY)
    ratios: list[Float] = []
    for pyramid in pyramids:
        try:
            p_centroid = centroid(rig, pyramid, 0)
        except CaptureError:
            continue
        poses = gait.gait_figures(body.skeleton, 4, 0, p_centroid)  # standing, and the Da Vinci pose
        evidence = Evidence.of(finder.coarse_grid, pyramid.masks[0])
        _, met = evidence.cast(body, poses)
        drawn = met.label > 0 if evidence.others is None else (met.label > 0) & ~evidence.others
        covered = np.count_nonzero(drawn, axis=(2, 3)).mean(axis=0)
        seen = np.count_nonzero(evidence.person, axis=(1, 2))
        shown = (covered > 0) & (seen > 0)
        ratios.append(seen[shown] / covered[shown])
    ratio = float(np.median(np.concatenate(ratios))) if ratios else 1.0
    apparent = float(np.clip(AVERAGE_STATURE_M * np.sqrt(ratio), LEAST_STATURE, GREATEST_STATURE))
    return min(apparent, hull_m) if hull_m and apparent / hull_m < MOST_STATURE_RATIO else apparent
