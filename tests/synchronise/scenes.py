"""Small images of people who move, as cameras with different clocks see them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tk.model.cameras.camera import Camera
from tk.synchronise.looks import Look

SIZE = (90, 160)
_Y, _X = np.mgrid[: SIZE[0], : SIZE[1]]
Point = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def wander(seed: int = 0) -> Point:
    """Return a path in the world, metres: (N, 3) at common times (N,)."""
    random = np.random.default_rng(seed)
    frequency = random.uniform(0.15, 0.9, (3, 6))
    phase = random.uniform(0, 2 * np.pi, (3, 6))
    reach = np.array([[0.35], [0.35], [0.3]]) / 6**0.5

    def path(times: NDArray[np.float64]) -> NDArray[np.float64]:
        waves = np.sin(2 * np.pi * frequency * times[:, None, None] + phase)
        return np.asarray((reach * waves).sum(axis=2) * 1.6 + [0, 0, 1.0])

    return path


def ring(count: int) -> list[Camera]:
    """Return cameras around the origin that look at it from 3 m."""
    cameras = []
    for c in range(count):
        angle = 2 * np.pi * (c / count + 0.07 * c)
        center = np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.2 + 0.5 * (c % 2)])
        forward = np.array([0, 0, 1.0]) - center
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        matrix = np.array([[130.0, 0, 79.5], [0, 130.0, 44.5], [0, 0, 1]])
        cameras.append(Camera(f"cam{c}", 160, 90, matrix, np.zeros(5), rotation, -rotation @ center))
    return cameras


def watch(camera: Camera, paths: list[Point], start_s: float, length_s: float, fps: float, seed: int = 0) -> Look:
    """Return what a camera that starts at a common time sees of balls of 12 cm; its own time begins with 0."""
    random = np.random.default_rng(seed)
    own = np.arange(round(length_s * fps)) / fps
    images = np.full((len(own), *SIZE), 90.0) + random.normal(0, 12, SIZE)  # a room with texture
    for path in paths:
        world = path(start_s + own)
        pixels, depth = camera.project(world)
        for k, ((x, y), z) in enumerate(zip(pixels, depth, strict=True)):
            if not np.isfinite([x, y]).all():
                continue
            radius = 130 * 0.12 / z
            near = tuple(  # beyond, the ball adds nothing
                slice(max(int(at - radius) - 12, 0), max(int(at + radius) + 13, 0)) for at in (y, x)
            )
            inside = 1 / (1 + np.exp(np.clip(2 * (np.hypot(_X[near] - x, _Y[near] - y) - radius), -50, 50)))
            images[k][near] += inside * (190 - images[k][near])
    images += random.normal(0, 1.0, images.shape)
    return Look(own, np.clip(images, 0, 255).astype(np.uint8))
