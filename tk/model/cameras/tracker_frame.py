"""The tracker's frame: a world defined by the cameras. z is up, the origin is the mean of the camera centres, and x is
the first camera's rightward direction.

Kernels compute in single precision, so rounding depends on the world's origin and axes, and it decides between two
poses that explain the images equally well. The contour trackers therefore compute in this frame, which moves with the
cameras, and whose cameras are rounded: it is the same bit for bit however the capture's world is turned and moved.
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

# Decimals of the cameras' centres, metres, and quaternions: a sixth of float32's step at one metre, and a million times
# float64's rounding when a world is turned, so two worlds almost never round differently.
_DECIMALS = 8
# A camera lies on its side if the sine of its rightward direction's angle with the horizontal exceeds this; its viewing
# direction then gives x. Any value between 0.1 and 0.99 leaves x well defined.
_ON_ITS_SIDE = 0.8


@dataclass(frozen=True)
class TrackerFrame:
    """The tracker's frame and its transform to the capture's world.

    Poses are those of :mod:`tk.model.body.skeleton`: only the first four entries, the pelvis's position and the trunk's
    yaw, depend on the world.
    """

    rig: Rig  # the cameras in this frame
    rotation: Float  # (3, 3) from this frame to the capture's world
    origin: Float  # (3,) m, of this frame in the capture's world
    yaw: float  # radians, the trunk's yaw in the capture's world minus that in this frame

    @staticmethod
    def of(rig: Rig, up: str) -> TrackerFrame:
        """Return the frame of the cameras of a capture whose up direction is ``up`` (see
        :func:`tk.model.cameras.up.up_vector`)."""
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
        """Transform points (..., 3) from the capture's world to this frame, metres."""
        return np.asarray((np.asarray(points) - self.origin) @ self.rotation)

    def points_out(self, points: ArrayLike) -> Float:
        """Transform points (..., 3) from this frame to the capture's world, metres."""
        return np.asarray(np.asarray(points) @ self.rotation.T + self.origin)

    def poses_in(self, poses: Float) -> Float:
        """Transform poses (..., D) from the capture's world to this frame."""
        place, yaw, angles = np.split(poses, [3, 4], axis=-1)
        return np.concatenate([self.points_in(place), yaw - self.yaw, angles], axis=-1)

    def poses_out(self, poses: Float) -> Float:
        """Transform poses (..., D) from this frame to the capture's world."""
        place, yaw, angles = np.split(poses, [3, 4], axis=-1)
        return np.concatenate([self.points_out(place), yaw + self.yaw, angles], axis=-1)

    def rig_out(self, rig: Rig) -> Rig:
        """Transform cameras from this frame to the capture's world."""
        return seen_from(rig, self.rotation.T, -self.rotation.T @ self.origin)


def seen_from(rig: Rig, rotation: Float, origin: Float) -> Rig:
    """Return the cameras in a world with orientation ``rotation`` (3, 3) and origin (3,), metres, in their world."""
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
