"""Both headings of a person, compared by frames of a whole recording.

A few views of a person who stands upright at the start hardly show where the front is; a whole recording does. Poses
are in the setup's world.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tk.model.body.body_fit import STATURE_DEVIATION
from tk.model.body.body_parameters import FITTED_STATURE_DEVIATION
from tk.model.body.limb_candidates import turned
from tk.model.cues.cue import Measured, in_frames
from tk.model.masks.silhouettes import Pyramid
from tk.trackers.hypotheses import DROPPED, PROPOSED, walking
from tk.trackers.protocol import Frame
from tk.trackers.region import RegionTracker

Float = NDArray[np.float64]
Masks = NDArray[np.uint8]


def turned_pose(tracker: RegionTracker, pose: Float) -> Float:
    """Return a pose (D,) with the opposite heading and the limbs in the same places."""
    inside = turned(tracker.world.poses_in(pose[None])[0], tracker.limbs)
    return np.asarray(tracker.world.poses_out(inside[None])[0])


def trajectory_cost(tracker: RegionTracker, masks: Sequence[Masks], poses: Float, measured: Measured) -> float:
    """Return the negative logarithm of the posterior of poses (N, D), mean over the frames, nats: a body that does not
    fit errs in all of them alike.

    Args:
        tracker: with the body.
        masks: (C, H, W) of N frames, cleaned.
        poses: (N, D).
        measured: of N frames, see :mod:`tk.model.cues.cue`.
    """
    inside, seen = tracker.world.poses_in(poses), _pyramids(tracker, masks, measured)
    cost = np.mean([tracker.cost(pyramid, pose[None])[0] for pyramid, pose in zip(seen, inside, strict=True)])
    return float(cost + walking(tracker.body.skeleton, inside))


def both_headings(
    tracker: RegionTracker, masks: Sequence[Masks], poses: Float, height_m: float | None, measured: Measured
) -> tuple[RegionTracker, ...]:
    """Return two trackers, whose bodies are fitted to a person with the heading of the poses, and with the opposite
    one; none if the opposite heading is improbable (1e-3). Arguments as for :func:`trajectory_cost`, and the subject's
    height if known."""
    seen, inside = _pyramids(tracker, masks, measured), tracker.world.poses_in(poses)
    both = np.array([
        tracker.settle(pyramid, np.stack([pose, turned(pose, tracker.limbs)])).states
        for pyramid, pose in zip(seen, inside, strict=True)
    ])  # fmt: skip
    present, opposite = (np.mean(list(map(tracker.cost, seen, one[:, None]))) for one in both.swapaxes(0, 1))
    if opposite > present + PROPOSED:
        return ()
    for i, (shown, pyramid) in enumerate(zip(masks, seen, strict=True)):
        frame = Frame(i, np.empty((len(shown), 0, 0, 3), np.uint8), shown)
        both[i, 1] = tracker.improved(tracker.see(frame, pyramid=pyramid), both[i, 1])
    stature = height_m or tracker.body.dimensions.barefoot
    deviation = STATURE_DEVIATION if height_m else FITTED_STATURE_DEVIATION
    trackers, costs = (tracker.with_cameras(tracker.rig), tracker.with_cameras(tracker.rig)), []
    for one, own in zip(trackers, both.swapaxes(0, 1), strict=True):
        fitted = tracker.fit(seen, own, np.arange(len(seen)), stature, deviation)
        one.take_body(fitted.body)
        costs.append(trajectory_cost(one, masks, tracker.world.poses_out(fitted.poses), measured))
    return trackers if costs[1] < costs[0] + DROPPED else ()


def _pyramids(tracker: RegionTracker, masks: Sequence[Masks], measured: Measured) -> list[Pyramid]:
    """Return what frames show, arguments as for :func:`trajectory_cost`."""
    scales = tracker.solver.scales
    return [tracker.views.pyramid(m, scales, False, in_frames(measured, i)) for i, m in enumerate(masks)]
