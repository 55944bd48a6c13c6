"""Render the actor by sphere tracing: images, shadow maps, compositing over the room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.actor import Actor, join
from scripts.synthetic.scene import Lamps, RoomView
from scripts.synthetic.skeleton import Pose
from scripts.synthetic.tracing import FAR_M, TILE, composite_kernel, depth_kernel, distance_kernel, render_kernel
from tk.kernels.runtime import ensure_runtime
from tk.model.cameras.camera import Camera

PENUMBRA_PX = 2.5


def sample_rays(camera: Camera, offsets: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return (S, H, W, 3) unit directions in the world through each pixel's centre plus ``offsets`` (S, 2) pixels."""
    y, x = np.mgrid[: camera.height, : camera.width]
    grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    rays = [camera.rays(grid + offset) for offset in offsets]
    return np.array(rays, dtype=np.float32).reshape(len(offsets), camera.height, camera.width, 3)


def _f32(a: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.ascontiguousarray(a, dtype=np.float32)


def _table(actor: Actor) -> NDArray[np.float32]:
    """Return (N, 21) what the kernels need of each primitive, lengths in squeezed units.

    Columns: first end a (3), its radius, 1 / scale (3), unit vector from a to b (3), length, decrease of the radius per
    unit of length, tangent of the angle with this sine, cut (4), blend, wrinkle, number, material.
    """
    shape = actor.shape
    a, b, ra, rb = shape[:, :3], shape[:, 4:7], shape[:, 3:4], shape[:, 7:8]
    length = np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-6)
    slope = np.clip((ra - rb) / length, -0.95, 0.95)
    tangent = slope / np.sqrt(1 - slope**2)
    axis, inverse = (b - a) / length, 1 / shape[:, 8:11]
    return _f32(np.column_stack([a, ra, inverse, axis, length, slope, tangent, shape[:, 11:], actor.material]))


@dataclass(frozen=True)
class Body:
    """Actors as kernel arguments: everything that does not change from frame to frame. Bit k of ``stripes`` is actor
    k's."""

    actor: Actor
    shape: NDArray[np.float32]
    colors: NDArray[np.float32]
    stripes: int

    @staticmethod
    def of(actor: Actor, colors: NDArray[np.float64], stripes: bool) -> Body:
        """Return one actor as a body."""
        return Body(actor, _table(actor), _f32(colors), int(stripes))

    @staticmethod
    def join(bodies: Sequence[Body]) -> Body:
        """Return several actors as one body; its poses are those of :meth:`Pose.join`."""
        actor, colors = join([body.actor for body in bodies]), np.concatenate([body.colors for body in bodies])
        stripes = sum(body.stripes << k for k, body in enumerate(bodies))
        return Body(actor, _table(actor), colors, stripes)


def shadow_maps(body: Body, pose: Pose, lamps: Lamps) -> NDArray[np.float32]:
    """Return (L, Z, Z) distance from each lamp to the actor, metres, at one moment (``pose`` holds one)."""
    ensure_runtime()
    frames, capsules = _f32(body.actor.frames(pose)), _f32(body.actor.capsules(pose))
    maps = np.full((len(lamps.cameras), lamps.cameras[0].height, lamps.cameras[0].width), FAR_M, dtype=np.float32)
    for camera, rays, out in zip(lamps.cameras, lamps.rays, maps, strict=True):
        depth_kernel(_f32(camera.center), rays, frames, capsules, body.shape,
                      _scratch(camera, capsules), out)  # fmt: skip
    return maps


def render_actor(
    camera: Camera, rays: NDArray[np.float32], body: Body, poses: Pose, lamps: Lamps, shadow: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return (H, W, 4) linear RGB, premultiplied, and coverage; ``poses`` has one pose for each of the four sample
    rays."""
    ensure_runtime()
    out = np.zeros((camera.height, camera.width, 4), dtype=np.float32)
    capsules = _f32(body.actor.capsules(poses))
    render_kernel(body.stripes, _f32(camera.center), rays, _f32(body.actor.frames(poses)), capsules, body.shape,
                   body.colors, lamps.light, lamps.axes, shadow, lamps.ambient,
                   _scratch(camera, capsules), out)  # fmt: skip
    return out


def _scratch(camera: Camera, capsules: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return room for the primitives of each tile and block."""
    tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
    return np.empty((tiles, 2, len(capsules)), np.int32)


def distances(body: Body, pose: Pose, points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return (P,) signed distances from (P, 3) world points to the actor in one pose, metres."""
    ensure_runtime()
    out = np.empty(len(points), dtype=np.float32)
    every = np.tile(np.arange(len(body.shape), dtype=np.int32), (1, 2, 1))
    distance_kernel(_f32(points), every, _f32(body.actor.frames(pose)), body.shape, out)
    return out


def composite(
    room: RoomView, lamps: Lamps, shadow: NDArray[np.float32], spheres: NDArray[np.float32], body: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(H, W, 3) linear RGB: the actor over the room, with his shadows.

    Args:
        room: what the camera sees of the empty room.
        lamps, shadow: the lamps and their shadow maps.
        spheres: (B, 4) centre and radius of balls that stand for the body in ambient light.
        body: from :func:`render_actor`.
    """
    ensure_runtime()
    out = np.empty((*body.shape[:2], 3), dtype=np.float32)
    # lamps have a size: their shadows have soft edges
    veil = np.array([cv2.GaussianBlur((z < FAR_M).astype(np.float32), (0, 0), PENUMBRA_PX) for z in shadow])
    composite_kernel(room.point, room.normal, room.indirect, room.direct, lamps.light, lamps.axes, veil, spheres,
                      body, out)  # fmt: skip
    return out
