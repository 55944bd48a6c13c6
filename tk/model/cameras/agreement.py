"""Whether the cameras agree about the person: what is left in each camera once the poses have taken what they can.

A camera that is turned, moved or late sees the body's contours beside where the other cameras put them, in every frame
alike. Each camera gets an unknown shift of its picture and an unknown delay; one Gauss-Newton step over all frames,
poses eliminated, tells them with their standard deviations. A motion of the whole world moves all pictures and no one
could tell: of what the frames leave open the step takes none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tk.kernels.line_search import SearchSettings
from tk.model.body.body_parameters import Family
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.bundle import Moment, Seen, equations, look
from tk.model.cameras.camera import Rig

Float = NDArray[np.float64]

# One standard deviation of what is expected of a shift, pixels, and of a delay, frames, before any picture was seen.
_SHIFT_PX, _OFFSET_FRAMES = 5.0, 2.0
# Of differences that stand for a derivative.
_STEP_M = 1e-4
# Cameras disagree where a shift is more than this angle, a delay more than this part of a frame, and each more than so
# many standard deviations. Captures with exact cameras (walk, dance) show 0.02° and 0.01 frames.
ASTRAY_DEG, LATE_FRAMES, SURELY = 0.06, 0.2, 3.0
# Between samples of a contour, pixels.
SPACING_PX = 6.0
# Where an edge's weight has fallen to a quarter, pixels: less than in the tracker's search, for a camera can do without
# the edges of folds, shadows and hands.
ROBUST_PX = 3.0


@dataclass(frozen=True)
class CameraAgreement:
    """What the cameras say against each other.

    Attributes:
        names: of the C cameras.
        shift_px: (C, 2) by which the person stands beside where the others see him or her, x right and y down, pixels.
        shift_sigma_px: (C, 2) one standard deviation.
        offset_frames: (C,) by how many frames a camera's pictures are taken later than the others'; NaN where nobody
            moves.
        offset_sigma_frames: (C,) one standard deviation.
        residual_px: (C,) root of the mean squared distance of contours from the mask's edges.
        focal_px: (C,) focal lengths, which a shift is to be measured by.
    """

    names: tuple[str, ...]
    shift_px: Float
    shift_sigma_px: Float
    offset_frames: Float
    offset_sigma_frames: Float
    residual_px: Float
    focal_px: Float

    @property
    def astray(self) -> NDArray[np.bool_]:
        """(C,) cameras whose shift is more than :data:`ASTRAY_DEG` at the focal length, and surely so."""
        shift = np.linalg.norm(self.shift_px, axis=1)
        sigma = np.linalg.norm(self.shift_sigma_px, axis=1) / np.sqrt(2)
        return (shift > np.radians(ASTRAY_DEG) * self.focal_px) & (shift > SURELY * sigma)

    @property
    def late(self) -> NDArray[np.bool_]:
        """(C,) cameras whose pictures are more than :data:`LATE_FRAMES` too late or too early, and surely so."""
        with np.errstate(invalid="ignore"):
            away = np.abs(self.offset_frames)
            return (away > LATE_FRAMES) & (away > SURELY * self.offset_sigma_frames)


def camera_agreement(
    body: ConeBody, rig: Rig, moments: Sequence[Moment], settings: SearchSettings | None = None
) -> CameraAgreement:
    """How the cameras disagree over F frames of the tracked body, see the module.

    Args:
        body: that was tracked, in a world in which z is up.
        rig: C cameras.
        moments: F frames, their poses and velocities, of :func:`tk.model.cameras.bundle.gather`; 24 that are spread
            over the
            recording are enough.
        settings: of the search along the contours' normals.

    Raises:
        ValueError: no frames.
    """
    if not moments:
        raise ValueError("no frames to compare the cameras in")
    settings = replace(settings or SearchSettings(), spacing_px=SPACING_PX, robust_px=ROBUST_PX)
    C = len(rig)
    family = Family(body)
    poses = np.array([moment.pose for moment in moments])
    seen = look(body, rig, np.zeros(C), moments, poses, 0, settings)
    found = equations(body, rig, moments, poses, seen, ("shift", "offset"), family.rows(family.start, seen))
    H, g = found.hessian, found.gradient
    precision = np.tile([_SHIFT_PX**-2.0, _SHIFT_PX**-2.0, _OFFSET_FRAMES**-2.0], C)
    H[: 3 * C, : 3 * C] += np.diag(precision)
    family.add_prior(family.start, H[3 * C :, 3 * C :], g[3 * C :])
    # what a motion of the whole world, or another name for the time, does alike is taken off
    modes = _common(rig, body.skeleton.joints(poses[0])[0])
    away = np.eye(3 * C) - modes @ np.linalg.solve((modes.T * precision) @ modes, modes.T * precision)
    inverse = away @ np.linalg.inv(H)[: 3 * C]
    step = (inverse @ g).reshape(C, 3)
    # a frame counts as one observation, for what errs in a frame errs together (the sandwich estimator)
    scatter = (found.by_frame - found.by_frame.mean(axis=0)) @ inverse.T
    curvature = np.diag(inverse[:, : 3 * C] @ away.T)
    deviation = np.sqrt(np.maximum((scatter**2).sum(axis=0), curvature)).reshape(C, 3)
    moves = any(np.abs(moment.velocity).max() > 0 for moment in moments)
    return CameraAgreement(
        names=rig.names,
        shift_px=step[:, :2],
        shift_sigma_px=deviation[:, :2],
        offset_frames=step[:, 2] if moves else np.full(C, np.nan),
        offset_sigma_frames=deviation[:, 2] if moves else np.full(C, np.nan),
        residual_px=residual_px(seen, C),
        focal_px=np.array([camera.matrix[0, 0] for camera in rig]),
    )


def _common(rig: Rig, p_world: Float) -> Float:
    """(3 C, 4) how the pictures of a point shift when it moves along x, y, z, and a delay of all."""
    C = len(rig)
    modes = np.zeros((C, 3, 4))
    steps = np.concatenate([_STEP_M * np.eye(3), -_STEP_M * np.eye(3)])
    pixels = np.array([camera.project(p_world + steps)[0] for camera in rig])
    modes[:, :2, :3] = np.nan_to_num(pixels[:, :3] - pixels[:, 3:]).transpose(0, 2, 1) / (2 * _STEP_M)
    modes[:, 2, 3] = 1.0
    return modes.reshape(3 * C, 4)


def residual_px(seen: Sequence[Seen], count: int) -> Float:
    """(C,) root of the mean squared distance of contours from the edges, weighted as in the equations, in each of
    ``count`` cameras; NaN where nothing was found."""
    sums = np.zeros((count, 2))
    for view in seen:
        weight = view.edgels.weight
        sums[view.camera] += [(weight * view.edgels.distance**2).sum(), weight.sum()]
    return np.sqrt(sums[:, 0] / np.where(sums[:, 1] > 0, sums[:, 1], np.nan))
