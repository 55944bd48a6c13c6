"""A ring of cameras around the vertical axis, for tests of masks and trackers."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tk.model.cameras.camera import Camera, Rig


def ring_of_cameras(count: int, width: int, height: int, radius_m: float = 3.5) -> Rig:
    """Return level cameras at hip height that see a whole standing person; no two face each other."""
    cameras = []
    for i in range(count):
        angle = 0.2 + i * 2 * np.pi / (count if count % 2 else count + 1)
        center = np.array([radius_m * np.cos(angle), radius_m * np.sin(angle), 1.0])
        z = -center / np.linalg.norm(center[:2])
        z[2] = 0.0
        x = np.cross(z, [0, 0, 1.0])
        rotation = np.stack([x, np.cross(z, x), z])
        focal = 0.72 * height * radius_m / 2.0
        matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        cameras.append(Camera(f"c{i}", width, height, matrix, np.zeros(5), rotation, -rotation @ center))
    return Rig(tuple(cameras))


def turned(rig: Rig, camera: int, degrees: float, axis: str = "y") -> Rig:
    """Return the rig with a camera turned about an axis of its own: x points right in its image, y down."""
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    cameras = list(rig)
    old = cameras[camera]
    cameras[camera] = replace(old, rotation=turn @ old.rotation, translation=turn @ old.translation)
    return Rig(tuple(cameras))
