"""The person anywhere: walking phases, standing and the Da Vinci pose at all headings, at the silhouettes' centroid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tk.errors import CaptureError
from tk.kernels.mask_values import PERSON
from tk.model.body import gait_poses as gait
from tk.model.body.initial_pose import HEADINGS
from tk.model.body.limb_candidates import DISTINCT_M
from tk.model.body.skeleton import distinct
from tk.model.cameras.camera import Rig
from tk.model.masks.silhouettes import Pyramid

if TYPE_CHECKING:
    from tk.trackers.contour_finder import ContourFinder, Seen

Float = NDArray[np.float64]

# Walking phases at each heading from which the person is searched for.
PHASES = 8
# Of the poses that the coarsest scale gives, one in REFINED goes on to the finer ones; FINALISTS of those that differ
# are proposed.
REFINED, FINALISTS = 3, 4


def propose(finder: ContourFinder, seen: Seen, pose: Float | None = None) -> Float:
    """Return at most :data:`FINALISTS` different poses (B, D), the likeliest first.

    Args:
        finder, seen: the tracker, and what the frame shows.
        pose: (D,) the last pose, if any: it is tried at the centroid, too.

    Raises:
        CaptureError: fewer than two cameras see anybody.
    """
    skeleton, pyramid = finder.body.skeleton, seen.pyramid
    p_centroid = centroid(finder.views.rig, pyramid, seen.frame.index)
    yaw = skeleton.index("torso_yaw")
    poses = gait.gait_figures(skeleton, HEADINGS, PHASES, p_centroid, 0.0 if pose is None else pose[yaw])
    if pose is not None:
        moved = pose.copy()
        moved[skeleton.prismatic] = p_centroid
        poses = np.concatenate([moved[None], poses])
    scales = range(finder.solver.scales - 1, -1, -1)
    for levels, share in ((scales[:1], REFINED), (scales[1:], 1)):
        poses = finder.settle(pyramid, poses, levels).states
        order = np.argsort(seen.evidence.cost(finder.body, poses), kind="stable")
        poses = poses[order[: -(-len(poses) // share)]]
    return np.asarray(poses[distinct(skeleton.joints(poses), DISTINCT_M, FINALISTS)])


def centroid(rig: Rig, pyramid: Pyramid, index: int) -> Float:
    """Return (3,) the point nearest to the rays through the silhouettes' centroids, metres; ``index``: the frame's.

    A silhouette counts by its area, because a small part of a person does not show where the person is.

    Raises:
        CaptureError: fewer than two cameras see anybody.
    """
    A, y, count = np.zeros((3, 3)), np.zeros(3), 0
    shown = [np.nonzero(mask >= PERSON) for mask in pyramid.masks[0]]
    for (ys, xs), camera in zip(shown, rig, strict=True):
        if not len(ys):
            continue
        ray = camera.rays([[xs.mean(), ys.mean()]])[0]
        across = len(ys) * (np.eye(3) - np.outer(ray, ray))
        A += across
        y += across @ camera.center
        count += 1
    if count < 2:
        raise CaptureError(
            f"initialisation: {count} of {len(rig)} masks of frame {index} show anybody, two are "
            "needed: check the masks, or choose another first frame"
        )
    return np.asarray(np.linalg.solve(A, y), np.float64)
