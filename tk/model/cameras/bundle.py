"""Normal equations of cameras, poses and a body on the contours' residuals: bundle adjustment without points.

An edgel says that the contour of frame f in camera c should move by d pixels along its normal n. To first order it
moves by n·Jπ·∂x/∂δ, where x is the material point of the contour: the surface slides along its contour in the image's
tangent only. That holds for the pose and the body (:mod:`tk.model.body.body_fit`) and for whatever moves the camera. A
camera's frame k is taken ``offset`` frames later than k, so the body is drawn for it at θ_k + offset · dθ/dk.

Poses are eliminated frame by frame (the Schur complement; Triggs et al. 2000, *Bundle adjustment: a modern synthesis*,
section 6), so the equations that are left have the size of what the frames share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import SearchSettings
from tk.kernels.silhouette import Edgels
from tk.model.body.body_fit import pose_rows
from tk.model.body.cone_body import ConeBody
from tk.model.body.skeleton import SEGMENTS
from tk.model.cameras.camera import Camera, Rig
from tk.model.masks.silhouettes import Pyramid, Views

Float = NDArray[np.float64]

# Information of one pixel of contour, 1/px²: edgels err by 3 px, and together along 10 px of a contour, as in the
# body's fit.
INFORMATION = 1.0 / (3.0**2 * 10.0)
# Standard deviation of a degree of freedom about the pose that was given, radians or metres; of waist and ankles about
# straight ones.
POSE_DEVIATION = 0.3
# One standard deviation, metres, of a segment along an axis in one frame about where skeleton and pose put it: no
# joint of a person is a hinge, and clothes stand off by 1 to 3 cm. Without this freedom the cameras bend to suit the
# skeleton.
SEGMENT_M = 0.02
# Added to the diagonal for a joint beyond its limit.
_LIMIT = 1e3

#: what a camera may change by, and how many numbers that is
KINDS = {"shift": 2, "turn": 3, "move": 3, "focal": 1, "offset": 1}


@dataclass(frozen=True)
class Moment:
    """A frame that takes part.

    Attributes:
        pyramid: its silhouettes.
        pose: (D,) the pose that was found.
        velocity: (D,) its change from frame to frame.
    """

    pyramid: Pyramid
    pose: Float
    velocity: Float


@dataclass(frozen=True)
class Seen:
    """What one camera shows of one frame.

    Attributes:
        frame, camera: which.
        pose: (D,) that the body was drawn at: where this camera's clock says that it is.
        edgels: of this camera alone.
    """

    frame: int
    camera: int
    pose: Float
    edgels: Edgels


@dataclass(frozen=True)
class Equations:
    """What is left once the poses are eliminated, S unknowns that the frames share.

    Attributes:
        hessian, gradient: (S, S), (S,) the step solves ``hessian @ step = gradient``. No prior on the unknowns is in.
        by_frame: (F, S) what each frame adds to the gradient.
        steps: of each frame (D,) and (D, S): its pose moves by ``a - B @ step``.
    """

    hessian: Float
    gradient: Float
    by_frame: Float
    steps: list[tuple[Float, Float]]


def look(
    body: ConeBody,
    rig: Rig,
    offsets: Float,
    moments: Sequence[Moment],
    poses: Float,
    scale: int,
    settings: SearchSettings,
) -> list[Seen]:
    """The edgels of F frames in C cameras at poses (F, D), the cameras ``offsets`` (C,) frames late; frame by frame."""
    views = [Views(Rig((camera,))) for camera in rig]
    found = []
    for f, (moment, pose) in enumerate(zip(moments, poses, strict=True)):
        for c, view in enumerate(views):
            here = pose + offsets[c] * moment.velocity
            masks = Pyramid(
                tuple(level[c : c + 1] for level in moment.pyramid.masks),
                tuple(size[c : c + 1] for size in moment.pyramid.sizes),
            )
            found.append(Seen(f, c, here, view.edgels(body, masks, here, scale, settings)))
    return found


def camera_rows(camera: Camera, x_world: Float, edgels: Edgels, kind: str) -> Float:
    """(N, k) derivative of the contour's position along its normal by what may change a camera, pixels.

    Args:
        camera: whose edgels these are.
        x_world: (N, 3) their points on the surface, metres.
        edgels: N of them.
        kind: "shift", of the picture (pixels); "turn" and "move", the twist (ω, v) by which a point of the camera frame
            moves, p + ω × p + v (radians, metres); "focal", the logarithm of the focal lengths.
    """
    row = edgels.row @ camera.rotation.T  # n·Jπ in the camera frame
    if kind == "move":
        return row
    if kind == "turn":
        return np.cross(camera.to_camera(x_world), row)
    if kind == "shift":
        return edgels.normal
    return np.einsum("ni,ni->n", edgels.normal, edgels.pixel - camera.matrix[:2, 2])[:, None]


def equations(
    body: ConeBody,
    rig: Rig,
    moments: Sequence[Moment],
    poses: Float,
    seen: Sequence[Seen],
    kinds: Sequence[str],
    shared_rows: Sequence[Float] | None = None,
) -> Equations:
    """The equations of the cameras and, behind them, of what else the frames share.

    Args:
        body: that was drawn.
        rig: C cameras.
        moments: F frames.
        poses: (F, D) now.
        seen: of :func:`look`.
        kinds: of :data:`KINDS`, each camera's unknowns in this order.
        shared_rows: rows (N, K) by K further unknowns, for each of ``seen``; None: there are none.
    """
    s = body.skeleton
    segment = np.array([SEGMENTS.index(part.segment) for part in body.parts])
    P, D, per_camera = len(s.names), len(s.names) + 3 * len(SEGMENTS), sum(KINDS[kind] for kind in kinds)
    further = shared_rows or [np.zeros((len(view.edgels.part), 0)) for view in seen]
    K = further[0].shape[1]
    S = per_camera * len(rig) + K
    free = np.concatenate([np.flatnonzero(body.free), np.arange(P, D)])
    straight = s.is_waist | s.is_ankle
    precision = np.concatenate([np.full(P, POSE_DEVIATION**-2.0), np.full(D - P, SEGMENT_M**-2.0)])
    blocks = [(np.zeros((D + S, D + S)), np.zeros(D + S)) for _ in moments]
    transforms = s.segment_transforms(np.array([view.pose for view in seen]))
    for view, rows_behind, T in zip(seen, further, transforms, strict=True):
        edgels = view.edgels
        x = body.place(view.pose, edgels.part, edgels.unscaled, T)
        by_pose = pose_rows(body, view.pose, edgels, x)
        columns = [
            (by_pose @ moments[view.frame].velocity)[:, None]
            if kind == "offset"
            else camera_rows(rig[view.camera], x, edgels, kind)
            for kind in kinds
        ]
        loose = np.zeros((len(x), len(SEGMENTS), 3))
        loose[np.arange(len(x)), segment[edgels.part]] = edgels.row
        rows = np.hstack([by_pose, loose.reshape(len(x), 3 * len(SEGMENTS)), *columns, rows_behind])
        weighted = rows * (edgels.weight * INFORMATION)[:, None]
        A, y = weighted.T @ rows, weighted.T @ edgels.distance
        H, g = blocks[view.frame]
        start, k = D + view.camera * per_camera, per_camera
        pairs = [
            (slice(0, D), slice(0, D)),
            (slice(start, start + k), slice(D, D + k)),
            (slice(D + S - K, D + S), slice(D + k, None)),
        ]
        for whole, own in pairs:
            g[whole] += y[own]
            for other_whole, other_own in pairs:
                H[whole, other_whole] += A[own, other_own]
    hessian, by_frame = np.zeros((S, S)), np.zeros((len(moments), S))
    steps = []
    for f, (H, g) in enumerate(blocks):
        excess = np.zeros(D)
        excess[:P] = s.clip(poses[f]) - poses[f]
        limit = np.where(excess != 0, _LIMIT, 0.0)
        away = np.zeros(D)
        away[:P] = np.where(straight, 0.0, moments[f].pose) - poses[f]
        pose_block = (H[:D, :D] + np.diag(precision + limit))[np.ix_(free, free)]
        pose_gradient = (g[:D] + precision * away + limit * excess)[free]
        across = H[free, D:]
        solved = np.linalg.solve(pose_block, np.column_stack([pose_gradient, across]))
        hessian += H[D:, D:] - across.T @ solved[:, 1:]
        by_frame[f] = g[D:] - across.T @ solved[:, 0]
        a, B = np.zeros(D), np.zeros((D, S))
        a[free], B[free] = solved[:, 0], solved[:, 1:]
        steps.append((a[:P], B[:P]))
    return Equations(hessian, by_frame.sum(axis=0), by_frame, steps)


def gather(
    masks: Callable[[int, int], NDArray[np.uint8]],
    views: Views,
    frames: NDArray[np.int64],
    poses: Float,
    usable: NDArray[np.bool_],
    count: int,
    scales: int,
    cleaning: bool,
    late: NDArray[np.int64] | None = None,
) -> list[Moment]:
    """Frames that are spread evenly over a recording, whose neighbours are usable, too: they tell the velocity.

    Args:
        masks: (H, W) of a frame and a camera.
        views: the C cameras.
        frames: (F,) source frame of each row.
        poses: (F, D).
        usable: (F,) bool, rows whose pose is to be trusted.
        count: most frames that are taken.
        scales: of the pyramids.
        cleaning: whether the masks are cleaned first.
        late: (C,) whole frames by which a camera's pictures are late; its frame k - late is shown beside frame k of
            the others. None: by none.
    """
    C = len(views.rig)
    late = np.zeros(C, np.int64) if late is None else late
    known = {int(frame) for frame in frames}
    inner = np.zeros(len(frames), bool)
    inner[1:-1] = usable[:-2] & usable[1:-1] & usable[2:] & (frames[2:] - frames[:-2] == 2)
    inner &= [all(int(frame) - int(n) in known for n in late) for frame in frames]
    rows = np.flatnonzero(inner)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int))]
    moments = []
    for i in rows:
        shown = np.stack([masks(int(frames[i] - late[c]), c) for c in range(C)])
        velocity = 0.5 * (poses[i + 1] - poses[i - 1])
        moments.append(Moment(views.pyramid(shown, scales, cleaning), poses[i], velocity))
    return moments
