"""What a network would see of a body's points, for tests."""

import numpy as np
from numpy.typing import NDArray

from tk.model.body.body_points import LANDMARKS, SEGMENT, places
from tk.model.body.cone_body import ConeBody
from tk.model.cameras.camera import Rig

Float = NDArray[np.float64]


def body_points(body: ConeBody, pose: Float) -> Float:
    """Return the body's points (L, 3) at a pose (D,), metres."""
    return body.skeleton.points(pose, SEGMENT, places(body.dimensions) @ body.skeleton.T_world_body.T)


def landmarks_of(
    rig: Rig,
    body: ConeBody,
    pose: Float,
    noise_m: float = 0.0,
    visibility: float = 0.95,
    seed: int = 7,
    with_depth: bool = False,
) -> Float:
    """Return landmarks (V, L, 4) of a body at a pose (D,), with errors across the rays, metres, in each image; their
    depth is cautious and has errors of twice the size, or is unknown."""
    rng, points = np.random.default_rng(seed), body_points(body, pose)
    result = np.full((len(rig), len(LANDMARKS), 4), visibility)
    result[..., 3] = np.nan
    hips = points[[LANDMARKS.index("hip_l"), LANDMARKS.index("hip_r")]].mean(axis=0)
    for v, camera in enumerate(rig):
        pixels, depth = camera.project(points)
        if with_depth:
            sight = (hips - camera.center) / np.linalg.norm(hips - camera.center)
            result[v, :, 3] = 0.7 * (points - hips) @ sight + rng.normal(0.0, 2 * noise_m, len(points))
        result[v, :, :2] = pixels + rng.normal(0.0, noise_m, pixels.shape) * (camera.matrix[0, 0] / depth)[:, None]
    return result


def mirrored(seen: Float, lower: bool = True, upper: bool = True) -> Float:
    """Return landmarks (..., L, 4) with left and right exchanged, of both halves of the body or one."""
    order = []
    for k, name in enumerate(LANDMARKS):
        half = lower if name[:-2] in ("hip", "knee", "ankle", "heel", "toe") else upper
        other = {"_l": "_r", "_r": "_l"}.get(name[-2:])
        order.append(LANDMARKS.index(name[:-2] + other) if half and other else k)
    return seen[..., order, :]
