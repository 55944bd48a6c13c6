"""Cameras around the actor whose fields of view just contain the whole motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scripts.synthetic.scene import look_at
from tk.model.cameras.camera import Camera, Rig

Float = NDArray[np.float64]

# azimuth (degrees), distance and height (metres); the azimuth of the overhead camera is arbitrary
_PLACES = {
    4: ((38, 3.70, 1.30), (128, 3.90, 1.95), (221, 3.75, 1.55), (312, 3.55, 2.15)),
    5: ((38, 3.70, 1.30), (128, 3.90, 1.95), (221, 3.75, 1.55), (312, 3.55, 2.15), (160, 0.25, 3.65)),
    9: (
        (12, 3.70, 1.30), (65, 3.90, 1.95), (117, 3.75, 1.55), (168, 3.55, 2.15), (221, 3.80, 1.25), (270, 3.60, 1.80),
        (325, 3.70, 2.05), (160, 0.25, 3.65), (290, 0.90, 3.60),
    ),
}  # fmt: skip
RIGS = tuple(_PLACES)
"""Available numbers of cameras."""

# slight barrel and pincushion; some lenses have none
_DISTORTIONS = (
    (0.050, -0.012, 0.0006, -0.0004, 0.0),
    (-0.110, 0.020, 0.0002, 0.0003, 0.0),
    (0.0, 0.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 0.0, 0.0),
    (-0.030, 0.004, 0.0, 0.0, 0.0),
)


def make_rig(count: int, width: int, height: int, centers: Float, radii: Float, rng: np.random.Generator) -> Rig:
    """Return a rig that sees all of these balls entirely, with a margin.

    Args:
        count: one of :data:`RIGS`.
        width, height: pixels.
        centers: (K, 3) balls that bound the actor over all frames, metres.
        radii: (K,) metres.
        rng: draws principal points and small rolls.
    """
    lower, upper = (centers - radii[:, None]).min(axis=0), (centers + radii[:, None]).max(axis=0)
    target = (lower + upper) / 2
    cameras = []
    for i, (azimuth, distance, z) in enumerate(_PLACES[count]):
        angle = np.radians(azimuth)
        eye = np.array([distance * np.cos(angle), distance * np.sin(angle), z])
        overhead = distance < 1.0
        up = np.array([1.0, 0.0, 0.0]) if overhead else np.array([0.0, 0.0, 1.0])
        roll = np.radians(rng.uniform(-1.5, 1.5))
        up = up + 0.0 if overhead else up + np.sin(roll) * np.array([-np.sin(angle), np.cos(angle), 0.0])
        rotation = look_at(eye, _aim(eye, target, up, centers, radii), up)
        middle = np.array([(width - 1) / 2, (height - 1) / 2]) + rng.uniform(-0.008, 0.008, 2) * width
        distortions = np.array(_DISTORTIONS[i % len(_DISTORTIONS)])
        seen = (centers - eye) @ rotation.T
        # a ball at depth z reaches r / z further out, at least; 1.15 for obliqueness
        reach = np.abs(seen[:, :2]) / seen[:, 2:] + (1.15 * radii / (seen[:, 2] - radii))[:, None]
        margin = 0.96
        focal = margin * min(
            (width / 2 - 0.008 * width) / reach[:, 0].max(), (height / 2 - 0.008 * width) / reach[:, 1].max()
        )
        focal /= 1.0 + max(distortions[0], 0.0) * float((reach**2).sum(axis=1).max())
        focal = round(float(focal), 3)
        matrix = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
        cameras.append(Camera(f"cam{i + 1}", width, height, matrix, distortions, rotation, -rotation @ eye))
    return Rig(tuple(cameras))


def _aim(eye: Float, target: Float, up: Float, centers: Float, radii: Float) -> Float:
    """Return the point to look at so that the image of the balls is centred."""
    for _ in range(4):
        rotation = look_at(eye, target, up)
        seen = (centers - eye) @ rotation.T
        xy, r = seen[:, :2] / seen[:, 2:], (radii / (seen[:, 2] - radii))[:, None]
        off = ((xy - r).min(axis=0) + (xy + r).max(axis=0)) / 2
        depth = float(np.linalg.norm(target - eye))
        target = target + depth * (off[0] * rotation[0] + off[1] * rotation[1])
    return target
