"""A world that the cameras make, wherever the capture's own lies: z is up, the origin is the cameras' middle, and x
points where the first camera's pictures have their right.

Kernels count in single precision, and rounding differs from world to world. Where two poses explain the pictures alike,
that decides between them. So trackers of contours count in this world, which goes with the cameras, and whose cameras
are rounded: however the capture's world is turned and moved, this one is the same bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tk.model.body.rotations import to_matrices, to_quaternions
from tk.model.body.skeleton import up_rotation
from tk.model.cameras.camera import Camera, Rig
from tk.model.cameras.up import up_vector

Float = NDArray[np.float64]

# Decimals of the cameras' places, metres, and quaternions: a sixth of a float32's step at one metre, and a million
# times what turning a world by some metres changes in float64, so that this hardly ever rounds the other way.
_DECIMALS = 8
# A camera lies on its side where its rightward direction has this sine with the horizontal; it then looks along x.
_ON_ITS_SIDE = 0.8


@dataclass(frozen=True)
class TrackerFrame:
    """The cameras' own world, and the way between it and the capture's.

    Poses are those of :mod:`tk.model.body.skeleton`, whose first four entries are the pelvis's place and the trunk's
    yaw;
    nothing else of a pose tells how the world lies.

    Attributes:
        rig: the cameras in it.
        rotation: (3, 3) from it to the capture's world.
        origin: (3,) its origin in the capture's world, metres.
        yaw: what a trunk's yaw in the capture's world is beyond that in this one, radians.
    """

    rig: Rig
    rotation: Float
    origin: Float
    yaw: float

    @staticmethod
    def of(rig: Rig, up: str) -> TrackerFrame:
        """The world of the cameras of a capture in which ``up`` (see :func:`tk.model.cameras.up.up_vector`) points
        up."""
        z = up_vector(up)
        right, _, ahead = rig[0].rotation
        x = right if abs(right @ z) < _ON_ITS_SIDE else ahead
        x = x - (x @ z) * z
        x /= np.linalg.norm(x)
        rotation = np.column_stack([x, np.cross(z, x), z])
        origin = rig.centers.mean(axis=0)
        own = Rig(tuple(map(_rounded, seen_from(rig, rotation, origin))))
        facing = up_rotation(up).T @ rotation[:, 0]
        return TrackerFrame(own, rotation, origin, float(np.arctan2(facing[1], facing[0])))

    def points_in(self, points: ArrayLike) -> Float:
        """Points (..., 3) of the capture's world in this one, metres."""
        return np.asarray((np.asarray(points) - self.origin) @ self.rotation)

    def points_out(self, points: ArrayLike) -> Float:
        """Points (..., 3) of this world in the capture's, metres."""
        return np.asarray(np.asarray(points) @ self.rotation.T + self.origin)

    def poses_in(self, poses: Float) -> Float:
        """Poses (..., D) of a body that stands in the capture's world, as those of one that stands in this one."""
        place, yaw, angles = np.split(poses, [3, 4], axis=-1)
        return np.concatenate([self.points_in(place), yaw - self.yaw, angles], axis=-1)

    def poses_out(self, poses: Float) -> Float:
        """The inverse of :meth:`poses_in`."""
        place, yaw, angles = np.split(poses, [3, 4], axis=-1)
        return np.concatenate([self.points_out(place), yaw + self.yaw, angles], axis=-1)

    def rig_out(self, rig: Rig) -> Rig:
        """Cameras of this world in the capture's."""
        return seen_from(rig, self.rotation.T, -self.rotation.T @ self.origin)


def seen_from(rig: Rig, rotation: Float, origin: Float) -> Rig:
    """The cameras in a world that is turned by ``rotation`` (3, 3) and lies at ``origin`` (3,), metres, in theirs."""
    return Rig(
        tuple(
            replace(
                camera, rotation=camera.rotation @ rotation, translation=camera.rotation @ origin + camera.translation
            )
            for camera in rig
        )
    )


def _rounded(camera: Camera) -> Camera:
    # a quaternion and its negative round to the same rotation; adding 0 makes -0 a 0
    rotation = to_matrices(np.round(to_quaternions(camera.rotation), _DECIMALS)) + 0.0
    return replace(camera, rotation=rotation, translation=np.round(camera.translation, _DECIMALS) + 0.0)
